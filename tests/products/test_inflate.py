# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.cli import main
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.formats.map_server import read_map_server
from stereovox.maps import State, VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.projection import inflated, inflated_grid, inflated_mask

RANDOM = np.random.default_rng(3)


def by_hand(blocked, sides, radius, margin):
    """Each cell against each obstacle, which is a box `margin` cells larger to all sides."""
    near = np.zeros(blocked.shape, bool)
    obstacles = np.argwhere(blocked)
    for cell in np.ndindex(*blocked.shape):
        gaps = np.maximum(np.abs(obstacles - cell) - 1 - margin, 0) * np.asarray(sides)
        near[cell] = ((gaps**2).sum(axis=1) < (radius - 1e-9) ** 2).any()
    return near


@pytest.mark.parametrize("margin", [0, 1, 2])
@pytest.mark.parametrize("radius", [0.03, 0.1, 0.3])
def test_every_cell_from_which_a_robot_may_touch_something_is_marked(radius, margin):
    for shape, sides in (((15, 9, 12), (0.1, 0.1, 0.1)), ((14, 8, 9), (0.1, 0.3, 0.05)), ((22, 31), (0.1, 0.1))):
        blocked = RANDOM.random(shape) < 0.005
        np.testing.assert_array_equal(
            inflated_mask(blocked, sides, radius, margin), by_hand(blocked, sides, radius, margin)
        )
    assert not inflated_mask(np.zeros((4, 4), bool), 0.1, radius).any()


def test_a_floor_map_is_inflated_over_free_and_unknown_cells():
    cells = np.zeros((9, 11), np.int8)
    cells[:, 6:] = -1
    cells[4, 5] = 100
    cells[0, 0] = 40
    grid = OccupancyGrid(cells, 0.1, (1.0, 2.0, 0.5))
    found = inflated_grid(grid, 0.15, margin=1)
    near = by_hand(cells == 100, (0.1, 0.1), 0.15, 1)
    assert near.any(axis=0).sum() == 7
    np.testing.assert_array_equal(found.cells, np.where(near, 100, cells))
    assert (found.resolution, found.origin) == (0.1, (1.0, 2.0, 0.5))
    assert (cells == 100).sum() == 1, "the grid itself stays"


@pytest.mark.parametrize("steps", [None, [0.1, 0.2, 0.1]])
def test_a_map_in_space_is_inflated_over_free_and_unknown_cells(steps):
    settings = {} if steps is None else {"steps": steps}
    cells = RANDOM.integers(-80, 80, (30, 3))
    free = RANDOM.integers(-80, 80, (300, 3))
    log_odds = [-3.0] * 300 + [2.0] * 30
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=0.1, **settings), np.concatenate([free, cells]), log_odds)
    found = inflated(voxel_map, 0.25)
    places = np.concatenate([cells + RANDOM.integers(-6, 7, (30, 3)) for _ in range(40)])
    gaps = np.maximum(np.abs(places[:, None] - cells) - 2, 0) * voxel_map.config.cell
    near = ((gaps**2).sum(axis=2) < (0.25 - 1e-9) ** 2).any(axis=1)
    before, after = (one.state(voxel_map.centers(places)) for one in (voxel_map, found))
    np.testing.assert_array_equal(after, np.where(near, State.OCCUPIED, before))
    assert 100 < near.sum() < 1100


def test_an_empty_map_stays_empty():
    assert len(inflated(VoxelMap(load_config()), 0.3).cells()[0]) == 0


@pytest.mark.parametrize(
    ("radius", "margin", "told"), [(0.0, 1, "radius 0"), (np.nan, 1, "radius"), (0.1, -1, "margin")]
)
def test_wrong_use_ends_in_one_line(radius, margin, told):
    with pytest.raises(StereovoxError, match=told):
        inflated_mask(np.zeros((3, 3), bool), 0.1, radius, margin)


def test_a_floor_map_is_exported_inflated(tmp_path):
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=0.1), [[0, 0, 5], [12, 9, 5]], [2.0, -3.0])
    voxel_map.save(tmp_path / "one.svox")
    low = ["--floor", "0", "--heights", "0.5:0.6"]
    assert main(["export", str(tmp_path / "one.svox"), str(tmp_path / "one.yaml"), "--inflate", "0.25", *low]) == 0
    grid = read_map_server(tmp_path / "one.yaml")
    assert (grid.cells == 100).sum() == by_hand(np.eye(10, 13) * (np.arange(13) == 0) > 0, (0.1, 0.1), 0.25, 1).sum()
    assert main(["export", str(tmp_path / "one.svox"), str(tmp_path / "one.ply"), "--inflate", "0.25"]) == 2
