# SPDX-License-Identifier: Apache-2.0
"""Score a map against the truth: all measures of Valenti 2018, 8.3, and more."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.evaluate.curves import (
    BINS,
    LIKELY,
    THRESHOLDS,
    ByDistance,
    PrecisionRecall,
    Reliability,
    Roc,
    brier,
    by_distance,
    correlation,
    equal_mass,
    precision_recall,
    reliability,
    roc,
)
from stereovox.evaluate.decisions import Decisions, Part, decide, decision_parts, looks
from stereovox.evaluate.metrics import Confusion, ratio
from stereovox.evaluate.truth_cells import Reading, TruthCells, level
from stereovox.maps import VoxelMap

_NOT_NUMBERS = {"observed", "reliability", "equal_mass", "roc", "curve", "distance", "decisions", "parts"}


@dataclass(frozen=True)
class Tally:
    """Measures over one set of cells; None for a division by zero.

    cells: their number; tp, fp, tn, fn: counts, positive = called occupied; accuracy to npv: Eq 8.2 to 8.6;
    correlation: Pearson's, of probability and truth (Eq 8.8-8.9, divided by N), unobserved cells at 0.5;
    correlation_free: the same with them at 0, which is free (Eq 8.1); tolerance_precision: share of the cells
    called occupied with a surface within the tolerance; tolerance_recall: share of the surface cells with a cell called
    occupied within it, anywhere; iou: intersection over union of both sets, tp / (tp + fp + fn).
    """

    cells: int
    tp: int
    fp: int
    tn: int
    fn: int
    accuracy: float | None
    precision: float | None
    recall: float | None
    specificity: float | None
    npv: float | None
    tolerance_precision: float | None
    tolerance_recall: float | None
    correlation: float | None
    correlation_free: float | None
    iou: float | None


@dataclass(frozen=True)
class QuickScores(Tally):
    """Scores that are cheap enough for every frame: `Tally` over all cells of the truth, unobserved ones as free.

    threshold, tolerance_cells: as given; coverage: share of the cells that the map has observed. Over observed
    cells: error, mean squared error of the probabilities (Eq 8.7); brier, the same under its other name; ece, expected
    calibration error; observed, the measures of `Tally`.
    """

    threshold: float
    tolerance_cells: int
    coverage: float
    error: float | None
    brier: float | None
    ece: float | None
    observed: Tally

    def as_dict(self) -> dict[str, Any]:
        """Return all single numbers for JSON, with `observed` as a dict and without NaN."""
        numbers = {field.name: getattr(self, field.name) for field in fields(self) if field.name not in _NOT_NUMBERS}
        return {**numbers, "observed": asdict(self.observed)}


@dataclass(frozen=True, eq=False)
class Scores(QuickScores):
    """All measures. auc, average_precision: areas under the ROC curve and under precision against recall, over all
    cells (p = 0.5 if unobserved); observed_auc, observed_average_precision likewise.

    f_score_1, f_score_2: harmonic mean of precision and recall within one cell, and within two, over all cells.
    balanced: the point of `curve` where the lesser of precision and recall within the tolerance is largest.
    ece_likely: as `ece`, over cells with p >= 0.3; ece_equal_mass: in bins of as many cells.
    decisions: the map's own decisions, at its own thresholds; parts: the same by range (from the given path, or the
    map's own), thickness and looks (if the map has its camera's path).
    reliability, equal_mass: over observed cells; roc: over all cells, None unless some are occupied and some free;
    curve: precision and recall against the threshold; distance: the same against distance, None without a path.
    """

    auc: float | None
    observed_auc: float | None
    average_precision: float | None
    observed_average_precision: float | None
    f_score_1: float | None
    f_score_2: float | None
    balanced: dict[str, float | None]
    ece_likely: float | None
    ece_equal_mass: float | None
    decisions: Decisions
    parts: tuple[Part, ...]
    reliability: Reliability
    equal_mass: Reliability
    roc: Roc | None
    curve: PrecisionRecall
    distance: ByDistance | None

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers for JSON, `decisions` first, with `observed` as a dict and without NaN."""
        decided = {**asdict(self.decisions), "parts": [part.as_dict() for part in self.parts]}
        numbers = {"decisions": decided, **super().as_dict()}
        for name in ("auc", "average_precision"):
            numbers["observed"][name] = numbers.pop(f"observed_{name}")
        return numbers


