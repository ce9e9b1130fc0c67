# SPDX-License-Identifier: Apache-2.0
"""AMCL's particle set: resampling, clustering, and recovery when the robot is lost."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from stereovox.config.robot import AmclConfig
from stereovox.geometry import se2
from stereovox.geometry.se2 import Pose
from stereovox.localize.amcl import _amcl

NEIGHBOURS = np.array([step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)])
"""Half of a bin's 26 neighbours; the other half is covered from the neighbours' side."""


class Recovery:
    """A long and a short memory of how well scans fit the map.

    strangers: share of particles that should be drawn at random, `max(0, 1 - short / long)`; 0 below `recovery_least`.

    The memories average the likelihood per beam, the K-th root of that of K beams, so that the number of beams does not
    matter. Early on both are the plain mean of all observations, so that a start from anywhere fades.
    """

    def __init__(self, config: AmclConfig):
        self._alpha_slow, self._alpha_fast = config.alpha_slow, config.alpha_fast
        self._least = config.recovery_least
        self._long = self._short = 0.0
        self._seen = 0

    def observe(self, log_likelihood: NDArray[np.float64], weights: NDArray[np.float64], beams: int) -> None:
        """Add (N,) log likelihoods of `beams` beams, by particles whose weights sum to 1."""
        if self._alpha_slow <= 0 or self._alpha_fast <= 0:
            return
        best = log_likelihood.max()
        per_beam = float(np.exp((best + np.log(weights @ np.exp(log_likelihood - best))) / beams))
        self._seen += 1
        self._long += max(self._alpha_slow, 1 / self._seen) * (per_beam - self._long)
        self._short += max(self._alpha_fast, 1 / self._seen) * (per_beam - self._short)

    @property
    def strangers(self) -> float:
        """Share of particles to be drawn at random, 0 to 1."""
        share = 1 - self._short / self._long if self._long > 0 else 0.0
        return share if share > self._least else 0.0


def particles_needed(bins: int, error: float, z: float) -> float:
    """Return how many particles keep a distribution over `bins` bins within `error` of the true one.

    error: Kullback-Leibler distance; z: upper quantile of the normal distribution (2.33 for 99 %). Fox 2003, Eq 7.
    """
    if bins < 2:
        return 1.0
    share = 2 / (9 * (bins - 1))
    return (bins - 1) / (2 * error) * (1 - share + np.sqrt(share) * z) ** 3


def low_variance(weights: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    """Return the (count,) indices of particles drawn by (N,) weights of sum 1 (table 4.4).

    offset: 0 to 1, the one random number. Each particle is drawn `count` times its weight, rounded up or down.
    """
    ends = np.cumsum(weights)
    places = (np.arange(count) + offset) * (ends[-1] / count)
    last = np.searchsorted(ends, ends[-1])  # the last with weight: rounding may reach the very end
    return np.minimum(np.searchsorted(ends, places, side="right"), last)


def bin_indices(particles: Pose, config: AmclConfig) -> NDArray[np.int64]:
    """Return the (N, 3) bins of x, y and yaw of (N, 3) particles; yaw wraps around."""
    round_ = yaw_bins(config)
    turn = np.floor(particles[:, 2] * (round_ / (2 * np.pi))).astype(np.int64) % round_
    across = np.floor(particles[:, :2] / config.kld_bin).astype(np.int64)
    return np.column_stack([across, turn])


def yaw_bins(config: AmclConfig) -> int:
    """Return the number of yaw bins in a full turn: of the requested width, or slightly wider."""
    return max(int(360 / config.kld_bin_deg + 1e-9), 1)


def bin_keys(indices: NDArray[np.int64], round_: int) -> NDArray[np.int64]:
    """Return one (N,) number for each (N, 3) bin; `round_`: bins per full turn. Good for 2^27 bins along x and y."""
    return ((indices[:, 0] << 28) + indices[:, 1]) * round_ + indices[:, 2]


def draw(
    weights: NDArray[np.float64],
    bins: NDArray[np.int64],
    config: AmclConfig,
    offset: float,
    strangers: float = 0.0,
    weights_strangers: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of particles to keep and of strangers to add: as many as their spread requires.

    weights: (N,) of sum 1; bins: (N + M,) int64, bin index of each particle and stranger, from 0.
    strangers: share of strangers among the new particles; weights_strangers: their (M,) weights of sum 1.
    offset: 0 to 1, the one random number.

    The number grows until it suffices for the bins drawn (table 8.4), in rounds instead of one by one, because low
    variance sampling needs it beforehand.
    """
    few, many = config.particles_min, config.particles_max
    count = few
    while True:
        foreign, taken = 0, np.empty(0, np.int64)
        if weights_strangers is not None and (foreign := round(strangers * count)):
            taken = low_variance(weights_strangers, foreign, offset)
        kept = low_variance(weights, count - foreign, offset)
        hit = np.zeros(int(bins.max()) + 1, bool)
        hit[bins[kept]] = True
        hit[bins[len(weights) + taken]] = True
        needed = int(np.ceil(particles_needed(int(hit.sum()), config.kld_error, config.kld_z)))
        if count >= min(needed, many):
            return kept, taken
        count = min(needed, many)


class Clusters:
    """Particles sorted into bins, and bins into clusters of adjacent bins (also across 360 degrees).

    bins: (N,) int64, index of each particle's bin, from 0; cluster: (N,) int64, index of each particle's cluster.
    """

    def __init__(self, particles: se2.Pose, config: AmclConfig):
        indices = bin_indices(particles, config)
        keys = bin_keys(indices, yaw_bins(config))
        distinct, first, self.bins = np.unique(keys, return_index=True, return_inverse=True)
        joined = np.empty(len(distinct), np.int64)
        _amcl.join(indices[first], distinct, yaw_bins(config), NEIGHBOURS, joined)
        self.cluster = joined[self.bins]

    def heaviest(self, weights: NDArray[np.float64]) -> tuple[NDArray[np.bool_], float]:
        """Return which particles are in the heaviest cluster, (N,) bool, and its share of the total weight."""
        sums = np.bincount(self.cluster, weights)
        best = int(sums.argmax())
        return self.cluster == best, float(sums[best] / sums.sum())


def mean_pose(particles: se2.Pose, weights: NDArray[np.float64]) -> se2.Pose:
    """Return the (3,) weighted mean of (N, 3) particles; yaw as a circular mean."""
    total = weights.sum()
    x, y = weights @ particles[:, :2] / total
    return np.array([x, y, np.arctan2(weights @ np.sin(particles[:, 2]), weights @ np.cos(particles[:, 2]))])


def spread(particles: se2.Pose, weights: NDArray[np.float64], pose: se2.Pose) -> NDArray[np.float64]:
    """Return the (3, 3) weighted mean squared deviation of (N, 3) particles from a pose: its covariance."""
    off = particles - pose
    off[:, 2] = se2.wrapped(off[:, 2])
    return (off * weights[:, None]).T @ off / weights.sum()
