# SPDX-License-Identifier: Apache-2.0
"""The height of the floor per place: level, sloping, unknown, at any height of the world."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_heights import REACH, FloorHeights, find_floor
from stereovox.products.projection import project

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


class Place:
    """A place of 8 x 5 m in cells of 0.1 m, free above its floor up to `top`, with things on it."""

    def __init__(self, level, top=25):
        self.cells = {}
        for x in range(80):
            for y in range(50):
                self.cells |= {(x, y, z): FREE for z in range(level(x) + 1, level(x) + top)}
                self.cells[x, y, level(x)] = WALL

    def box(self, low, high, value=WALL):
        for x in range(low[0], high[0]):
            for y in range(low[1], high[1]):
                self.cells |= {(x, y, z): value for z in range(low[2], high[2])}
        return self

    def unseen(self, low, high):
        for cell in [cell for cell in self.cells if all(a <= c < b for a, c, b in zip(low, cell, high, strict=True))]:
            del self.cells[cell]
        return self

    def map(self):
        return VoxelMap.from_cells(load_config(voxel_size=SIDE), list(self.cells), list(self.cells.values()))


def seen_from(voxel_map, place):
    T = np.eye(4)
    T[:3, 3] = place
    voxel_map.storage.set_viewpoint(Viewpoint(PinholeCamera.from_field_of_view(64, 48, 60.0), T))
    return voxel_map


def table(place, x, y, floor):
    """A table top of 0.8 x 1.2 m, one cell thick, 0.7 m above the floor, which is not seen below it."""
    return place.unseen((x, y, floor - 1), (x + 8, y + 12, floor + 7)).box(
        (x, y, floor + 7), (x + 8, y + 12, floor + 8)
    )


def states_in(grid, low, high):
    rows, columns = np.mgrid[low[1] : high[1], low[0] : high[0]]
    at = grid.indices(np.column_stack([columns.ravel() + 0.5, rows.ravel() + 0.5]) * SIDE)
    inside = ((at >= 0) & (at < grid.cells.shape)).all(axis=1)
    return np.where(inside, grid.states[tuple(np.where(inside[:, None], at, 0).T)], State.UNKNOWN)


LEVELS = {
    "level, below the origin": lambda x: -15,
    "level, above the origin": lambda x: 12,
    "slope of 11 degrees": lambda x: x // 5 - 20,
    "step of 0.1 m": lambda x: -15 + (x >= 40),
}


@pytest.mark.parametrize("level", LEVELS.values(), ids=LEVELS)
def test_a_table_is_an_obstacle_and_the_floor_is_free_at_any_height_of_the_world(level):
    place = table(Place(level), 60, 20, level(63))
    grid = project(place.map())
    assert (states_in(grid, (60, 20), (68, 32)) == State.OCCUPIED).all()
    elsewhere = np.concatenate([states_in(grid, (5, 5), (35, 45)), states_in(grid, (45, 2), (75, 15))])
    assert (elsewhere == State.FREE).mean() > 0.95


@pytest.mark.parametrize("floor", [-0.8, -3.0], ids=["at the table", "far below"])
def test_a_wrong_floor_is_what_these_tests_would_find(floor):
    """The mutation: with a floor that is not the map's, tables of 0.7 m are no obstacles or nothing is free."""
    place = table(Place(lambda x: -15), 60, 20, -15)
    grid = project(place.map(), floor=floor)
    there, elsewhere = states_in(grid, (60, 20), (68, 32)), states_in(grid, (5, 5), (35, 45))
    assert (there != State.OCCUPIED).all() or (elsewhere != State.FREE).all()


def test_a_table_whose_floor_was_not_seen_is_no_floor():
    """Only the table and the free space around and below its edge are known."""
    place = table(Place(lambda x: -15), 30, 20, -15).unseen((0, 0, -15), (80, 50, -14))
    for x, y in ((38, 20), (30, 32)):  # it is larger than what counts as a floor
        place.box((x, y, -8), (x + 12, y + 8, -7))
    assert not find_floor(place.map()).known
    with pytest.raises(StereovoxError, match="shows no floor"):
        project(place.map())


