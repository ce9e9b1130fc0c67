# SPDX-License-Identifier: Apache-2.0
"""What drift allows covers what simulated trackers do."""

import numpy as np
import pytest

from stereovox.correct.loops.closer import difference
from stereovox.correct.loops.drift import Drift, PathLength
from stereovox.geometry.se3 import inverse, rotation_matrix
from stereovox.simulate.simulation import Simulation


@pytest.mark.parametrize("share", [0.01, 0.03])
def test_a_drifting_tracker_is_as_far_off_as_drift_allows(share):
    drift, squared = Drift(share, np.radians(10 * share)), []
    for seed in range(12):
        walk = Simulation(f"sim:loop?length=40&laps=1&image_width=16&drift={share}&seed={seed}")
        first, last = 5, len(walk) - 1
        exact = inverse(walk.true_pose(first)) @ walk.true_pose(last)
        off = difference(exact, inverse(walk.pose(first)) @ walk.pose(last))
        way = PathLength()
        lengths = [way.add("", walk.pose(i)) for i in range(first, last + 1, 5)]
        covariance = drift.covariance(*lengths[-1])
        squared.append(off[3:] @ np.linalg.solve(covariance[3:, 3:], off[3:]) / 3)
    assert 0.02 < np.mean(squared) < 3
    assert max(squared) < 9


def test_covariance_grows_with_the_way():
    drift = Drift(0.01, 0.002)
    for near, far in ((0, 1), (1, 10), (10, 100)):
        assert (np.diag(drift.covariance(near)) < np.diag(drift.covariance(far))).all()
    assert np.isclose(drift.shift_m(20), 0.01 * np.sqrt(5 * 20))


def test_the_way_of_a_rig_is_that_of_its_body():
    alone, together, T_front_rear = PathLength(), PathLength(), np.eye(4)
    T_front_rear[:3, :3], T_front_rear[:3, 3] = rotation_matrix([0, np.pi, 0]), [0.2, 0, -0.3]
    for x in np.linspace(0, 3, 31):
        pose = np.eye(4)
        pose[0, 3] = x
        found = alone.add("front", pose)
        both = [together.add("front", pose), together.add("rear", pose @ T_front_rear)]
    np.testing.assert_allclose([found, *both], [[3.0, 0.0]] * 3, atol=1e-6)


def test_a_sensor_that_begins_late_goes_on_with_the_way():
    way, pose = PathLength(), np.eye(4)
    way.add("front", pose)
    pose = pose.copy()
    pose[:3, :3], pose[0, 3] = rotation_matrix([0, 0, 0.5]), 2.0
    np.testing.assert_allclose(way.add("front", pose), [2.0, 0.5])
    np.testing.assert_allclose(way.add("rear", np.eye(4)), [2.0, 0.5])
    np.testing.assert_allclose(way.add("rear", pose), [4.0, 1.0])
