# SPDX-License-Identifier: Apache-2.0
import numpy as np

from stereovox.localize.amcl.localise import FreeFloor, near
from stereovox.maps.occupancy import OccupancyGrid


def test_anywhere_is_any_free_place_and_direction_alike():
    cells = np.array([[0, 0, 100, -1], [50, 0, -1, 0]], np.int8)
    grid = OccupancyGrid(cells, 0.5, (3.0, -1.0, 0.8))
    poses = FreeFloor(grid).anywhere(40_000, np.random.default_rng(0))
    rows, columns = grid.indices(poses[:, :2]).T
    counts = np.zeros(cells.shape)
    np.add.at(counts, (rows, columns), 1)
    assert np.allclose(counts[cells == 0], 10_000, rtol=0.05)
    assert counts[cells != 0].sum() == 0
    turns = np.histogram(poses[:, 2], 8, (-np.pi, np.pi))[0]
    assert np.allclose(turns, 5_000, rtol=0.08)
    corner = grid.centres([0], [0])[0]
    first = poses[(rows == 0) & (columns == 0), :2] - corner
    assert np.allclose(first.mean(0), 0, atol=0.01)
    assert np.allclose(first.std(0), 0.5 / np.sqrt(12), rtol=0.05)


def test_near_a_start_is_normal_and_wraps():
    poses = near(np.array([1.0, 2.0, 3.1]), (0.5, 0.2, 0.3), 50_000, np.random.default_rng(1))
    assert np.allclose(poses[:, :2].mean(0), [1, 2], atol=0.01)
    assert np.allclose(poses[:, :2].std(0), [0.5, 0.2], rtol=0.03)
    assert (np.abs(poses[:, 2]) <= np.pi).all()
    off = np.angle(np.exp(1j * (poses[:, 2] - 3.1)))
    assert np.isclose(off.std(), 0.3, rtol=0.03)
