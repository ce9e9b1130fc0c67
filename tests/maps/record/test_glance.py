# SPDX-License-Identifier: Apache-2.0
"""Two glances compared: things stay in the world, faults stay with the sensor, noise stays nowhere."""

import numpy as np
import pytest

from stereovox.geometry.se3 import rotation_matrix
from stereovox.maps.record import _glance
from stereovox.maps.record.glance import AT_REST, SIDE, Glance, binned, marks_of

TOLERANCE = 0.15


def rays(count=40, half=0.7):
    x, y = np.meshgrid(*[np.linspace(-half, half, count)] * 2)
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def walls(T, depth=4.0):
    """A box of half side `depth` around the world's origin, seen from T: points (N, 3) in the sensor's frame."""
    d = rays() @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        far = np.min(np.where(d > 0, depth - T[:3, 3], -depth - T[:3, 3]) / d, axis=1)
    return rays() * far[:, None]


def at(x=0.0, z=0.0, yaw=0.0):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0, yaw, 0]), [x, 0, z]
    return T


def shares(before, after, T):
    found = before.votes(after, T, np.full(len(after), TOLERANCE))
    return np.array(found) / max(sum(found), 1)


MOTIONS = {"ahead": at(z=0.6), "aside and turned": at(x=0.4, yaw=0.5)}


@pytest.mark.parametrize("T", MOTIONS.values(), ids=list(MOTIONS))
def test_what_is_in_the_world_stays_there(T):
    world, sensor, neither, both = shares(Glance.at(walls(at()), at()), walls(T), T)
    assert world > 0.3
    assert sensor + neither < 0.1  # surfaces that are seen edge on
    assert both < 0.7


@pytest.mark.parametrize("T", MOTIONS.values(), ids=list(MOTIONS))
def test_what_is_in_the_sensor_moves_with_it(T):
    stuck = walls(at())
    world, sensor, neither, _ = shares(Glance.at(stuck, at()), stuck, T)
    assert sensor > 0.3
    assert world + neither < 0.05


def test_noise_is_nowhere_twice():
    random = np.random.default_rng(0)
    one, two = (rays() * random.uniform(0.5, 20, (1600, 1)) for _ in range(2))
    world, sensor, neither, both = shares(Glance.at(one, at()), two, at(z=0.6))
    assert neither > 0.5
    assert world + sensor + both < 0.5


def test_a_sensor_at_rest_tells_nothing():
    assert shares(Glance.at(walls(at()), at()), walls(at()), at())[3] == 1


def test_what_was_out_of_view_does_not_vote():
    T = at(yaw=np.pi)
    assert sum(Glance.at(walls(at()), at()).votes(walls(T), T, np.full(1600, TOLERANCE))) == 0


def bins(points):
    """Row and column (N,) of the bins of directions (N, 3), in float64."""
    x, y, z = (points / np.abs(points).sum(axis=1, keepdims=True)).T
    a = np.where(z < 0, (1 - np.abs(y)) * np.where(x < 0, -1, 1), x)
    b = np.where(z < 0, (1 - np.abs(x)) * np.where(y < 0, -1, 1), y)
    return [np.clip(((side + 1) / 2 * SIDE).astype(int), 0, SIDE - 1) for side in (b, a)]


def slowly_placed(ranges, points, tolerance):
    """The places of points among ranges, one by one."""
    found = []
    for v, u, far, off in zip(*bins(points), np.linalg.norm(points, axis=1), tolerance, strict=True):
        around = ranges[max(v - 1, 0) : v + 2, max(u - 1, 0) : u + 2]
        around = around[around > 0]
        if ranges[v, u] == 0:
            found.append(_glance.UNSEEN)
        else:
            between = around.min() - off <= far <= around.max() + off
            same = np.abs(around - far).min() <= off or (between and np.ptp(around) <= 0.3 * far)
            found.append(_glance.SAME if same else _glance.ELSEWHERE)
    return np.array(found)


DIRECTIONS = np.random.default_rng(1).normal(size=(4000, 3))
DIRECTIONS = (DIRECTIONS / np.linalg.norm(DIRECTIONS, axis=1)[:, None]).astype(np.float32)


def test_each_direction_has_its_bin_and_neighbours_are_near():
    v, u = bins(DIRECTIONS)
    ranges = binned(2 * DIRECTIONS)
    rows, columns = np.nonzero(ranges)
    assert len(set(zip(rows, columns, strict=True)) ^ set(zip(v, u, strict=True))) < 20  # on the edge of two
    assert ranges[ranges > 0] == pytest.approx(2, abs=1e-5)
    order = np.lexsort((u, v))
    same = (np.diff(v[order]) == 0) & (np.diff(u[order]) == 0)
    cosines = (DIRECTIONS[order][1:] * DIRECTIONS[order][:-1]).sum(axis=1)[same]
    assert np.degrees(np.arccos(np.clip(cosines.min(), -1, 1))) < 4


def test_points_are_placed_as_one_does_by_hand():
    random = np.random.default_rng(2)
    ranges = binned(DIRECTIONS[::2] * random.uniform(1, 1.6, (2000, 1)))
    points = (DIRECTIONS * random.uniform(0.7, 1.8, (4000, 1))).astype(np.float32)
    found = np.empty(4000, np.uint8)
    _glance.place(ranges, points, AT_REST, np.full(4000, TOLERANCE, np.float32), found)
    assert (found != slowly_placed(ranges, points.astype(float), np.full(4000, TOLERANCE))).mean() < 2e-3
    assert set(found.tolist()) == {0, 1, 2}


def test_pixels_are_binned_as_their_points_are():
    depth = np.random.default_rng(3).uniform(1, 5, (30, 40)).astype(np.float32)
    depth[3, 3], depth[4, 4], depth[5, 5] = np.nan, np.inf, 0
    columns, rows = np.linspace(-1, 1, 40, dtype=np.float32), np.linspace(-0.7, 0.7, 30, dtype=np.float32)
    rays = np.stack(np.broadcast_arrays(columns, rows[:, None], np.float32(1)), axis=-1)
    points = (rays * depth[..., None])[1::3, 1::3].reshape(-1, 3)
    far = np.linalg.norm(points, axis=1)
    ranges = np.zeros((SIDE, SIDE), np.float32)
    _glance.bin_image(depth, columns, np.stack([rows, np.ones_like(rows)], axis=1), 1, 3, np.float32(4), ranges)
    assert ranges == pytest.approx(binned(points[(far > 0) & (far <= 4)]), rel=1e-6)


@pytest.mark.parametrize("T", MOTIONS.values(), ids=list(MOTIONS))
def test_marks_are_points_of_what_was_seen(T):
    marks = marks_of(Glance.at(walls(T), T))
    assert 100 < len(marks.world) <= 300
    assert np.abs(marks.world).max(axis=1) == pytest.approx(4, abs=0.2)  # on the walls, in the middle of a bin
    assert marks.world == pytest.approx(marks.sensor @ T[:3, :3].T + T[:3, 3], abs=1e-5)


def test_it_is_the_same_after_it_was_saved():
    glance = Glance.at(walls(at()), at(0.1, 0.2, 0.3))
    assert Glance.unpacked(glance.pose, glance.packed()) == glance
    assert len(glance.packed()) < 8000
