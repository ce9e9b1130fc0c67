# SPDX-License-Identifier: Apache-2.0
"""A second odometry, as of wheels, holds a way that drifts, and is not believed where it contradicts."""

import numpy as np
import pytest
from made_loops import ELSEWHERE, blind, follow, off, truths

from stereovox.config import load_config
from stereovox.correct.loops.closer import LoopCloser
from stereovox.correct.loops.drift import MAX_OFF_M, Odometry, difference, moved_by
from stereovox.errors import StereovoxError
from stereovox.geometry.pose_graph import information
from stereovox.geometry.se3 import rotation_matrix
from stereovox.simulate.simulation import Simulation
from stereovox.sources.poses.poses import Poses

WALK = "sim:loop?length=30&laps=1&image_width=106&drift=0.06&seed=5"
WALK_DRIFT = {"loops.drift": 0.06, "loops.drift_deg": 0.3}


def wheels(length=230, jump=None):
    """Return nearly exact poses in another world; after frame `jump` they are 2 m off, as where a robot is carried."""
    walk = Simulation(WALK)
    poses = np.array([ELSEWHERE @ walk.true_pose(i) for i in range(length)])
    poses[jump or length :, 0, 3] += 2
    return Poses([i * walk.period_ns for i in range(length)], poses)


def closer(poses=None, **settings):
    config = load_config(**{**WALK_DRIFT, **settings})
    closer = blind(LoopCloser(config, None if poses is None else Odometry(poses, config.loops)))
    follow(closer, WALK, 230)
    closer.finish()
    return closer


def off_by(closer):
    return off([submap.T_map_anchor for submap in closer.submaps], truths(closer, WALK))


def test_a_way_that_drifts_is_held():
    alone, held = closer(), closer(wheels(), **{"loops.odometry_drift": 0.002, "loops.odometry_drift_deg": 0.02})
    assert off_by(alone) > 0.15
    assert off_by(held) < 0.2 * off_by(alone)
    assert held._odometry.summary() == {"used": len(held.submaps) - 1, "contradicted": 0}


def test_a_step_of_which_they_say_different_things_is_held_softly():
    exact = closer(wheels())  # at the usual drift of wheels
    assert exact._odometry.contradicted == 0
    jumped = closer(wheels(jump=100))
    assert jumped._odometry.contradicted == 1
    step = next(n for n, one in enumerate(jumped.submaps) if one.stamp_ns >= 100 * Simulation(WALK).period_ns)
    assert off_by(jumped) < off_by(exact) + 0.05

    def weakest(closer, n):
        return np.linalg.eigvalsh(closer._steps[n - 1].information)[0]

    assert weakest(jumped, step) < 0.1 * weakest(exact, step)


def test_the_joint_motion_is_the_weighted_mean():
    """By the textbook, if there is no turn: precision adds up, and each counts by its own."""
    config = load_config(**{"loops.odometry_drift": 0.1}).loops
    motion, other = np.eye(4), np.eye(4)
    motion[:3, 3], other[:3, 3] = [1, 0, 0], [1.1, 0.05, 0]
    odometry = Odometry(Poses([0, 10], [ELSEWHERE, ELSEWHERE @ other]), config)
    own = np.diag([1e-4] * 3 + [0.01, 0.02, 0.03])
    theirs = odometry._drift.covariance(1.0, 0.0)
    T, covariance = odometry.joined((0, 10), motion, own, (1.0, 0.0))
    precise = np.linalg.inv(own) + np.linalg.inv(theirs)
    np.testing.assert_allclose(np.linalg.inv(covariance), precise, rtol=1e-9)
    weights = np.diag(np.linalg.inv(own) @ np.linalg.inv(precise))[3:]
    np.testing.assert_allclose(T[:3, 3], weights * motion[:3, 3] + (1 - weights) * other[:3, 3], atol=1e-12)


def test_a_motion_leads_from_one_pose_to_the_other():
    random = np.random.default_rng(0)
    for _ in range(20):
        one, other = np.eye(4), np.eye(4)
        one[:3, :3], other[:3, :3] = (rotation_matrix(random.normal(size=3)) for _ in range(2))
        one[:3, 3], other[:3, 3] = random.normal(size=(2, 3))
        np.testing.assert_allclose(moved_by(one, difference(one, other)), other, atol=1e-9)


def test_odometry_of_another_time_is_refused():
    config = load_config().loops
    odometry = Odometry(Poses([0, 10], [np.eye(4)] * 2, where="wheels.tum"), config)
    motion, covariance = odometry.joined((10**12, 2 * 10**12), np.eye(4), np.eye(6), (1.0, 0.0))
    assert np.array_equal(motion, np.eye(4))
    assert np.array_equal(covariance, np.eye(6))
    with pytest.raises(StereovoxError, match=r"wheels.tum: has no poses at the times"):
        odometry.check()


def test_odometry_in_another_unit_is_refused_and_can_be_solved_until_then():
    """Steps of 50 km where the camera moved by 0.5 m: all would be held by nothing."""
    config, far = load_config().loops, np.eye(4)
    far[0, 3] = 5e4
    odometry = Odometry(Poses([0, 10], [np.eye(4), far], where="wheels.tum"), config)
    _, covariance = odometry.joined((0, 10), np.eye(4), 1e-6 * np.eye(6), (0.5, 0.0))
    assert np.linalg.eigvalsh(information(covariance)).min() > 0
    assert np.linalg.eigvalsh(covariance)[-1] < 1.1 * MAX_OFF_M**2
    with pytest.raises(StereovoxError, match=r"wheels.tum: contradicts the map's poses in 1 of 1 steps.*in metres"):
        odometry.check()