def test_a_staircase_of_noise_leads_onto_no_table():
    place = table(Place(lambda x: -15), 30, 20, -15)
    for k in range(8):  # a cell higher with each cell
        place.box((22 + k, 20, -15), (23 + k, 32, -14 + k))
    grid = project(place.map())
    assert (states_in(grid, (30, 20), (38, 32)) != State.FREE).all()
    assert (states_in(grid, (26, 20), (30, 32)) != State.FREE).all()
    assert (states_in(grid, (50, 5), (75, 45)) == State.FREE).all()


def test_of_two_storeys_the_one_counts_that_the_camera_or_start_is_on():
    house = table(Place(lambda x: 0), 30, 20, 0).box((0, 0, 25), (80, 50, 26))
    house.box((0, 0, 26), (80, 50, 50), FREE)
    house.box((60, 20, 30), (64, 24, 34))  # upstairs hangs a lamp, 0.4 m above the floor
    downstairs, upstairs = (project(house.map(), start=(4.0, 2.5, z)) for z in (0.1, 2.6))
    assert (states_in(downstairs, (30, 20), (38, 32)) == State.OCCUPIED).all()
    assert (states_in(downstairs, (60, 20), (64, 24)) == State.FREE).all()
    assert (states_in(upstairs, (30, 20), (38, 32)) == State.FREE).all()
    assert (states_in(upstairs, (60, 20), (64, 24)) == State.OCCUPIED).all()
    for z, expected in ((1.3, downstairs), (3.9, upstairs)):
        np.testing.assert_array_equal(project(seen_from(house.map(), (4.0, 2.5, z))).cells, expected.cells)


def test_a_drone_high_above_racks_finds_the_floor_between_them():
    hall = Place(lambda x: -70, top=80)
    for y in (8, 30):
        hall.box((10, y, -70), (70, y + 12, -20))
    grid = project(seen_from(hall.map(), (4.0, 1.4, 0.5)))  # above a rack
    assert (states_in(grid, (10, 8), (70, 20)) != State.FREE).all()
    assert (states_in(grid, (10, 22), (70, 28)) == State.FREE).all()


def test_a_place_below_a_drop_is_not_free():
    dock = Place(lambda x: 0 if x < 50 else -12)
    grid = project(dock.map(), start=(1.0, 1.0, 0.0))  # the robot is on the dock
    assert (states_in(grid, (5, 5), (40, 45)) == State.FREE).all()
    assert (states_in(grid, (50, 5), (75, 45)) != State.FREE).all()  # from the edge on
    low_box = dock.box((51, 10, -12), (54, 40, 2))  # lower than a step above the dock
    grid = project(low_box.map(), start=(1.0, 1.0, 0.0))
    assert (states_in(grid, (50, 5), (75, 45)) != State.FREE).all()
    below = project(dock.map())  # the lowest: the dock is an obstacle
    assert (states_in(below, (0, 0), (40, 50)) != State.FREE).all()
    assert (states_in(below, (65, 5), (75, 45)) == State.FREE).all()


def test_a_box_as_high_as_another_floor_is_no_island_of_it():
    place = Place(lambda x: 0 if x < 50 else -4).unseen((50, 0, -4), (54, 50, 21)).box((58, 20, -4), (63, 26, 1))
    grid = project(place.map(), start=(1.0, 1.0, 0.0))  # the robot is on the higher floor
    assert (states_in(grid, (58, 20), (63, 26)) != State.FREE).all()
    assert (states_in(grid, (5, 5), (45, 45)) == State.FREE).all()


def test_where_the_floor_was_not_seen_nearby_nothing_is_free():
    place = Place(lambda x: -15).unseen((40, 0, -15), (80, 50, -14))
    grid = project(place.map())
    assert (states_in(grid, (5, 5), (40, 45)) == State.FREE).all()
    assert (states_in(grid, (40, 5), (44, 45)) == State.FREE).all()
    assert (states_in(grid, (46, 5), (80, 45)) != State.FREE).all()
