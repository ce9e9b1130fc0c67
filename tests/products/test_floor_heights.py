# SPDX-License-Identifier: Apache-2.0
"""The height of the floor per place: level, sloping, unknown, at any height of the world."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.products.floor_heights import REACH, FloorHeights, find_floor

SIDE = 0.1
FREE, WALL = -3.0, 3.0


def floor_map(levels, up="z", room=20):
    """A map whose floor's top cell is `levels` (rows, columns), free for `room` cells above it."""
    cells, values = [], []
    for (row, column), level in np.ndenumerate(levels):
        cells += [(column, row, level + above) for above in range(room + 1)]
        values += [WALL, *[FREE] * room]
    cells = np.array(cells)
    if up == "-z":
        cells = np.column_stack([cells[:, 1], cells[:, 0], -1 - cells[:, 2]])
    return VoxelMap.from_cells(load_config(voxel_size=SIDE, up=up), cells, values)


@pytest.mark.parametrize("up", ["z", "-z"])
def test_a_slope_has_its_height_at_each_place(up):
    levels = np.tile(np.arange(30) // 3 - 17, (12, 1))  # 18 degrees, all below the world's origin
    floor = find_floor(floor_map(levels, up))
    assert floor.height.shape == levels.shape
    np.testing.assert_allclose(floor.height, (levels + 0.5) * SIDE, atol=1e-6)
    assert (floor.away == 0).all()


def test_places_are_looked_up_and_unknown_beyond_reach():
    floor = find_floor(floor_map(np.full((10, 10), -12)))
    near, far = floor.at([[0.55, 0.55, 9.0], [5.0, 0.5, 0.0]])
    assert near == pytest.approx(-11.5 * SIDE)
    assert np.isnan(far)
    hole = np.full((30, 30), -12)
    whole = floor_map(hole)
    cells, values = whole.cells()
    inside = (np.abs(cells[:, :2] - 15) <= 9).all(axis=1) & (cells[:, 2] == -12)  # the floor was not seen there
    floor = find_floor(VoxelMap.from_cells(whole.config, cells[~inside], values[~inside]))
    assert np.isnan(floor.at([[1.55, 1.55, 0]])).all()
    assert floor.at([[1.55, 1.55, 0]], reach=2.0) == pytest.approx(-11.5 * SIDE)
    assert floor.at([[0.6 + REACH / 2, 1.5, 0]]) == pytest.approx(-11.5 * SIDE)


def test_no_floor_is_unknown_and_not_at_zero():
    walls = VoxelMap.from_cells(load_config(voxel_size=SIDE), [[0, 0, k] for k in range(9)], [WALL] * 9)
    for voxel_map in (walls, VoxelMap(load_config(voxel_size=SIDE))):
        floor = find_floor(voxel_map)
        assert not floor.known
        assert np.isnan(floor.at([[0.05, 0.05, 0.0]])).all()


def test_a_stated_floor_is_level_everywhere():
    floor = FloorHeights.level(-1.3)
    assert floor.known
    assert floor.at([[100.0, -5.0, 3.0]]) == pytest.approx(-1.3)
    with pytest.raises(StereovoxError, match="floor nan"):
        FloorHeights.level(float("nan"))
