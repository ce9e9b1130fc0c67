# SPDX-License-Identifier: Apache-2.0
"""A map that stands in another frame is laid on the reference."""

from dataclasses import replace

import numpy as np
import pytest
from made_floors import FREE, WALL, changed, looked_up, room

from stereovox.evaluate.grid_align import Fit, align_grids
from stereovox.evaluate.grid_scores import score_grids
from stereovox.geometry import se2
from stereovox.maps.occupancy import OccupancyGrid

MOTIONS = [(0.0, 0.0, 0.0), (0.13, -0.21, 0.06), (-7.0, 5.0, 2.9)]


def in_its_own_frame(reference, motion, side=0.05):
    """The map of a robot whose frame stands at `motion` in the reference's frame."""
    there = replace(reference, origin=tuple(se2.compose(se2.inverse(motion), reference.origin)))
    corners = there.centres([0, 0, 79, 79], [0, 119, 0, 119])
    low, high = corners.min(axis=0) - 0.3, corners.max(axis=0) + 0.3
    shape = tuple(int(n) for n in np.ceil((high - low)[::-1] / side))
    return looked_up(there, side, (*low, 0.0), shape)


def gap(found, motion, middle=(3.0, 2.0, 0.0)):
    """Metres at the room's middle, and radians."""
    x, y, yaw = se2.relative(se2.compose(motion, middle), se2.compose(found, middle))
    return float(np.hypot(x, y)), abs(float(yaw))


@pytest.mark.parametrize("motion", MOTIONS)
def test_the_motion_is_found(motion):
    reference = room(origin=(-1.0, 0.5, 0.2))
    ours = in_its_own_frame(reference, motion)
    found = score_grids(ours, reference)
    metres, radians = gap(found.motion, motion)
    assert metres < 0.02
    assert radians < 0.004
    assert found.aligned
    assert found.eq7_percent < 3
    assert found.occupied.iou_tolerant > 0.99


def test_cells_of_another_size_do_not_matter():
    motion = (0.4, 0.3, -0.1)
    metres, radians = gap(align_grids(in_its_own_frame(room(), motion, 0.08), room()), motion)
    assert metres < 0.04
    assert radians < 0.01


def test_half_a_map_with_holes_and_noise_is_laid_on_the_whole():
    random = np.random.default_rng(1)
    motion = (1.0, -0.6, 0.4)
    ours = in_its_own_frame(room(), motion)
    cells = ours.cells.copy()
    cells[:, : cells.shape[1] * 2 // 5] = -1
    walls = np.argwhere(cells == WALL)
    cells[tuple(walls[random.random(len(walls)) < 0.3].T)] = FREE
    thick = np.clip(walls + random.integers(-1, 2, walls.shape), 0, np.array(cells.shape) - 1)
    cells[tuple(thick.T)] = WALL
    metres, radians = gap(align_grids(changed(ours, cells), room()), motion)
    assert metres < 0.03
    assert radians < 0.01


def test_equal_maps_stay_where_they_are_also_where_a_turn_fits_as_well():
    box = OccupancyGrid(np.pad(np.full((40, 80), FREE, np.int8), 2, constant_values=WALL), 0.05, (3.0, 1.0, -0.4))
    assert align_grids(box, box).tolist() == pytest.approx([0, 0, 0], abs=1e-9)
    assert score_grids(box, box).eq7_percent == 0
    half = align_grids(box, box, start=(2 * 4.0, 3.0, np.pi))  # of the two that fit the one nearest to the start
    assert abs(abs(half[2]) - np.pi) < 0.01
    assert score_grids(box, box, align=False, start=half).occupied.iou_tolerant == 1


def test_the_same_maps_give_the_same_motion():
    ours, reference = in_its_own_frame(room(), MOTIONS[2], 0.1), room(0.1)
    assert (align_grids(ours, reference) == align_grids(ours, reference)).all()


def test_without_walls_there_is_nothing_to_go_by():
    empty = changed(room(), np.full_like(room().cells, FREE))
    assert align_grids(empty, room(), (1, 2, 3)).tolist() == [1, 2, 3]
    assert align_grids(room(), empty).tolist() == [0, 0, 0]


def test_one_occupied_cell_is_enough_for_a_shift():
    cells = np.full((9, 9), FREE, np.int8)
    cells[4, 6] = WALL
    one = OccupancyGrid(cells, 0.1)
    other = OccupancyGrid(cells, 0.1, (0.5, 0.2, 0.0))
    assert score_grids(other, one).occupied.iou_tolerant == 1


def test_a_likelihood_is_the_mean_over_nearest_walls():
    """Against every pair of walls; distances between pixels are interpolated, so only nearly."""
    random = np.random.default_rng(2)
    ours, theirs = (np.unique(np.floor(random.uniform(0, 60, (50, 2))), axis=0) * 0.1 + 0.05 for _ in range(2))
    fit = Fit(ours, theirs, ours[:0], theirs[:0], 0.1, 1.0)
    pose = (0.31, -0.17, 0.05)
    there, back = se2.transform(pose, ours), se2.transform(se2.inverse(pose), theirs)

    def mean(points, others):
        nearest = np.linalg.norm(points[:, None] - others[None], axis=2).min(axis=1)
        return np.exp(-0.5 * (nearest / 0.5) ** 2).mean()

    wanted = (mean(there, theirs) + mean(back, ours)) / 2
    assert fit.likelihood(pose, 0.5) == pytest.approx(wanted, abs=0.01)
    assert 0.2 < wanted < 0.95


def test_a_small_map_finds_its_place_in_one_five_times_as_large():
    random = np.random.default_rng(4)
    cells = np.full((400, 400), FREE, np.int8)
    for row, column, along, across in np.column_stack(
        [random.integers(0, 360, (90, 2)), random.integers(2, 40, (90, 2))]
    ):
        cells[row : row + along, column] = WALL
        cells[row, column : column + across] = WALL
    building, motion = OccupancyGrid(cells, 0.1), (22.0, 15.0, 2.0)
    there = replace(building, origin=tuple(se2.inverse(motion)))
    ours = looked_up(there, 0.1, (-4.0, -4.0, 0.0), (80, 80))
    assert (ours.cells == WALL).sum() > 200
    metres, radians = gap(align_grids(ours, building), motion, (0.0, 0.0, 0.0))
    assert metres < 0.05
    assert radians < 0.01
