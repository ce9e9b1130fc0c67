# SPDX-License-Identifier: Apache-2.0
"""Views: whether an image belongs where it seems to fit, and which views look alike."""

from functools import cache

import numpy as np
import pytest
from made_tracks import CAMERA, SUBPIXEL, aside, hall, seen, simulated

from stereovox.frame import DepthImage
from stereovox.geometry.se3 import look_at, rotation_matrix
from stereovox.simulate.scene import Scene, box
from stereovox.track.surfaces import LOOKED_THROUGH, MIN_PATCHES
from stereovox.track.surfels import patches_of
from stereovox.track.views import GRID, _seen_through, contradiction, far_apart, stood_free, unlike, view_of, with_edges


def view(frame, T=None):
    """Return the view of a depth frame, from its true pose unless another is given."""
    depth = np.where(frame.depth > 0, frame.depth * np.float32(0.001), np.float32(np.nan))
    z = np.arange(200) / 20
    sigma = 0.002 + 3 * SUBPIXEL / CAMERA.fx / 0.05 * z * z
    patches = patches_of(DepthImage(depth, np.zeros(depth.shape, np.uint8), frame.camera, np.eye(4)), sigma, 20.0)
    return view_of(patches.points, patches.sigma, frame.T_world_sensor if T is None else T)


BAYS = hall([(3 * k - 6, 0.3 * k) for k in range(6)])


@cache
def frames():
    return seen(BAYS, aside(12, (0, 0.3, 0)))


@cache
def views():
    return [view(frame) for frame in frames()[::2]]


@pytest.mark.parametrize("number", range(1, 12, 2))
def test_at_its_true_place_nothing_contradicts_an_image(number):
    share, number = contradiction(view(frames()[number]), views())
    assert number > 10 * MIN_PATCHES
    assert share < LOOKED_THROUGH / 2


@pytest.mark.parametrize(
    "off",
    [(0.5, 0, 0), (-0.5, 0, 0), (0, 1.0, 0), (0, -1.0, 0), (0, 0, 0.4), (0, 0, -0.4)],
)
def test_at_a_wrong_place_surfaces_stand_where_others_looked_through(off):
    T = frames()[5].T_world_sensor.copy()
    T[:3, 3] += off
    share, _ = contradiction(view(frames()[5], T), views())
    assert share > LOOKED_THROUGH


@pytest.mark.parametrize("degrees", [-15, 15, 180])
def test_turned_the_wrong_way_it_is_contradicted_or_has_nothing_in_common(degrees):
    T = frames()[5].T_world_sensor.copy()
    T[:3, :3] = rotation_matrix([0, 0, np.radians(degrees)]) @ T[:3, :3]
    share, number = contradiction(view(frames()[5], T), views())
    assert number < MIN_PATCHES or share > LOOKED_THROUGH


def test_an_image_of_another_building_is_contradicted():
    room = simulated("room").frame(0)
    share, number = contradiction(view(room, frames()[5].T_world_sensor), views())
    assert number < MIN_PATCHES or share > 5 * LOOKED_THROUGH


def test_a_thing_that_was_not_there_contradicts_by_its_share_of_the_view():
    """Both ways: what stands in front of what others saw, and what they saw where one now looks through."""
    board = box("board", "board", (0.9, 1.2, 0.4), (1.0, 1.9, 1.6))
    (frame,) = seen(Scene([*BAYS.solids, board]), [frames()[5].T_world_sensor])
    share, _ = contradiction(view(frame), views())
    assert share > 2 * LOOKED_THROUGH
    share, _ = contradiction(view(frames()[5]), [view(frame)])
    assert share > 2 * LOOKED_THROUGH


def test_a_view_holds_the_nearest_depth_of_each_place():
    """Against a loop over the points; of two in one place the nearer counts."""
    one = view(frames()[3])
    expected = np.full(GRID, np.inf)
    for x, y, z in one.points.astype(float):
        across, down = (1 + x / z / one.slope[0]) / 2 * GRID[1], (1 + y / z / one.slope[1]) / 2 * GRID[0]
        place = int(np.floor(down)), int(np.floor(across))
        expected[place] = min(expected[place], z)
    there = np.isfinite(expected)
    assert there.mean() > 0.5
    differ = np.abs(one.depth[there] - expected[there]) > 1e-5
    assert differ.mean() < 0.002  # points on the border of two places
    assert np.all(np.isnan(one.depth[~there]))


