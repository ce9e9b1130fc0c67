# SPDX-License-Identifier: Apache-2.0
"""Where most of the particles agree: the heaviest cluster of neighbouring bins, as ROS's amcl takes its pose."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from stereovox import planar
from stereovox.config_robot import AmclConfig
from stereovox.localize import _amcl
from stereovox.localize.amcl_kld import bin_indices, bin_keys, yaw_bins

NEIGHBOURS = np.array([step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)])
"""Half of a bin's 26 neighbours: the other half has the bin among theirs."""


class Clusters:
    """Particles parted into bins, and these into clusters of bins that touch (also across 360 degrees).

    bins: (N,) int64, number of each particle's bin, from 0; cluster: (N,) int64, number of each particle's cluster.
    """

    def __init__(self, particles: planar.Pose, config: AmclConfig):
        indices = bin_indices(particles, config)
        keys = bin_keys(indices, yaw_bins(config))
        distinct, first, self.bins = np.unique(keys, return_index=True, return_inverse=True)
        joined = np.empty(len(distinct), np.int64)
        _amcl.join(indices[first], distinct, yaw_bins(config), NEIGHBOURS, joined)
        self.cluster = joined[self.bins]

    def heaviest(self, weights: NDArray[np.float64]) -> tuple[NDArray[np.bool_], float]:
        """Return which particles are in the heaviest cluster, (N,) bool, and its share of all weight."""
        sums = np.bincount(self.cluster, weights)
        best = int(sums.argmax())
        return self.cluster == best, float(sums[best] / sums.sum())


def mean_pose(particles: planar.Pose, weights: NDArray[np.float64]) -> planar.Pose:
    """Return the (3,) weighted mean of (N, 3) particles; that of yaw on the circle."""
    total = weights.sum()
    x, y = weights @ particles[:, :2] / total
    return np.array([x, y, np.arctan2(weights @ np.sin(particles[:, 2]), weights @ np.cos(particles[:, 2]))])


def spread(particles: planar.Pose, weights: NDArray[np.float64], pose: planar.Pose) -> NDArray[np.float64]:
    """Return the (3, 3) mean square of how far (N, 3) weighted particles are from a pose: its covariance."""
    off = particles - pose
    off[:, 2] = planar.wrapped(off[:, 2])
    return (off * weights[:, None]).T @ off / weights.sum()