def score(
    voxel_map: VoxelMap,
    truth_map: VoxelMap | TruthCells,
    threshold: float | None = None,
    tolerance: int = 1,
    *,
    bins: int = BINS,
    thresholds: ArrayLike = THRESHOLDS,
    path: ArrayLike | None = None,
    edges: ArrayLike | None = None,
) -> Scores:
    """Compare a map with the truth over the cells known to the truth.

    truth_map: a map whose occupied cells have a surface and whose free cells were in view and have none; or
    `TruthCells`, made once for many maps, which has its own tolerance. threshold: a cell is called occupied if
    p > threshold (Eq 8.1); None: the map's own. tolerance: cells along each axis. bins: of the reliability diagram;
    thresholds: (M,) of the curve of precision and recall. path: camera positions (P, 3) or one (3,) in metres, world
    frame, for `distance`; edges: its rings in metres. Raises StereovoxError for maps of different cell sizes, an empty
    truth, and numbers out of range.
    """
    truth = truth_map if isinstance(truth_map, TruthCells) else TruthCells(truth_map, tolerance)
    threshold = voxel_map.config.map.decision.occupied_above if threshold is None else threshold
    reading = truth.read(voxel_map)
    seen, actual = reading.observed, truth.occupied
    p, known = reading.probability[seen], actual[seen]
    over_all, over_seen = roc(reading.probability, actual), roc(p, known)
    quick, even = score_reading(reading, truth, threshold, bins), equal_mass(p, known, bins)
    curve = precision_recall(reading, actual, truth.near, thresholds)
    places = path if path is not None or not len(voxel_map.path) else voxel_map.path
    return Scores(
        **{field.name: getattr(quick, field.name) for field in fields(quick)},
        auc=over_all.auc if over_all else None,
        observed_auc=over_seen.auc if over_seen else None,
        average_precision=over_all.average_precision if over_all else None,
        observed_average_precision=over_seen.average_precision if over_seen else None,
        f_score_1=f_score(reading, truth, threshold, 1),
        f_score_2=f_score(reading, truth, threshold, 2),
        balanced=curve.best(),
        ece_likely=reliability(p[p >= LIKELY], known[p >= LIKELY], bins).ece,
        ece_equal_mass=even.ece,
        decisions=decide(reading, truth),
        parts=decision_parts(reading, truth, places, edges, looks(voxel_map, truth)),
        reliability=reliability(p, known, bins),
        equal_mass=even,
        roc=over_all,
        curve=curve,
        distance=None if path is None else by_distance(reading, truth, path, threshold, edges),
    )


def f_score(reading: Reading, truth: TruthCells, threshold: float, within: int) -> float | None:
    """Return the harmonic mean of precision and recall within `within` cells, 1 or 2, at p > `threshold`.

    0 if the map calls no cell occupied, None if the truth has no surface.
    """
    marked, found = reading.marked(threshold), reading.best_within(within) > level(threshold)
    precision = ratio(int((marked & truth.near_within(within)).sum()), int(marked.sum()))
    recall = ratio(int(found.sum()), len(found))
    if recall is None:
        return None
    return 2 * precision * recall / (precision + recall) if precision and recall else 0.0


def score_reading(reading: Reading, truth: TruthCells, threshold: float, bins: int = BINS) -> QuickScores:
    """Compute the scores that need no sorting: a few milliseconds for 100,000 cells."""
    seen, p, actual = reading.observed, reading.probability, truth.occupied
    marked, found = reading.marked(threshold), reading.found(threshold)
    close = ratio(float((marked & truth.near).sum()), float(marked.sum()))
    over_all = _tally(marked, actual, found, p, seen, close)
    over_seen = over_all
    if not seen.all():
        over_seen = _tally(marked[seen], actual[seen], found[seen[actual]], p[seen], seen[seen], close)
    error = brier(p[seen], actual[seen])
    return QuickScores(
        **vars(over_all),
        threshold=threshold,
        tolerance_cells=truth.tolerance,
        coverage=float(seen.mean()),
        error=error,
        brier=error,
        ece=reliability(p[seen], actual[seen], bins).ece,
        observed=over_seen,
    )


def _tally(
    marked: NDArray[np.bool_],
    actual: NDArray[np.bool_],
    found: NDArray[np.bool_],
    p: NDArray[np.float64],
    seen: NDArray[np.bool_],
    close: float | None,
) -> Tally:
    """Compute the measures over N cells, those `seen` by the map and others.

    found: (S,) for each truly occupied one; close: the tolerance precision.
    """
    counted = Confusion.count(marked, actual)
    return Tally(
        cells=len(actual),
        tp=counted.tp,
        fp=counted.fp,
        tn=counted.tn,
        fn=counted.fn,
        **counted.rates(),
        tolerance_precision=close,
        tolerance_recall=ratio(float(found.sum()), len(found)),
        correlation=correlation(p, actual),
        correlation_free=correlation(np.where(seen, p, 0.0), actual),
        iou=ratio(counted.tp, counted.tp + counted.fp + counted.fn),
    )
