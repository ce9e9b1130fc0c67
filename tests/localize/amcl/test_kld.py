# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy import stats

from stereovox.config.robot import AmclConfig
from stereovox.localize.amcl.particles import (
    Clusters,
    bin_indices,
    draw,
    low_variance,
    mean_pose,
    particles_needed,
    spread,
)

CONFIG = AmclConfig(particles_min=50, particles_max=5000, kld_error=0.05, kld_z=2.326348)


@pytest.mark.parametrize("bins", [2, 5, 30, 400, 5000])
def test_the_number_is_fox_s(bins):
    # Fox 2003, Eq 6: n = chi-square quantile / (2 error), of which Eq 7 is the Wilson-Hilferty approximation
    exact = stats.chi2.ppf(0.99, bins - 1) / (2 * 0.05)
    found = particles_needed(bins, 0.05, stats.norm.ppf(0.99))
    assert found == pytest.approx(exact, rel=0.03 if bins < 5 else 0.005)
    k, z = bins, stats.norm.ppf(0.99)
    printed = (k - 1) / (2 * 0.05) * (1 - 2 / (9 * (k - 1)) + (2 / (9 * (k - 1))) ** 0.5 * z) ** 3
    assert found == pytest.approx(printed)


def test_one_bin_needs_one_particle():
    assert particles_needed(1, 0.01, 2.0) == 1


def test_drawing_is_fair_and_varies_little():
    rng = np.random.default_rng(0)
    weights = rng.random(17) ** 3
    weights /= weights.sum()
    offsets = (np.arange(4000) + 0.5) / 4000
    counts = np.array([np.bincount(low_variance(weights, 40, offset), minlength=17) for offset in offsets])
    assert np.allclose(counts.mean(0), 40 * weights, atol=0.002)
    assert (np.abs(counts - 40 * weights) < 1).all()


def test_particles_without_weight_are_never_drawn():
    weights = np.array([0.0, 0.5, 0.0, 0.5, 0.0])
    for offset in (0.0, 0.5, 1 - 1e-16):
        assert set(low_variance(weights, 64, offset).tolist()) == {1, 3}


@pytest.mark.parametrize(("wide", "few"), [(0.01, True), (3.0, False)])
def test_there_are_as_many_particles_as_their_spread_needs(wide, few):
    rng = np.random.default_rng(2)
    particles = rng.normal(0.25, wide, (20_000, 3))
    weights = np.full(len(particles), 1 / len(particles))
    kept, taken = draw(weights, Clusters(particles, CONFIG).bins, CONFIG, 0.3)
    bins = len(np.unique(bin_indices(particles[kept], CONFIG), axis=0))
    needed = min(max(particles_needed(bins, 0.05, 2.326348), 50), 5000)
    assert not len(taken)
    assert len(kept) >= np.floor(needed)
    assert (len(kept) == 50) == few
    assert len(kept) <= 5000


def test_strangers_get_their_share_by_their_weights():
    particles, strangers = np.zeros((100, 3)), np.array([[9.0, 9, 0], [-9, 9, 0], [9, -9, 0]])
    bins = Clusters(np.concatenate([particles, strangers]), CONFIG).bins
    kept, taken = draw(np.full(100, 0.01), bins, CONFIG, 0.5, 0.2, np.array([0.75, 0.0, 0.25]))
    assert len(taken) == round(0.2 * (len(kept) + len(taken)))
    assert np.bincount(taken, minlength=3)[1] == 0
    assert np.bincount(taken, minlength=3)[0] > 2 * np.bincount(taken, minlength=3)[2]


def test_the_heaviest_cluster_gives_the_pose_even_across_half_a_turn():
    rng = np.random.default_rng(3)
    heavy = np.column_stack([rng.normal(1, 0.3, (300, 2)), rng.normal(np.pi, 0.1, 300)])
    many = np.column_stack([rng.normal(8, 0.3, (500, 2)), rng.normal(0, 0.1, 500)])
    particles = np.concatenate([heavy, many])
    particles[:, 2] = (particles[:, 2] + np.pi) % (2 * np.pi) - np.pi
    weights = np.concatenate([np.full(300, 0.6 / 300), np.full(500, 0.4 / 500)])
    inside, share = Clusters(particles, CONFIG).heaviest(weights)
    assert share == pytest.approx(0.6, abs=0.02)
    pose = mean_pose(particles[inside], weights[inside])
    assert np.allclose(pose[:2], 1, atol=0.05)
    assert abs(abs(pose[2]) - np.pi) < 0.02
    covariance = spread(particles[inside], weights[inside], pose)
    assert np.allclose(np.sqrt(np.diag(covariance)), [0.3, 0.3, 0.1], rtol=0.15)


def test_clusters_are_the_connected_bins():
    rng = np.random.default_rng(4)
    config = AmclConfig(kld_bin=1.0, kld_bin_deg=45.0)
    particles = np.column_stack([rng.uniform(-4, 4, (60, 2)), rng.uniform(-np.pi, np.pi, 60)])
    bins = bin_indices(particles, config)
    label = np.arange(60)  # slow: the smaller label spreads to all neighbours until nothing changes
    while True:
        before = label.copy()
        for i in range(60):
            apart = np.abs(bins - bins[i])
            apart[:, 2] = np.minimum(apart[:, 2], 8 - apart[:, 2])
            label[i] = label[(apart <= 1).all(1)].min()
        if np.array_equal(before, label):
            break
    found = Clusters(particles, config).cluster
    assert len(set(label.tolist())) > 3
    assert np.array_equal(found[:, None] == found, label[:, None] == label)
