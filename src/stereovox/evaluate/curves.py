# SPDX-License-Identifier: Apache-2.0
"""Curves over all thresholds: ROC, and precision and recall with a tolerance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.evaluate.truth_cells import Reading, level

EXACT, TOLERANT = ("precision", "recall"), ("tolerance_precision", "tolerance_recall")
THRESHOLDS = np.arange(1, 100) / 100


@dataclass(frozen=True, eq=False)
class Roc:
    """Receiver operating characteristic, as the threshold falls from 1 to 0.

    threshold: (M,) falling, inf first; at each, cells with p >= threshold are called occupied.
    false_positive_rate: (M,) share of the free cells called occupied; true_positive_rate: (M,) of the occupied cells.
    surface_share: share of the cells that are occupied.
    """

    threshold: NDArray[np.float64]
    false_positive_rate: NDArray[np.float64]
    true_positive_rate: NDArray[np.float64]

    surface_share: float

    @property
    def average_precision(self) -> float:
        """Area below precision against recall, each step at its lower threshold's precision; equal p together."""
        occupied = self.surface_share * self.true_positive_rate[1:]
        precision = occupied / (occupied + (1 - self.surface_share) * self.false_positive_rate[1:])
        return float(precision @ np.diff(self.true_positive_rate))

    @property
    def auc(self) -> float:
        """Area under the curve: how often an occupied cell has a higher p than a free one, ties half; 0.5 is chance."""
        return float(np.trapezoid(self.true_positive_rate, self.false_positive_rate))


def roc(p: NDArray[np.floating], actual: NDArray[np.bool_]) -> Roc | None:
    """Return the ROC curve of probabilities (N,); None unless some cells are occupied and some free."""
    values, of_cell = np.unique(p, return_inverse=True)
    occupied = np.bincount(of_cell, actual, len(values))[::-1]
    free = np.bincount(of_cell, ~actual, len(values))[::-1]
    if not occupied.sum() or not free.sum():
        return None
    wrong, right = (np.concatenate([[0], np.cumsum(part) / part.sum()]) for part in (free, occupied))
    return Roc(np.concatenate([[np.inf], values[::-1]]), wrong, right, float(actual.mean()))


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall at each threshold (M,), exact and with tolerance; NaN for a division by zero."""

    threshold: NDArray[np.float64]
    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    tolerance_precision: NDArray[np.float64]
    tolerance_recall: NDArray[np.float64]

    def point(self, i: int) -> dict[str, float | None]:
        """Return all values at threshold number `i`, None instead of NaN."""
        values = {name: float(column[i]) for name, column in vars(self).items()}
        return {name: value if np.isfinite(value) else None for name, value in values.items()}

    def best(self, names: tuple[str, str] = TOLERANT, wanted: tuple[float, float] = (0.0, 0.0)) -> dict[str, Any]:
        """Return the point where the lesser of the two measures, each minus its wanted value, is largest."""
        margins = [
            np.nan_to_num(getattr(self, name), nan=-1.0) - goal for name, goal in zip(names, wanted, strict=True)
        ]
        return self.point(int(np.argmax(np.minimum(*margins))))


def precision_recall(
    reading: Reading, actual: NDArray[np.bool_], near: NDArray[np.bool_], thresholds: ArrayLike = THRESHOLDS
) -> PrecisionRecall:
    """Return precision and recall over all cells of the truth at `thresholds` (M,).

    actual, near: (N,) cells with a surface, and cells with one within the tolerance. Unobserved cells are free.
    """
    thresholds = np.asarray(thresholds, float)
    levels = np.array([level(threshold) for threshold in thresholds])
    seen = reading.observed
    marked, right, close = (
        above(reading.log_odds[seen & chosen], levels) for chosen in (np.ones_like(seen), actual, near)
    )
    found, surface = above(reading.best, levels), int(actual.sum())
    return PrecisionRecall(
        thresholds, shares(right, marked), shares(right, surface), shares(close, marked), shares(found, surface)
    )


def above(values: NDArray[np.floating], levels: NDArray[np.float64]) -> NDArray[np.int64]:
    """Count the `values` (N,) greater than each of the `levels` (M,)."""
    return len(values) - np.searchsorted(np.sort(values), levels, side="right")


def shares(part: NDArray[np.integer], whole: NDArray[np.integer] | int) -> NDArray[np.float64]:
    """Return part / whole, NaN if the whole is zero."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.asarray(whole) > 0, part / np.asarray(whole, float), np.nan)
