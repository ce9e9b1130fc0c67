# SPDX-License-Identifier: Apache-2.0
import numpy as np

from stereovox.geometry import se2
from stereovox.localize.amcl.particles import distance_field
from stereovox.maps.occupancy import OccupancyGrid


def some_grid(rng, shape=(23, 31), origin=(-1.3, 2.2, 0.7)):
    cells = rng.choice(np.array([-1, 0, 50, 100], np.int8), shape, p=[0.1, 0.6, 0.25, 0.05])
    return OccupancyGrid(cells, 0.1, origin)


def test_distances_are_those_to_the_nearest_occupied_cell():
    grid = some_grid(np.random.default_rng(0))
    found = distance_field(grid, 0.35).distance_m
    rows, columns = np.nonzero(grid.cells == 100)
    for row in range(grid.cells.shape[0]):
        for column in range(grid.cells.shape[1]):
            nearest = 0.1 * min(np.hypot(rows - row, columns - column))
            assert abs(found[row, column] - min(nearest, 0.35)) < 1e-6


def test_points_of_the_maps_frame_find_their_cells():
    grid = some_grid(np.random.default_rng(1))
    field = distance_field(grid, 2.0)
    rows, columns = np.divmod(np.arange(grid.cells.size), grid.cells.shape[1])
    centres = grid.centres(rows, columns)
    assert np.array_equal(field.at(centres), field.distance_m.ravel())
    corner = se2.transform(grid.origin, [[0.04, 0.06], [-0.01, 0.05], [0.05, -0.01], [3.11, 0.05], [0.05, 2.31]])
    assert field.at(corner).tolist() == [field.distance_m[0, 0], 2.0, 2.0, 2.0, 2.0]


def test_a_map_without_obstacles_is_far_from_all():
    grid = OccupancyGrid(np.zeros((4, 5), np.int8), 0.1)
    assert (distance_field(grid, 1.5).distance_m == 1.5).all()
    assert np.isinf(distance_field(grid).distance_m).all()
