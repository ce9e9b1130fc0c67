# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.config.robot import AmclConfig
from stereovox.geometry import se2
from stereovox.localize.amcl.particles import moved, turn_go_turn

NOISY = AmclConfig(alpha1=0.02, alpha2=0.005, alpha3=0.004, alpha4=0.006)
SURE = AmclConfig(alpha1=0, alpha2=0, alpha3=0, alpha4=0)


@pytest.mark.parametrize("step", [(0.5, 0.2, 0.6), (0.3, -0.4, 3.0), (0, 0, -1.2)])
def test_moments_are_those_of_the_table(step):
    start = np.array([2.0, -1.0, 0.9])
    motion = turn_go_turn(start, se2.compose(start, step))
    first, way, second = motion
    particles = moved(np.tile(start, (200_000, 1)), motion, NOISY, np.random.default_rng(0))
    a1, a2, a3, a4 = 0.02, 0.005, 0.004, 0.006
    folded = [min(abs(turn), np.pi - abs(turn)) for turn in (first, second)]
    variance_way = a3 * way**2 + a4 * (folded[0] ** 2 + folded[1] ** 2)
    variance_first, variance_second = (a1 * turn**2 + a2 * way**2 for turn in folded)
    local = se2.relative(start, particles)
    if way > 0.1:
        direction = se2.wrapped(np.arctan2(local[:, 1], local[:, 0]) - first)
        length = np.hypot(local[:, 0], local[:, 1])
        assert abs(length.mean() - way) < 0.001
        assert np.isclose(length.var(), variance_way, rtol=0.02)
        assert abs(direction.mean()) < 0.001
        assert np.isclose(direction.var(), variance_first, rtol=0.02)
    turn = se2.wrapped(local[:, 2] - first - second)
    assert abs(turn.mean()) < 0.002
    assert np.isclose(turn.var(), variance_first + variance_second, rtol=0.02)


def test_without_noise_particles_move_as_the_odometry_did():
    rng = np.random.default_rng(1)
    before, after = rng.uniform(-3, 3, (2, 20, 3))
    particles = rng.uniform(-3, 3, (5, 3))
    for a, b in zip(before, after, strict=True):
        found = moved(particles, turn_go_turn(a, b), SURE, rng)
        expected = se2.compose(particles, se2.relative(a, b))
        assert np.allclose(found[:, :2], expected[:, :2])
        assert np.allclose(se2.wrapped(found[:, 2] - expected[:, 2]), 0)


def test_driving_backwards_is_no_turn():
    motion = turn_go_turn(np.zeros(3), np.array([-0.5, 0.0, 0.0]))
    only_turns = AmclConfig(alpha1=0.2, alpha2=0, alpha3=0, alpha4=0.2)
    particles = moved(np.zeros((100, 3)), motion, only_turns, np.random.default_rng(0))
    assert np.allclose(particles, [-0.5, 0, 0], atol=1e-9)


def test_a_turn_on_the_spot_has_no_direction():
    assert np.allclose(turn_go_turn(np.zeros(3), np.array([0.0, 0.004, 0.7])), [0, 0.004, 0.7])
