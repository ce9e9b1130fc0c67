# SPDX-License-Identifier: Apache-2.0
"""Lines are what a slow reference says, the search what trying everything says, and the least squares find the pose."""

import numpy as np
import pytest
from made_drives import box, ranges

from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.slam.graph import in_second_frame, without_weak
from stereovox.localize.slam.line_map import Cloud, LineMap, cloud_of, joined

ROOM = np.vstack([box(-3, -2, 4, 3), box(1, 1, 2, 1.6)])


def seen(pose, walls=ROOM, noise=0.0, step_deg=0.8, seed=0):
    rng = np.random.default_rng(seed)
    angles = np.radians(np.arange(0, 360, step_deg))
    found = ranges(walls, np.asarray(pose, float), angles, 20.0)
    found = found + noise * rng.standard_normal(len(found))
    ahead = np.column_stack([np.cos(angles), np.sin(angles)])
    hit = np.isfinite(found)
    return Cloud((found[hit, None] * ahead[hit]).astype(np.float32), (-ahead[hit]).astype(np.float32))


def test_lines_are_those_of_the_points_round_a_cell():
    cloud = seen([0, 0, 0], noise=0.01)
    made = LineMap(0.05).build(cloud)
    points, cells = cloud.points - made.corner, np.floor((cloud.points - made.corner) / 0.05).astype(int)
    assert len(made.lines) == len(np.unique(cells, axis=0))
    straight = 0
    for (row, column), line in zip(made.cells[::7], made.lines[::7], strict=True):
        own = (cells[:, 1] == row) & (cells[:, 0] == column)
        assert np.allclose(line[:2], points[own].mean(axis=0), atol=1e-5)
        towards = cloud.views[own].sum(axis=0)
        near = (np.abs(cells[:, 1] - row) <= 3) & (np.abs(cells[:, 0] - column) <= 3)
        sums = {tuple(c): cloud.views[(cells == c).all(axis=1)].sum(axis=0) for c in np.unique(cells[near], axis=0)}
        near &= np.array([tuple(c) in sums and sums[tuple(c)] @ towards >= 0 for c in cells])
        assert np.allclose(line[2:4], points[near].mean(axis=0), atol=1e-4)
        if near.sum() < 3:
            continue
        values, vectors = np.linalg.eigh(np.cov(points[near].T, bias=True))
        if values[0] < 0.1 * values[1]:
            straight += 1
            normal = vectors[:, 0] * np.sign(vectors[:, 0] @ towards)
            assert line[6] == 1
            assert np.allclose(line[4:6], normal, atol=2e-3)
        elif values[0] > 0.14 * values[1]:
            assert line[6] == 0
    assert straight > 20


def test_near_and_score_are_those_of_the_nearest_points():
    made = LineMap(0.05, reach=0.2, sigma=0.08).build(seen([0, 0, 0]))
    rows, columns = made.extent
    for row, column in [(r, c) for r in range(0, rows, 9) for c in range(0, columns, 9)]:
        middle = (np.array([column, row]) + 0.5) * 0.05
        reach = np.abs(made.cells - [row, column]).max(axis=1) <= 4
        gap = np.linalg.norm(made.lines[:, :2] - middle, axis=1)[reach]
        if not len(gap):
            assert made.near[row, column] == -1
            assert made.score[row, column] == 0
        else:
            assert made.score[row, column] == pytest.approx(1 / (1 + (gap.min() / 0.08) ** 2), rel=1e-3)
            assert gap.argmin() == np.flatnonzero(np.flatnonzero(reach) == made.near[row, column])[0]


def test_building_anew_leaves_nothing_behind():
    used, fresh = LineMap(0.05), LineMap(0.05)
    used.build(seen([0, 0, 0]))
    other = seen([1, -1, 2.0], walls=box(-1, -1, 1.5, 1.2))
    used.build(other)
    fresh.build(other)
    rows, columns = fresh.extent
    for name in ("near", "score", "index"):
        assert np.array_equal(getattr(used, name)[:rows, :columns], getattr(fresh, name)[:rows, :columns])
        assert not (getattr(used, name)[rows:] > 0).any()


