"""A quadrotor reaches velocities, keeps its height, and leans where it pulls."""

import numpy as np
import pytest

from stereovox.geometry.se3 import rigidity_error
from stereovox_lab.flights.quadrotor import Airframe, Quadrotor


def test_it_reaches_a_velocity_and_stops_within_its_acceleration():
    quad = Quadrotor(np.array([0, 0, 1.0]), 0.0)
    speeds = []
    for _ in range(150):
        quad.step(np.array([0.0, 2.0]), 1.0, 0.0, 0.02)
        speeds.append(quad.velocity[1])
    assert quad.velocity == pytest.approx([0, 2, 0], abs=0.02)
    assert max(speeds) < 2.4
    assert np.diff(speeds).max() <= Airframe().max_accel * 0.02 + 1e-9
    before = quad.position.copy()
    for _ in range(300):
        quad.step(np.zeros(2), 1.5, 0.1, 0.02)
    assert 2 * 2 / (2 * 3) < quad.position[1] - before[1] < 2.0
    assert quad.position[2] == pytest.approx(1.5, abs=0.01)
    assert quad.yaw == pytest.approx(0.6)


def test_it_leans_where_it_pulls():
    quad = Quadrotor(np.zeros(3), np.pi / 2)
    assert quad.T_world_body[:3, :3].round(12).tolist() == [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    for _ in range(20):
        quad.step(np.array([0.0, 5.0]), 0.0, 0.0, 0.02)
    T = quad.T_world_body
    assert rigidity_error(T) < 1e-9
    assert T[2, 2] < -0.1  # nose down while it speeds up
    for _ in range(40):
        quad.step(np.array([0.0, -5.0]), 0.0, 0.0, 0.02)
    assert quad.T_world_body[2, 2] > 0.1
