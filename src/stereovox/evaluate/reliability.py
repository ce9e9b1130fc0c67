# SPDX-License-Identifier: Apache-2.0
"""Calibration of probabilities: of all cells with p = 0.8, 80 % should be occupied."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BINS = 10
LIKELY = 0.3
"""Probability above which a cell is more than free: the cells that thresholds separate."""


@dataclass(frozen=True, eq=False)
class Reliability:
    """Cells binned by probability into B bins; bin i covers edges[i] <= p < edges[i + 1].

    edges: (B + 1,) from 0 to 1, rising; count: (B,) cells; mean_p, occupied_share: (B,) mean probability and share of
    truly occupied cells, NaN in an empty bin.
    """

    edges: NDArray[np.float64]
    count: NDArray[np.int64]
    mean_p: NDArray[np.float64]
    occupied_share: NDArray[np.float64]

    @property
    def ece(self) -> float | None:
        """Expected calibration error: mean of abs(mean_p - occupied_share), weighted by cells; None without cells."""
        filled = self.count > 0
        gap = np.abs(self.mean_p - self.occupied_share)[filled]
        return float(gap @ self.count[filled] / self.count.sum()) if filled.any() else None


def reliability(p: NDArray[np.floating], actual: NDArray[np.bool_], bins: int = BINS) -> Reliability:
    """Compare probabilities (N,) in [0, 1] with the true state (N,). p = 1 belongs to the last bin."""
    return _binned(np.linspace(0, 1, bins + 1), np.minimum((p * bins).astype(np.int64), bins - 1), p, actual)


def equal_mass(p: NDArray[np.floating], actual: NDArray[np.bool_], bins: int = BINS) -> Reliability:
    """Compare probabilities (N,) with the true state (N,) in bins of about as many cells each.

    A cell's bin follows the middle of its rank; cells of equal probability share a bin, so that bins may differ in
    size, or be empty.
    """
    values, of_cell, number = np.unique(p, return_inverse=True, return_counts=True)
    middle = np.cumsum(number) - number / 2
    bin_of = np.minimum((middle / max(len(p), 1) * bins).astype(np.int64), bins - 1)
    lowest = np.searchsorted(bin_of, np.arange(1, bins))
    edges = np.concatenate([[0], np.append(values, 1)[lowest], [1]])
    return _binned(edges, bin_of[of_cell], p, actual)


def _binned(
    edges: NDArray[np.float64], bin_of: NDArray[np.int64], p: NDArray[np.floating], actual: NDArray[np.bool_]
) -> Reliability:
    bins = len(edges) - 1
    count = np.bincount(bin_of, minlength=bins)
    with np.errstate(invalid="ignore"):
        mean_p = np.bincount(bin_of, p, bins) / count
        share = np.bincount(bin_of, actual, bins) / count
    return Reliability(edges, count, mean_p, share)


def brier(p: NDArray[np.floating], actual: NDArray[np.bool_]) -> float | None:
    """Return the Brier score of probabilities (N,): their mean squared error (Valenti 2018, Eq 8.7); None for N = 0."""
    return float(np.mean((p - actual) ** 2)) if len(p) else None


def correlation(p: NDArray[np.floating], actual: NDArray[np.bool_]) -> float | None:
    """Return Pearson's correlation of p (N,) and actual (N,) (Valenti 2018, Eq 8.8-8.9, its sum divided by N).

    None if one of the two does not vary.
    """
    share = float(actual.mean()) if len(p) else 0.0
    ours = p - p.mean() if 0 < share < 1 else np.zeros(1)
    spread = np.sqrt(np.mean(ours * ours) * share * (1 - share))
    return float(ours[actual].sum() / len(p) / spread) if spread > 1e-12 else None
