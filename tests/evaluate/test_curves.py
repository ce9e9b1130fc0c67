# SPDX-License-Identifier: Apache-2.0
"""ROC, reliability and distance, by hand."""

import numpy as np
import pytest

import stereovox as sv
from stereovox.evaluate.curves import brier, correlation, reliability, roc, round_edges
from stereovox.evaluate.scores import score


def test_roc_by_hand():
    p, actual = np.array([0.9, 0.8, 0.8, 0.5, 0.3, 0.1]), np.array([1, 1, 0, 1, 0, 0], bool)
    curve = roc(p, actual)
    assert curve is not None
    assert curve.threshold.tolist() == [np.inf, 0.9, 0.8, 0.5, 0.3, 0.1]
    assert curve.true_positive_rate.tolist() == pytest.approx([0, 1 / 3, 2 / 3, 1, 1, 1])
    assert curve.false_positive_rate.tolist() == pytest.approx([0, 0, 1 / 3, 1 / 3, 2 / 3, 1])
    assert curve.auc == pytest.approx((3 + 2.5 + 2) / 9)  # 0.9 beats all 3, 0.8 beats 2 and ties 1, 0.5 beats 2
    assert roc(p, np.ones(6, bool)) is None
    assert roc(np.empty(0), np.empty(0, bool)) is None


def test_reliability_by_hand():
    p, actual = np.array([0.05, 0.1, 0.19, 0.95, 1.0]), np.array([0, 0, 1, 1, 0], bool)
    found = reliability(p, actual, 10)
    assert found.count.tolist() == [1, 2, 0, 0, 0, 0, 0, 0, 0, 2]
    assert found.mean_p[[0, 1, 9]] == pytest.approx([0.05, 0.145, 0.975])
    assert found.occupied_share[[0, 1, 9]] == pytest.approx([0, 0.5, 0.5])
    assert np.isnan(found.mean_p[2:9]).all()
    assert found.ece == pytest.approx((0.05 + 2 * 0.355 + 2 * 0.475) / 5)
    assert brier(p, actual) == pytest.approx((0.05**2 + 0.1**2 + 0.81**2 + 0.05**2 + 1) / 5)


def test_probabilities_drawn_as_they_say_are_calibrated():
    random = np.random.default_rng(4)
    p = random.random(200_000)
    true = random.random(len(p)) < p
    assert reliability(p, true).ece == pytest.approx(0, abs=0.005)
    assert reliability(p**2, true).ece == pytest.approx(1 / 6, abs=0.005)  # the mean of p - p^2


def test_correlation_is_numpys_and_none_where_nothing_varies():
    random = np.random.default_rng(5)
    p = random.random(500)
    actual = random.random(500) < p
    assert correlation(p, actual) == pytest.approx(np.corrcoef(p, actual)[0, 1])
    assert correlation(np.full(500, 0.1), actual) is None
    assert correlation(p, np.ones(500, bool)) is None
    assert correlation(p[:0], actual[:0]) is None


CONFIG = sv.load_config(voxel_size=1.0, **{"map.prior": 0.5})


def test_precision_and_recall_by_distance_by_hand():
    surface = [0, 2, 6, 7, 21]
    truth = sv.VoxelMap.from_cells(
        CONFIG, [[x, 0, 0] for x in range(22)], [3.0 if x in surface else -2.0 for x in range(22)]
    )
    ours = sv.VoxelMap.from_cells(CONFIG, [[x, 0, 0] for x in (0, 1, 4, 6, 10, 30)], [2.0] * 6)
    found = score(ours, truth, path=[0.5, 0.5, 0.5], edges=[0, 5, 10, 20]).distance
    assert found is not None
    # centres stand at distance x: rings 0-4, 5-9, 10-19; 21 is beyond
    assert (found.marked.tolist(), found.surface.tolist()) == ([3, 1, 1], [2, 2, 0])
    assert found.precision == pytest.approx([1 / 3, 1, 0])
    assert found.recall == pytest.approx([1 / 2, 1 / 2, np.nan], nan_ok=True)
    assert found.tolerance_precision == pytest.approx([2 / 3, 1, 0])
    assert found.tolerance_recall == pytest.approx([1, 1, np.nan], nan_ok=True)
    two = score(ours, truth, path=[[0.5, 0.5, 0.5], [21.5, 0.5, 0.5]], edges=[0, 5, 10, 20]).distance
    assert two is not None
    assert two.surface.tolist() == [3, 2, 0]  # 21 is now at distance 0


@pytest.mark.parametrize(("longest", "width", "rings"), [(20.0, 5.0, 5), (19.9, 5, 4), (80, 10, 9), (0.75, 0.1, 8)])
def test_rings_are_round_and_reach_the_farthest_cell(longest, width, rings):
    edges = round_edges(longest)
    assert np.diff(edges) == pytest.approx(width)
    assert len(edges) - 1 == rings
    assert edges[-1] > longest