def test_the_search_is_trying_everything():
    made = LineMap(0.05).build(seen([0, 0, 0]))
    cloud = seen([0.13, -0.08, 0.05], step_deg=5)
    guess = np.array([0.0, 0.0, 0.0])
    pose, top = made.search(cloud.points, guess, 0.2, 0.08, 0.02, 0.5, 0.3)
    scores = {}
    for k in range(-4, 5):
        for dr in range(-4, 5):
            for dc in range(-4, 5):
                tried = np.array([0.05 * dc, 0.05 * dr, 0.02 * k])
                turned = se2.transform([0, 0, tried[2]], cloud.points) - made.corner
                cell = np.floor(turned / 0.05).astype(int) + np.array([dc, dr])
                likely = made.score[cell[:, 1], cell[:, 0]].mean()
                scores[tuple(tried)] = likely - 0.5 * (tried[:2] ** 2).sum() - 0.3 * tried[2] ** 2
    assert top == pytest.approx(max(scores.values()), abs=1e-4)
    assert np.allclose(pose, max(scores, key=lambda tried: scores[tried]), atol=1e-6)


def test_least_squares_find_the_pose():
    made = LineMap(0.05).build(
        joined([seen([0, 0, 0], noise=0.005), seen([1, 0, 1], noise=0.005, seed=1).moved([1, 0, 1])])
    )
    true = np.array([0.4, 0.3, 0.2])
    match = made.refine(seen(true, noise=0.005, seed=2), true + np.array([0.08, -0.07, 0.04]), 0.1)
    match = made.refine(seen(true, noise=0.005, seed=2), match.pose, 0.04)
    assert np.allclose(match.pose, true, atol=[0.004, 0.004, 0.002])
    assert match.share > 0.9
    assert 0.002 < match.rms < 0.015


def test_one_wall_tells_one_direction_only():
    wall = np.array([[-10, 1.0, 10, 1.0]])
    made = LineMap(0.05).build(seen([0, 0, 0], walls=wall, step_deg=0.3))
    match = made.refine(seen([0, 0, 0], walls=wall), [0.0, 0.03, 0.0], 0.05)
    assert match.pose[1] == pytest.approx(0, abs=2e-3)
    along, across = match.information[0, 0], match.information[1, 1]
    assert along < 0.01 * across
    rest = without_weak(match.information, 0.1)
    assert abs(rest[0, 0]) < 1e-3 * across
    assert rest[1, 1] == pytest.approx(across, rel=0.02)
    square = np.diag([4.0, 3.0, 1.0])
    assert np.array_equal(without_weak(square, 0.1), square)


def test_a_prior_holds_where_walls_do_not():
    wall = np.array([[-10, 1.0, 10, 1.0]])
    made = LineMap(0.05).build(seen([0, 0, 0], walls=wall, step_deg=0.3))
    prior = np.array([0.5, 0.02, 0.0])
    match = made.refine(seen([0, 0, 0], walls=wall), [0.3, 0.0, 0.0], 0.05, prior, np.diag([1e4, 1.0, 1.0]))
    assert match.pose[0] == pytest.approx(0.5, abs=0.02)
    assert match.pose[1] == pytest.approx(0, abs=2e-3)


def test_the_other_side_of_a_wall_does_not_attract():
    wall = np.array([[-4, 1.0, 4, 1.0]])
    made = LineMap(0.05).build(seen([0, 0, 0], walls=wall))
    behind = seen([0, 2.1, 0], walls=wall + np.array([0, 0.1, 0, 0.1]))
    assert made.refine(behind, [0.0, 2.1, 0.0], 0.2).share < 0.05  # the rest: seen along the wall
    assert made.refine(seen([0, 0, 0], walls=wall), [0.0, 0.0, 0.0], 0.2).share > 0.95


def test_clouds_are_hits_in_the_robots_frame():
    values = np.array([1.0, np.nan, np.inf, -np.inf, 2.0, 40.0, 0.01], np.float32)
    mount = se2.lifted([0.3, 0.0, np.pi / 2])
    scan = Scan(values, 0.0, np.pi / 8, 0.05, 50.0, np.eye(4), mount)
    cloud = cloud_of(scan, 30.0)
    assert np.allclose(cloud.points, [[0.3, 1.0], [0.3 - 2.0, 0.0]], atol=1e-6)
    assert np.allclose(cloud.views, [[0, -1], [1, 0]], atol=1e-6)
    upside_down = np.diag([1.0, -1.0, -1.0, 1.0])
    turned = cloud_of(Scan(values, 0.0, np.pi / 8, 0.05, 50.0, np.eye(4), upside_down), 30.0)
    assert np.allclose(turned.points[1], [0.0, -2.0], atol=1e-6)


def test_information_turns_with_the_frame():
    information = np.array([[4.0, 1.0, 0.5], [1.0, 2.0, 0.2], [0.5, 0.2, 3.0]])
    yaw, small = 0.7, np.array([1e-3, -2e-3, 5e-4])
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    moved = turn @ small
    assert small @ in_second_frame(information, yaw) @ small == pytest.approx(moved @ information @ moved)
