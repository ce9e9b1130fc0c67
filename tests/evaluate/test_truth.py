# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.evaluate.truth import (
    exact_occupancy,
    indices,
    interior_cells,
    keys,
    longest_axis,
    position,
    touched_cells,
    within,
)
from stereovox.evaluate.truth_cells import Sightings
from stereovox.geometry.se3 import look_at
from stereovox.simulate.scene import Scene, box, cylinder


def touches(triangle, low, high):
    """Clip the triangle by the six faces of a box (Sutherland-Hodgman); something is left where they touch."""
    polygon = list(triangle)
    for axis in range(3):
        for sign, limit in ((1, high[axis]), (-1, -low[axis])):
            rest = []
            for start, end in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                a, b = sign * start[axis] - limit, sign * end[axis] - limit
                if a <= 0:
                    rest.append(start)
                if (a < 0 < b) or (b < 0 < a):
                    rest.append(start + (end - start) * a / (a - b))
            polygon = rest
    return bool(polygon)


def test_keys_keep_cells_and_their_order():
    cells = np.array([[-5, 3, 0], [-5, 3, 1], [0, -(2**20), 7], [2, 0, 2**20 - 1]])
    np.testing.assert_array_equal(indices(keys(cells)), cells)
    assert (np.diff(keys(cells)) > 0).all()


def test_position_and_within():
    among = keys([[0, 0, 0], [5, 5, 5]])
    np.testing.assert_array_equal(position(keys([[5, 5, 5], [1, 0, 0]]), among), [1, -1])
    np.testing.assert_array_equal(within(keys([[1, -1, 1], [2, 0, 0], [5, 5, 5]]), among, 1), [True, False, True])
    assert not within(keys([[0, 0, 0]]), keys(np.zeros((0, 3))), 1).any()


@pytest.mark.parametrize("seed", range(8))
def test_touched_cells_against_brute_force(seed):
    triangle = np.random.default_rng(seed).uniform(-1.5, 1.5, (3, 3))
    low, high = np.floor(triangle.min(0) / 0.25).astype(int), np.floor(triangle.max(0) / 0.25).astype(int)
    cells = np.argwhere(np.ones(high - low + 1)) + low
    expected = [touches(triangle, cell * 0.25, (cell + 1) * 0.25) for cell in cells]
    np.testing.assert_array_equal(touched_cells(triangle[None], 0.25), cells[expected])


def test_a_triangle_in_a_cells_face_belongs_to_the_upper_cell():
    triangle = np.array([[[0.1, 0.1, 1.0], [0.9, 0.1, 1.0], [0.1, 0.9, 1.0]]])
    np.testing.assert_array_equal(touched_cells(triangle, 1.0), [[0, 0, 1]])
    np.testing.assert_array_equal(touched_cells(triangle - [0, 0, 1], 1.0), [[0, 0, 0]])


def test_a_slanted_triangle_misses_the_far_corner_of_its_bounding_box():
    triangle = np.array([[[0.5, 0.5, 0.5], [3.4, 0.5, 0.5], [0.5, 3.4, 0.5]]])
    cells = touched_cells(triangle, 1.0)
    assert [3, 3, 0] not in cells.tolist()
    assert [0, 3, 0] in cells.tolist()
    assert len(cells) == 10


def test_a_box_has_a_shell_and_an_inside():
    truth = exact_occupancy(Scene([box("things", "cube", (0.05, 0.05, 0.05), (0.45, 0.45, 0.45))]), 0.1)
    assert len(truth.surface) == 5**3 - 3**3
    np.testing.assert_array_equal(indices(truth.inside), np.argwhere(np.ones((3, 3, 3))) + 1)
    assert [(piece.part, piece.name, len(piece.cells)) for piece in truth.pieces] == [("things", "cube", 98)]


def test_the_face_between_two_solids_is_inside():
    halves = [
        box("walls", "left", (0.05, 0.05, 0.05), (0.52, 0.85, 0.85)),
        box("walls", "right", (0.52, 0.05, 0.05), (1.05, 0.85, 0.85)),
    ]
    one = exact_occupancy(Scene([box("walls", "one", (0.05, 0.05, 0.05), (1.05, 0.85, 0.85))]), 0.1)
    two = exact_occupancy(Scene(halves), 0.1)
    np.testing.assert_array_equal(two.surface, one.surface)
    np.testing.assert_array_equal(two.inside, one.inside)


def test_interior_of_a_round_pole_is_its_core():
    cells = interior_cells(cylinder("poles", "pole", (0.5, 0.5, 0), (0.5, 0.5, 1), 0.5), 0.1)
    centres = (cells + 0.5) * 0.1
    assert (np.hypot(*(centres[:, :2] - 0.5).T) <= 0.25).all()
    steps = np.arange(-4.5, 5) / 10
    assert len(cells) == 10 * sum(np.hypot(x, y) < 0.245 for x in steps for y in steps)


def test_longest_axis_of_a_bar():
    axis = longest_axis(cylinder("poles", "bar", (0, 0, 1), (3, 3, 1), 0.02))
    np.testing.assert_allclose(np.abs(axis), [np.sqrt(0.5), np.sqrt(0.5), 0], atol=1e-6)


def test_sightings_count_frames_not_pixels():
    cells = keys([[9, 0, 0], [20, 0, 0], [21, 0, 0]])
    camera = PinholeCamera(4, 4, 100.0, 100.0, 1.5, 1.5)
    sightings = Sightings(cells, 0.1)
    pose = look_at([0.0, 0.05, 0.05], [1.0, 0.05, 0.05])
    for depth in (2.05, 2.05, 2.15, np.inf, np.nan):
        sightings.add(np.full((4, 4), depth), camera, pose)
    np.testing.assert_array_equal(sightings.frames, [0, 2, 1])
    sightings.add(np.full((4, 4), 2.15), camera, pose, max_range=2.0)
    np.testing.assert_array_equal(sightings.frames, [0, 2, 1])
