# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.config.robot import AmclConfig
from stereovox.localize.amcl.particles import Recovery


def fed(values, beams=5, **settings):
    """Share of strangers after scans whose likelihood per beam is `values` for every particle."""
    recovery = Recovery(AmclConfig(**settings))
    for value in values:
        recovery.observe(np.full(3, beams * np.log(value)), np.array([0.2, 0.3, 0.5]), beams)
    return recovery.strangers


def test_the_share_is_that_of_table_8_3():
    values = [1.0] * 40 + [0.2] * 3
    slow = fast = 0.0
    for seen, value in enumerate(values, 1):  # the first ones are plainly averaged
        slow += max(0.02, 1 / seen) * (value - slow)
        fast += max(0.3, 1 / seen) * (value - fast)
    expected = 1 - fast / slow
    assert expected > 0.4
    assert fed(values, alpha_slow=0.02, alpha_fast=0.3) == pytest.approx(expected)


def test_the_likelihood_is_that_of_all_particles_by_their_weights():
    recovery = Recovery(AmclConfig(alpha_slow=0.5, alpha_fast=1.0, recovery_least=0))
    recovery.observe(np.log([1.0, 1.0]), np.array([0.5, 0.5]), 2)
    recovery.observe(np.log([0.04, 0.64]), np.array([0.25, 0.75]), 2)
    now = np.sqrt(0.25 * 0.04 + 0.75 * 0.64)
    assert recovery.strangers == pytest.approx(1 - now / (0.5 + 0.5 * now))


def test_better_scans_small_changes_and_zero_rates_draw_nobody():
    rates = {"alpha_slow": 0.01, "alpha_fast": 0.5}
    assert fed([0.5] * 9 + [0.6], **rates) == 0
    assert fed([1.0] * 9 + [0.85], recovery_least=0.1, **rates) == 0
    assert fed([1.0] * 9 + [0.85], recovery_least=0.01, **rates) > 0.05
    assert fed([1.0] * 9 + [0.1], alpha_slow=0, alpha_fast=0.5) == 0
    assert Recovery(AmclConfig()).strangers == 0


def test_likelihoods_far_beyond_floats_are_fine():
    recovery = Recovery(AmclConfig(recovery_least=0))
    for _ in range(10):
        recovery.observe(np.full(2, -5000.0), np.full(2, 0.5), 60)
    recovery.observe(np.full(2, -9000.0), np.full(2, 0.5), 60)
    assert 0 < recovery.strangers <= 1
