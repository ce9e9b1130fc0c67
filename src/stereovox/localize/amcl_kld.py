# SPDX-License-Identifier: Apache-2.0
"""Drawing particles anew by their weights, and how many it takes (Fox 2003; Thrun, Burgard and Fox 2005, 4.4, 8.4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.config_robot import AmclConfig
from stereovox.planar import Pose


def particles_needed(bins: int, error: float, z: float) -> float:
    """Return how many particles keep a distribution over so many bins within `error` of the true one.

    error: Kullback-Leibler distance; z: upper quantile of the normal distribution (2.33 for 99 %). Fox 2003, Eq 7.
    """
    if bins < 2:
        return 1.0
    share = 2 / (9 * (bins - 1))
    return (bins - 1) / (2 * error) * (1 - share + np.sqrt(share) * z) ** 3


def low_variance(weights: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    """Return the (count,) numbers of the particles drawn by (N,) weights of sum 1 (table 4.4).

    offset: 0 to 1, the one random number. Each particle comes `count` times its weight, rounded up or down.
    """
    ends = np.cumsum(weights)
    places = (np.arange(count) + offset) * (ends[-1] / count)
    last = np.searchsorted(ends, ends[-1])  # the last one with weight: rounding may put a place at the very end
    return np.minimum(np.searchsorted(ends, places, side="right"), last)


def bin_indices(particles: Pose, config: AmclConfig) -> NDArray[np.int64]:
    """Return the (N, 3) bins of x, y and yaw that (N, 3) particles fall into; those of yaw go once round."""
    round_ = yaw_bins(config)
    turn = np.floor(particles[:, 2] * (round_ / (2 * np.pi))).astype(np.int64) % round_
    across = np.floor(particles[:, :2] / config.kld_bin).astype(np.int64)
    return np.column_stack([across, turn])


def yaw_bins(config: AmclConfig) -> int:
    """Return how many bins go once round: as wide as asked for, or a little wider."""
    return max(int(360 / config.kld_bin_deg + 1e-9), 1)


def bin_keys(indices: NDArray[np.int64], round_: int) -> NDArray[np.int64]:
    """Return one (N,) number for each (N, 3) bin; `round_` of them go once round. Good for 2^27 bins along x and y."""
    return ((indices[:, 0] << 28) + indices[:, 1]) * round_ + indices[:, 2]


def draw(
    weights: NDArray[np.float64],
    bins: NDArray[np.int64],
    config: AmclConfig,
    offset: float,
    strangers: float = 0.0,
    weights_strangers: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the numbers of the particles to keep, and of strangers to take in: as many as their spread asks for.

    weights: (N,) of sum 1; bins: (N + M,) int64, a number for the bin of each particle and stranger, counted from 0.
    strangers: share of the new particles that shall be strangers; weights_strangers: their (M,) weights of sum 1.
    offset: 0 to 1, the one random number.

    The number grows until it is enough for the bins that were drawn (table 8.4), in rounds instead of one by one,
    since low variance needs to know it beforehand.
    """
    few, many = config.particles_min, config.particles_max
    count = few
    while True:
        foreign = round(strangers * count) if weights_strangers is not None else 0
        kept = low_variance(weights, count - foreign, offset)
        taken = low_variance(weights_strangers, foreign, offset) if foreign else np.empty(0, np.int64)  # pyright: ignore
        hit = np.zeros(int(bins.max()) + 1, bool)
        hit[bins[kept]] = True
        hit[bins[len(weights) + taken]] = True
        needed = int(np.ceil(particles_needed(int(hit.sum()), config.kld_error, config.kld_z)))
        if count >= min(needed, many):
            return kept, taken
        count = min(needed, many)
