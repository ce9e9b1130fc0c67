# SPDX-License-Identifier: Apache-2.0
"""Calibration of probabilities: of all cells with p = 0.8, 80 % should be occupied."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

BINS = 10


@dataclass(frozen=True, eq=False)
class Reliability:
    """Cells binned by probability into B bins of equal width; bin i holds edges[i] <= p < edges[i + 1].

    edges: (B + 1,) from 0 to 1; count: (B,) cells; mean_p, occupied_share: (B,) mean probability and share of truly
    occupied cells, NaN in an empty bin.
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
    bin_of = np.minimum((p * bins).astype(np.int64), bins - 1)
    count = np.bincount(bin_of, minlength=bins)
    with np.errstate(invalid="ignore"):
        mean_p = np.bincount(bin_of, p, bins) / count
        share = np.bincount(bin_of, actual, bins) / count
    return Reliability(np.linspace(0, 1, bins + 1), count, mean_p, share)


def brier(p: NDArray[np.floating], actual: NDArray[np.bool_]) -> float | None:
    """Return the Brier score of probabilities (N,): their mean squared error (Valenti 2018, Eq 8.7); None for N = 0."""
    return float(np.mean((p - actual) ** 2)) if len(p) else None


def correlation(p: NDArray[np.floating], actual: NDArray[np.bool_]) -> float | None:
    """Return Pearson's correlation of p (N,) and actual (N,) (Valenti 2018, Eq 8.8-8.9, its sum divided by N).

    None where one of the two does not vary.
    """
    share = float(actual.mean()) if len(p) else 0.0
    ours = p - p.mean() if 0 < share < 1 else np.zeros(1)
    spread = np.sqrt(np.mean(ours * ours) * share * (1 - share))
    return float(ours[actual].sum() / len(p) / spread) if spread > 1e-12 else None
