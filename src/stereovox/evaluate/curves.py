# SPDX-License-Identifier: Apache-2.0
"""Curves over all thresholds: ROC, and precision and recall with a tolerance.

Precision and recall by distance from the camera. Calibration of probabilities: of all cells with p = 0.8, 80 % should
be occupied.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.truth_cells import Reading, TruthCells, level

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


RINGS = 8


@dataclass(frozen=True, eq=False)
class ByDistance:
    """Precision and recall of the cells in M rings; ring i covers edges[i] <= distance < edges[i + 1], in metres.

    edges: (M + 1,). marked, surface: (M,) number of cells that the map calls occupied, and of truly occupied ones.
    The others: (M,), NaN in a ring without such cells.
    """

    edges: NDArray[np.float64]
    marked: NDArray[np.int64]
    surface: NDArray[np.int64]
    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    tolerance_precision: NDArray[np.float64]
    tolerance_recall: NDArray[np.float64]

    def rows(self) -> list[dict[str, float | None]]:
        """Return one dict per ring for JSON: `from_m`, `to_m` and the values of the arrays, None instead of NaN."""
        columns = {"from_m": self.edges[:-1], "to_m": self.edges[1:], **vars(self)}
        columns.pop("edges")
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return [{name: None if x != x else x for name, x in zip(columns, row, strict=True)} for row in rows]


def by_distance(
    reading: Reading, truth: TruthCells, path: ArrayLike, threshold: float, edges: ArrayLike | None = None
) -> ByDistance:
    """Compute precision and recall by distance to the nearest camera position.

    path: camera positions (P, 3), or one (3,), in metres, world frame. edges: rising limits (M + 1,) of the rings in
    metres; by default about eight of a round width. Cells beyond the last are left out; unobserved cells count as free.
    Raises StereovoxError for an invalid path.
    """
    distance = distances(truth.centers(), path)
    limits = round_edges(float(distance.max())) if edges is None else np.asarray(edges, float)
    marked, actual = reading.marked(threshold), truth.occupied
    chosen = (marked, actual, marked & actual, marked & truth.near)
    n_marked, n_surface, right, close = (np.histogram(distance[cells], limits)[0] for cells in chosen)
    found = np.histogram(distance[actual][reading.found(threshold)], limits)[0]
    return ByDistance(
        limits,
        n_marked,
        n_surface,
        shares(right, n_marked),
        shares(right, n_surface),
        shares(close, n_marked),
        shares(found, n_surface),
    )


def distances(points: NDArray[np.float64], path: ArrayLike) -> NDArray[np.float64]:
    """Return the distance (N,) in metres from each point (N, 3) to the nearest position of `path` (P, 3)."""
    from scipy.spatial import KDTree

    positions = np.asarray(path, float)
    if positions.size == 0 or positions.shape[-1] != 3 or not np.isfinite(positions).all():
        raise StereovoxError(f"a path of shape {positions.shape} is not a list of points; give (P, 3) metres")
    return KDTree(positions.reshape(-1, 3)).query(points)[0]


def round_edges(maximum: float) -> NDArray[np.float64]:
    """Return edges from 0 to beyond `maximum`, in about eight steps of 1, 2 or 5 times a power of ten."""
    rough = max(maximum, 1e-3) / RINGS
    power = 10.0 ** np.floor(np.log10(rough))
    width = next(step * power for step in (1, 2, 5, 10) if step * power >= rough * (1 - 1e-9))
    return width * np.arange(np.floor(maximum / width) + 2)


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