def test_views_are_alike_by_how_near_they_were_taken():
    room = [view(simulated("room").frame(i)) for i in (0, 1, 4, 60)]
    apart = [unlike(room[0], other) for other in room]
    assert apart[0] == 0
    assert 0 < apart[1] < apart[2] < apart[3]
    empty = views()[0]._replace(depth=np.full(GRID, np.nan, np.float32))
    assert unlike(views()[0], empty) == np.inf


def test_poses_are_far_apart_by_metres_or_by_angle():
    here, aside_ = look_at((0, 0, 0), (1, 0, 0)), look_at((0.2, 0, 0), (1, 0, 0))
    turned = look_at((0, 0, 0), (np.cos(0.2), np.sin(0.2), 0))
    assert not far_apart(here, here, 0.1, 0.1)
    assert far_apart(here, aside_, 0.15, 3.0)
    assert not far_apart(here, aside_, 0.25, 0.1)
    assert far_apart(here, turned, 1.0, 0.15)
    assert not far_apart(here, turned, 1.0, 0.25)


def test_what_stands_where_views_looked_through_is_told_apart():
    """A patch before a wall that was seen stands free; the wall, what is behind and what is next to do not."""
    wall = np.stack(np.meshgrid(np.linspace(-1, 1, 60), np.linspace(-0.75, 0.75, 45)), -1).reshape(-1, 2)
    points = np.column_stack([wall, np.full(len(wall), 2.0)]).astype(np.float32)
    view = view_of(points, np.full(len(points), 0.005, np.float32), np.eye(4))
    asked = np.array([[0, 0, 1.2], [0, 0, 2.0], [0, 0, 3.0], [5, 0, 1.2], [0.3, 0.2, 1.95]], np.float32)
    free = stood_free(asked, np.full(5, 0.005, np.float32), np.eye(4), [view])
    assert free.tolist() == [True, False, False, False, False]
    assert not stood_free(asked, np.full(5, 0.005, np.float32), np.eye(4), []).any()


def test_a_camera_that_sees_all_round_has_a_view_of_what_is_ahead():
    aside = np.linspace(-np.pi, np.pi, 2000, endpoint=False)
    points = np.stack([2 * np.sin(aside), np.linspace(-1, 1, 2000), 2 * np.cos(aside)], axis=1).astype(np.float32)
    found = view_of(points, np.full(2000, 0.01, np.float32), np.eye(4))
    assert np.isfinite(found.depth).sum() > 20
    assert found.slope.max() < 5
    behind = view_of(-np.abs(points), np.full(2000, 0.01, np.float32), np.eye(4))
    assert not np.isfinite(behind.depth).any()


@pytest.mark.parametrize("step", [1, 3])
def test_what_is_seen_through_is_counted_as_by_a_plain_loop(step):
    one, other = views()[1], views()[3]
    T, counts = np.linalg.inv(other.T) @ one.T, [0, 0]
    for point, sigma in zip(one.points[::step].astype(float), one.sigma[::step], strict=True):
        x, y, z = T[:3, :3] @ point + T[:3, 3]
        if z <= 0.05:
            continue
        column = int(np.floor((x / z / other.slope[0] + 1) / 2 * GRID[1]))
        row = int(np.floor((y / z / other.slope[1] + 1) / 2 * GRID[0]))
        if 0 <= row < GRID[0] and 0 <= column < GRID[1] and np.isfinite(other.depth[row, column]):
            away = other.depth[row, column] - z
            slack = 4 * sigma + 0.04 * other.depth[row, column]
            counts[0] += away > slack
            counts[1] += abs(away) <= slack
    assert counts[1] > 100
    assert _seen_through(one, other, 4.0, step) == pytest.approx(counts, abs=1)


def test_what_is_next_to_something_that_moves_moves_too_and_the_wall_behind_it_does_not():
    """A board of which one half stands where nobody had looked."""
    across, down = np.meshgrid(np.linspace(-1, 1, 80), np.linspace(-0.7, 0.7, 56))
    board = (np.abs(across) < 0.2) & (np.abs(down) < 0.3)
    depth = np.where(board, 1.0, 2.0)
    points = np.stack([across * depth, down * depth, depth], -1).reshape(-1, 3).astype(np.float32)
    free = (board & (across > -0.1)).ravel()
    grown = with_edges(free, points, np.eye(4))
    assert grown[free].all()
    assert grown[board.ravel()].mean() > 0.95 > free[board.ravel()].mean()
    assert not grown[~board.ravel()].any()
