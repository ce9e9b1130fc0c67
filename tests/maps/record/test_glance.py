# SPDX-License-Identifier: Apache-2.0
"""What two glances tell: things stay in the world, faults stay with the sensor, noise stays nowhere."""

import numpy as np
import pytest

from stereovox.geometry.se3 import rotation_matrix
from stereovox.maps.record.glance import SIDE, Glance, _bins

TOLERANCE = 0.15


def rays(count=40, half=0.7):
    x, y = np.meshgrid(*[np.linspace(-half, half, count)] * 2)
    return np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)


def walls(T, depth=4.0):
    """A box of half a side `depth` round the world's origin, seen from T: points (N, 3) in the sensor's frame."""
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


def test_each_direction_has_its_bin_and_neighbours_are_near():
    directions = np.random.default_rng(1).normal(size=(20_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    v, u = _bins(directions)
    assert min(v.min(), u.min()) >= 0
    assert max(v.max(), u.max()) < SIDE
    order = np.lexsort((u, v))
    same = (np.diff(v[order]) == 0) & (np.diff(u[order]) == 0)
    cosines = (directions[order][1:] * directions[order][:-1]).sum(axis=1)[same]
    assert np.degrees(np.arccos(np.clip(cosines.min(), -1, 1))) < 4
    assert len(np.unique(v * SIDE + u)) > 0.6 * SIDE * SIDE


def test_it_is_the_same_after_it_was_saved():
    glance = Glance.at(walls(at()), at(0.1, 0.2, 0.3))
    assert Glance.unpacked(glance.pose, glance.packed()) == glance
    assert len(glance.packed()) < 8000
