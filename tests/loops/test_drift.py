# SPDX-License-Identifier: Apache-2.0
"""What drift allows covers what simulated trackers do."""

import numpy as np
import pytest

from stereovox.loops.closer import difference
from stereovox.loops.drift import Drift, length
from stereovox.se3 import inverse
from stereovox.simulate.simulation import Simulation


@pytest.mark.parametrize("share", [0.01, 0.03])
def test_a_drifting_tracker_is_as_far_off_as_drift_allows(share):
    drift, squared = Drift(share, np.radians(10 * share)), []
    for seed in range(12):
        walk = Simulation(f"sim:loop?length=40&laps=1&image_width=16&drift={share}&seed={seed}")
        first, last = 5, len(walk) - 1
        exact = inverse(walk.true_pose(first)) @ walk.true_pose(last)
        off = difference(exact, inverse(walk.pose(first)) @ walk.pose(last))
        covariance = drift.covariance(*length([walk.pose(i) for i in range(first, last + 1, 5)]))
        squared.append(off[3:] @ np.linalg.solve(covariance[3:, 3:], off[3:]) / 3)
    assert 0.02 < np.mean(squared) < 3
    assert max(squared) < 9


def test_covariance_grows_with_the_way():
    drift = Drift(0.01, 0.002)
    for near, far in ((0, 1), (1, 10), (10, 100)):
        assert (np.diag(drift.covariance(near)) < np.diag(drift.covariance(far))).all()
    assert np.isclose(drift.shift_m(20), 0.01 * np.sqrt(5 * 20))
