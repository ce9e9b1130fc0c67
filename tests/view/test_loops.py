# SPDX-License-Identifier: Apache-2.0
"""The picture of loop closure shows both ways, the loops where they are, reasons, and the map before and after."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba

import stereovox as sv
from stereovox.correct.close_loops import LoopClosure
from stereovox.correct.loops.closer import Loop
from stereovox.correct.loops.submaps import Match
from stereovox.errors import StereovoxError
from stereovox.mapping.rebuild import CORRECTED, CorrectionReport
from stereovox.view.loops import AFTER, BEFORE, CLOSED, LISTED, REFUSED, WINDOW_M, loops_figure, loops_picture

FRAMES, ANCHORS = 41, np.arange(0, 41, 5)
MATCH = Match(np.eye(4), np.eye(6), 0.9, True)
WHY = "another place within reach looks the same"


def poses(drift_m):
    """Return a way along x and back, at y = 0, off by so many metres along y at its end."""
    at = np.arange(FRAMES)
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    T[:, 0, 3], T[:, 1, 3] = 20.0 - np.abs(20.0 - at), drift_m * at / (FRAMES - 1)
    return T


def closure_of(loops=(), refused=()):
    """Return a closure of loops between places by their numbers; frame 40 is where frame 0 was."""
    closed = [Loop(a, b, MATCH, 0.5, 0.01) for a, b in loops]
    doubted = [Loop(a, b, MATCH, 2.0, 0.1, f"{WHY} ({a}, {b})") for a, b in refused]
    stamps = np.arange(FRAMES, dtype=np.int64)
    return LoopClosure(stamps, poses(1.0), poses(0.0), closed, doubted, ANCHORS, CorrectionReport())


def map_of(wall_y, up="z"):
    """Return a map with a wall along x at one or several y, in cells of 0.2 m, 2 m high."""
    cells = [[x, round(y / 0.2), z] for x in range(-10, 110) for y in wall_y for z in range(10)]
    cells = np.roll(cells, 1, axis=1) if up == "x" else np.array(cells)
    voxel_map = sv.VoxelMap.from_cells(
        sv.load_config(voxel_size=0.2, up=up, **{"map.prior": 0.5}), cells, np.full(len(cells), 3.0)
    )
    voxel_map.recording = f"way{CORRECTED}"
    return voxel_map


@cache
def before_map():
    return map_of([1.0, 1.8])


@cache
def after_map():
    return map_of([1.0])


def titles(figure):
    return [axis.get_title(loc="left") for axis in figure.axes]


def panel(figure, name):
    (found,) = (axis for axis in figure.axes if name in axis.get_title(loc="left"))
    return found


def segments(axis, colour):
    """Return the ends (N, 2, 2) of lines of loops in a colour."""
    found = [one for one in axis.collections if isinstance(one, LineCollection)]
    parts = [one.get_segments() for one in found if tuple(one.get_colors()[0]) == to_rgba(colour)]
    return np.array([line for part in parts for line in part]).reshape(-1, 2, 2)


def walls(axis):
    """Return at how many y the panel shows a wall."""
    image = np.asarray(axis.images[0].get_array())
    return int(np.count_nonzero(image.mean(axis=(1, 2)) < 0.6))


def words(figure):
    return "\n".join(text.get_text() for axis in figure.axes for text in axis.texts)


def test_both_ways_and_the_loops_are_where_they_are():
    closure = closure_of([(0, 8), (1, 7)], [(2, 6)])
    axis = panel(loops_figure(closure, after_map(), before_map()), "path from above")
    ways = {line.get_color(): line.get_xydata() for line in axis.lines if len(line.get_xydata()) == FRAMES}
    np.testing.assert_allclose(ways[BEFORE], closure.T_world_before[:, :2, 3])
    np.testing.assert_allclose(ways[AFTER], closure.T_world_sensor[:, :2, 3])
    np.testing.assert_allclose(segments(axis, CLOSED)[0], [[0, 0], [0, 1]])
    np.testing.assert_allclose(segments(axis, CLOSED)[1], [[5, 0.125], [5, 0.875]])
    np.testing.assert_allclose(segments(axis, REFUSED), [[[10, 0], [10, 0]]])


def test_a_wall_that_stood_twice_stands_once():
    figure = loops_figure(closure_of([(0, 8), (1, 7)]), after_map(), before_map())
    before, after = panel(figure, "before"), panel(figure, "after")
    assert (walls(before), walls(after)) == (2, 1)
    np.testing.assert_allclose(segments(before, CLOSED)[0], [[0, 0], [0, 1]])
    np.testing.assert_allclose(segments(after, CLOSED)[0], [[0, 0], [0, 0]])


def test_it_looks_near_where_two_places_were_most_off():
    figure = loops_figure(closure_of([(1, 7), (0, 8), (3, 5)]), after_map(), before_map())
    for name in ("before", "after"):
        low, high = panel(figure, name).get_xlim()
        assert (low + high) / 2 == pytest.approx(0.0)
        assert high - low == pytest.approx(WINDOW_M + 2.0)
    (box,) = panel(figure, "path from above").patches
    assert box.get_width() == pytest.approx(WINDOW_M + 2.0)


def test_numbers_and_reasons_are_said():
    refused = [(0, n) for n in range(1, LISTED + 3)]
    figure = loops_figure(closure_of([(0, 8), (1, 7)], refused), after_map(), before_map())
    heading, facts = (text.get_text() for text in figure.texts)
    assert heading == "Loop closure: way"
    assert f"2 loops closed, {LISTED + 2} refused" in facts
    assert "off by up to 0.50 m" in facts
    assert "41 frames moved by 0.50 m (median), at most 1.00 m" in facts
    assert f"{WHY} (0, {LISTED})" in words(figure)
    assert f"{WHY} (0, {LISTED + 1})" not in words(figure)
    assert "and 2 more refused" in words(figure)
    numbers = [text.get_text() for text in panel(figure, "path from above").texts]
    assert numbers == [str(n) for n in range(1, LISTED + 1)]


def test_numbers_at_one_place_do_not_lie_on_each_other():
    figure = loops_figure(
        closure_of([(0, 8)], [(0, 2), (1, 2), (3, 2), (4, 2), (5, 6), (7, 6)]), after_map(), before_map()
    )
    figure.draw_without_rendering()
    discs = [text.get_bbox_patch().get_window_extent() for text in panel(figure, "path from above").texts]
    assert len(discs) == 6
    assert not any(one.overlaps(other) for one, other in combinations(discs, 2))


def test_without_loops_it_says_so_and_shows_no_map():
    figure = loops_figure(closure_of(refused=[(0, 8)]), after_map(), before_map())
    assert "no loops were found" in figure.texts[1].get_text()
    assert titles(figure) == ["The camera's path from above", ""]


def test_the_map_before_may_be_left_out():
    figure = loops_figure(closure_of([(0, 8)]), after_map())
    assert "The map in the box, after" in titles(figure)
    assert "The map in the box, before" not in titles(figure)


def test_from_above_is_along_up():
    figure = loops_figure(closure_of([(0, 8)]), map_of([1.0], up="x"))
    axis = panel(figure, "path from above")
    assert (axis.get_xlabel(), axis.get_ylabel()) == ("y [m]", "z [m]")
    np.testing.assert_allclose(segments(axis, CLOSED), [[[0, 0], [1, 0]]])


def test_nothing_known_there_is_no_mistake():
    figure = loops_figure(closure_of([(0, 8)]), sv.VoxelMap(sv.load_config()), before_map())
    assert not panel(figure, "after").images


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_files_are_written(tmp_path, ending):
    file = tmp_path / f"loops.{ending}"
    loops_picture(closure_of([(0, 8)], [(1, 7)]), after_map(), file, before_map())
    assert file.stat().st_size > 1000


def test_another_ending_is_refused(tmp_path):
    with pytest.raises(StereovoxError, match=r"\.png, \.pdf or \.svg"):
        loops_picture(closure_of([(0, 8)]), after_map(), tmp_path / "loops.gif", before_map())
