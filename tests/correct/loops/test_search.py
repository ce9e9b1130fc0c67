# SPDX-License-Identifier: Apache-2.0
"""The search for where a submap lies, against a slow twin and against the truth."""

import tracemalloc

import numpy as np
import pytest
from made_loops import RING, closed

from stereovox.correct.loops import _search, search
from stereovox.correct.loops.drift import difference
from stereovox.correct.loops.search import Search
from stereovox.geometry.se3 import inverse, rotation_matrix


def naive_scores(grid, cells, window):
    """Return the sum of `grid` over all cells, shifted by each of a window; beyond the grid is 0."""
    found = np.zeros(window, int)
    for shift in np.ndindex(*window):
        for cell in cells:
            place = tuple(cell + np.array(shift) - np.array(window) // 2)
            if all(0 <= i < size for i, size in zip(place, grid.shape, strict=True)):
                found[shift] += grid[place]
    return found


def test_scores_are_those_of_the_slow_twin():
    random = np.random.default_rng(0)
    grid = random.integers(-2, 3, (7, 5, 4)).astype(np.int8)
    cells = random.integers(-3, 9, (30, 3)).astype(np.int32)
    found = np.empty((5, 7, 3), np.int32)
    _search.scores(np.ascontiguousarray(grid.transpose(0, 2, 1)), cells, found)
    np.testing.assert_array_equal(found.transpose(0, 2, 1), naive_scores(grid, cells, (5, 3, 7)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_submap_is_found_on_itself_from_a_wrong_guess(seed):
    closer = closed(RING)
    submap = closer.submaps[10]
    shape = closer.shapes[submap]
    level = np.eye(4)
    level[:3, :3] = submap.T_map_anchor[:3, :3]
    random = np.random.default_rng(seed)
    wrong = np.eye(4)
    wrong[:3, :3] = rotation_matrix([0, 0, random.uniform(-0.4, 0.4)])
    wrong[:3, 3] = random.uniform(-1, 1, 3) * [1.5, 1.5, 0.4]
    guess = inverse(level) @ wrong @ level
    search = Search(shape.points, shape.views, level[:3, :3])
    places = search.places(shape, guess, np.array([2.0, 2.0, 0.6]), 0.6)
    off = np.array([difference(np.eye(4), T) for T in places])
    assert np.linalg.norm(off[0, 3:]) < 0.35
    assert np.linalg.norm(off[0, :3]) < np.radians(8)
    assert len(places) <= 4
    again = [np.linalg.norm(one[3:] - other[3:]) for i, one in enumerate(off) for other in off[:i]]
    assert not again or min(again) > 0.2  # no place is given twice


def test_what_views_looked_through_is_that_of_each_cell():
    closer = closed(RING, 0, 90)
    shape, level = closer.shapes[closer.submaps[5]], rotation_matrix([0.3, 0.2, 0.1])
    found = Search(shape.points, shape.views, level)
    free = 0
    for cell in np.argwhere(found._grid <= 0)[::7]:  # no surface there, or beside
        middle, through = level.T @ ((cell + found._low + 0.5) * found._cell), False
        for view in shape.views:
            x, y, z = (inverse(view.T) @ [*middle, 1])[:3]
            if z > found._cell and max(abs(x / z / view.slope[0]), abs(y / z / view.slope[1])) < 1:
                rows, columns = view.nearest.shape
                row, column = (y / z / view.slope[1] + 1) / 2 * rows, (x / z / view.slope[0] + 1) / 2 * columns
                nearest = view.nearest[int(row), int(column)]
                through |= bool(np.isfinite(nearest) and z < nearest - search.BEHIND_M)
        assert (found._grid[tuple(cell)] == search.THROUGH) == through
        free += through
    assert free > 20


def test_a_large_grid_needs_little_memory_and_its_parts_are_as_the_whole(monkeypatch):
    closer = closed(RING)
    shape = closer.shapes[closer.submaps[10]]
    whole = Search(shape.points, shape.views, np.eye(3))
    monkeypatch.setattr(search, "AT_ONCE", 500)
    assert (whole._grid == search.THROUGH).any()
    np.testing.assert_array_equal(Search(shape.points, shape.views, np.eye(3))._grid, whole._grid)
    monkeypatch.undo()
    corners = np.array([[0.0, 0, 0], [60, 60, 20]])
    tracemalloc.start()
    cells = Search(corners, shape.views, np.eye(3))._grid.size
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert cells > 8e6
    assert peak < 20 * cells
