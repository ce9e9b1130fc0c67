# SPDX-License-Identifier: Apache-2.0
"""Compare a 2-D map with a reference: the error of IST 2019, Eq 7, and measures with a tolerance.

As in IST 2019, IV-B, a cell is wrong if "the occupation value" differs, so there are three values, and a cell known to
only one map is wrong too: the paper says so of a corridor that its camera never saw, which is white in Fig 6. An
excluded region is "compensated in the error formula, as being, in fact, black": its cells count as right, and still
belong to the free and occupied cells of the reference in the denominator.

So Eq 7 sums two parts: coverage, cells that one map never saw, and contradiction, cells with opposite states. A camera
that sees less than a lidar has much of the first, a wrong map much of the second; both are reported.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.curves import brier, correlation
from stereovox.evaluate.grid_align import (
    EMPTY_REFERENCE,
    AlignedGrids,
    Rectangle,
    align_grids,
    aligned_grids,
    three_states,
)
from stereovox.evaluate.metrics import Confusion, ratio
from stereovox.geometry import se2
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.voxel_map import State


class Difference(IntEnum):
    """How a cell differs.

    SAME: both maps agree, or neither knows it; MISSED: only the reference knows it; WRONGLY_OCCUPIED, WRONGLY_FREE: the
    map and reference have opposite states; EXTRA: only the map knows it; FORGIVEN: differs in an excluded region.
    """

    SAME = 0
    MISSED = 1
    WRONGLY_OCCUPIED = 2
    WRONGLY_FREE = 3
    EXTRA = 4
    FORGIVEN = 5


def differences(laid: AlignedGrids) -> NDArray[np.uint8]:
    """Return `Difference` of each cell, (rows, columns) uint8."""
    table = np.full((4, 4), Difference.SAME, np.uint8)
    for known in (State.FREE, State.OCCUPIED):
        table[known, State.UNKNOWN] = Difference.MISSED
        table[State.UNKNOWN, known] = Difference.EXTRA
    table[State.FREE, State.OCCUPIED] = Difference.WRONGLY_OCCUPIED
    table[State.OCCUPIED, State.FREE] = Difference.WRONGLY_FREE
    found = table[three_states(laid.reference), three_states(laid.map)]
    found[laid.excluded & (found != Difference.SAME)] = Difference.FORGIVEN
    return found


def wrong(found: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return B of IST 2019, Eq 7: the cells that `differences` counts as wrong, (rows, columns) bool."""
    return (found != Difference.SAME) & (found != Difference.FORGIVEN)


@dataclass(frozen=True)
class CellErrors:
    """Counts of cells by how they differ.

    eq7_percent: IST 2019, Eq 7: cells that differ / (free and occupied cells of the reference) * 100; can exceed 100.
    eq7_coverage_percent, eq7_contradiction_percent: its two parts, which sum to it: cells that only one of the maps
        knows (missed, extra), and cells with different known states (wrongly occupied, wrongly free).
    eq7_outside_percent: the same as Eq 7 without excluded cells in the denominator; never less.
    known_error_percent: share that differ of the cells known to both maps; None if no cell is.
    missed, wrongly_occupied, wrongly_free, extra: the cells that differ, see `Difference`; forgiven: those that differ
        in excluded regions and do not count.
    reference_occupied, reference_free: all such cells of the reference, including excluded ones.
    excluded: all cells in excluded regions; known_in_both: cells outside them known to both maps.
    """

    eq7_percent: float
    eq7_coverage_percent: float
    eq7_contradiction_percent: float
    eq7_outside_percent: float | None
    known_error_percent: float | None
    missed: int
    wrongly_occupied: int
    wrongly_free: int
    extra: int
    forgiven: int
    reference_occupied: int
    reference_free: int
    excluded: int
    known_in_both: int


def cell_errors(laid: AlignedGrids, found: NDArray[np.uint8]) -> CellErrors:
    """Count the result of `differences`. Raises StereovoxError for a reference without any known cell."""
    here, there = three_states(laid.map), three_states(laid.reference)
    missed, occupied, free, extra, forgiven = np.bincount(found.ravel(), minlength=len(Difference))[1:].tolist()
    known = there != State.UNKNOWN
    total, outside = int(known.sum()), int((known & ~laid.excluded).sum())
    if not total:
        raise StereovoxError(EMPTY_REFERENCE)
    both = int((known & (here != State.UNKNOWN) & ~laid.excluded).sum())
    differ = missed + occupied + free + extra
    return CellErrors(
        eq7_percent=100 * differ / total,
        eq7_coverage_percent=100 * (missed + extra) / total,
        eq7_contradiction_percent=100 * (occupied + free) / total,
        eq7_outside_percent=_percent(differ, outside),
        known_error_percent=_percent(occupied + free, both),
        missed=missed,
        wrongly_occupied=occupied,
        wrongly_free=free,
        extra=extra,
        forgiven=forgiven,
        reference_occupied=int((there == State.OCCUPIED).sum()),
        reference_free=int((there == State.FREE).sum()),
        excluded=int(laid.excluded.sum()),
        known_in_both=both,
    )


def _percent(part: int, whole: int) -> float | None:
    share = ratio(part, whole)
    return None if share is None else 100 * share


@dataclass(frozen=True)
class Distances:
    """Distances in metres from each of N cells to the nearest of others; None if either set is empty.

    mean, median, p95 (95th percentile), max.
    """

    mean: float | None = None
    median: float | None = None
    p95: float | None = None
    max: float | None = None

    @classmethod
    def of(cls, metres: NDArray[np.floating]) -> Distances:
        """Summarise (N,) distances."""
        if not len(metres):
            return cls()
        median, p95 = np.percentile(metres, [50, 95])
        return cls(float(metres.mean()), float(median), float(p95), float(metres.max()))


def distances(start: NDArray[np.bool_], goal: NDArray[np.bool_], resolution: float) -> NDArray[np.float64]:
    """Return (N,) metres from the centre of each cell of `start` to the nearest of `goal`; empty if either is."""
    from scipy.ndimage import distance_transform_edt

    if not goal.any():
        return np.zeros(0)
    metres = np.asarray(distance_transform_edt(~goal, sampling=resolution))
    return metres[start]


@dataclass(frozen=True)
class Overlap:
    """Overlap of two sets of cells; None for a division by zero.

    iou: intersection over union. tolerance_precision: share of the map's cells with a reference cell within the
    tolerance; tolerance_recall: share of the reference's with a map cell. iou_tolerant: the IoU whose intersection is
    the mean number of cells with a partner within the tolerance.
    """

    iou: float | None
    iou_tolerant: float | None
    tolerance_precision: float | None
    tolerance_recall: float | None


def overlap(ours: NDArray[np.bool_], theirs: NDArray[np.bool_], tolerance: int, counted: NDArray[np.bool_]) -> Overlap:
    """Compare two sets of cells, (rows, columns) bool each, among the `counted` cells.

    tolerance: cells along each axis. A neighbour within it need not be counted itself.
    """
    near_theirs, near_ours = within(theirs, tolerance), within(ours, tolerance)
    ours, theirs = ours & counted, theirs & counted
    here, there = int(ours.sum()), int(theirs.sum())
    close, found = int((ours & near_theirs).sum()), int((theirs & near_ours).sum())
    exact, shared = int((ours & theirs).sum()), (close + found) / 2
    return Overlap(
        ratio(exact, here + there - exact),
        ratio(shared, here + there - shared),
        ratio(close, here),
        ratio(found, there),
    )


def within(cells: NDArray[np.bool_], tolerance: int) -> NDArray[np.bool_]:
    """Return the cells within `tolerance` cells, along each axis, of one of `cells`."""
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(cells, size=2 * tolerance + 1, mode="constant", cval=0), bool)


@dataclass(frozen=True)
class GridTally:
    """Measures over one set of cells that the reference knows; positive: the map calls it occupied (Valenti 2018, 8.3).

    correlation: Pearson's, of the map's probability (0.5 if unknown) and the truth.
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
    correlation: float | None


@dataclass(frozen=True, eq=False)
class GridScores:
    """All measures of one map against a reference, over cells of the reference's size outside excluded regions.

    errors: Eq 7 and its parts. tally: over all cells the reference knows, with cells unknown to the map as not
    occupied; observed: over cells known to both. error: mean squared error of the map's probabilities over these (Brier
    score). coverage: share of the reference's cells that the map knows.
    occupied: match of the occupied cells, exactly and within `tolerance_cells` along each axis, also if the
    reference knows nothing; free_iou: intersection over union of the free cells.
    to_reference, from_reference: metres from each occupied cell of the map to the nearest of the reference, and back.
    motion: (3,) pose_reference_map by which the map was moved; aligned: whether it was searched for.
    resolution, map_resolution: side of a cell of the reference, and of the map.
    """

    errors: CellErrors
    tally: GridTally
    observed: GridTally
    error: float | None
    coverage: float | None
    occupied: Overlap
    free_iou: float | None
    tolerance_cells: int
    to_reference: Distances
    from_reference: Distances
    motion: se2.Pose
    aligned: bool
    resolution: float
    map_resolution: float

    @property
    def eq7_percent(self) -> float:
        """IST 2019, Eq 7, in per cent."""
        return self.errors.eq7_percent

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers for JSON, without NaN."""
        x, y, yaw = map(float, self.motion)
        return {
            **asdict(self.errors),
            **asdict(self.tally),
            "error": self.error,
            "coverage": self.coverage,
            "occupied_iou": self.occupied.iou,
            "occupied_iou_tolerant": self.occupied.iou_tolerant,
            "free_iou": self.free_iou,
            "tolerance_cells": self.tolerance_cells,
            "tolerance_precision": self.occupied.tolerance_precision,
            "tolerance_recall": self.occupied.tolerance_recall,
            "distance_m": {"to_reference": asdict(self.to_reference), "from_reference": asdict(self.from_reference)},
            "observed": asdict(self.observed),
            "motion": {"x": x, "y": y, "yaw_deg": float(np.degrees(yaw))},
            "aligned": self.aligned,
            "resolution": self.resolution,
            "map_resolution": self.map_resolution,
        }


def score_grids(
    grid: OccupancyGrid,
    reference: OccupancyGrid,
    exclude: Iterable[Rectangle] = (),
    align: bool = True,
    *,
    tolerance: int = 1,
    start: ArrayLike = (0, 0, 0),
) -> GridScores:
    """Compare a 2-D map with a reference.

    exclude: regions (x0, y0, x1, y1) in metres of the reference's map frame to ignore. align: whether to search
    for the motion that aligns the map with the reference; else the map is moved by `start`, (3,) pose_reference_map.
    tolerance: cells along each axis. Raises StereovoxError for a reference without known cells, maps too far
    apart, and numbers out of range.
    """
    return score_laid(laid_on(grid, reference, exclude, align, start), grid.resolution, align, tolerance)


def laid_on(
    grid: OccupancyGrid,
    reference: OccupancyGrid,
    exclude: Iterable[Rectangle] = (),
    align: bool = True,
    start: ArrayLike = (0, 0, 0),
) -> AlignedGrids:
    """Return both maps on the reference's cells, aligned or moved by `start`; see `score_grids`."""
    return aligned_grids(grid, reference, align_grids(grid, reference, start) if align else start, exclude)


def score_laid(laid: AlignedGrids, map_resolution: float, aligned: bool, tolerance: int = 1) -> GridScores:
    """Score two maps on the same cells."""
    if not 0 <= tolerance <= 1000:
        raise StereovoxError(f"tolerance {tolerance}: give a number of cells, 0 to 1000")
    here, there, counted = three_states(laid.map), three_states(laid.reference), ~laid.excluded
    known = (there != State.UNKNOWN) & counted
    both = known & (here != State.UNKNOWN)
    p, occupied, truth = _probability(laid.map), here == State.OCCUPIED, there == State.OCCUPIED
    free, truly_free = (here == State.FREE) & counted, (there == State.FREE) & counted
    side = laid.reference.resolution
    return GridScores(
        errors=cell_errors(laid, differences(laid)),
        tally=_tally(occupied[known], truth[known], p[known]),
        observed=_tally(occupied[both], truth[both], p[both]),
        error=brier(p[both], truth[both]),
        coverage=ratio(float(both.sum()), float(known.sum())),
        occupied=overlap(occupied, truth, tolerance, counted),
        free_iou=ratio(float((free & truly_free).sum()), float((free | truly_free).sum())),
        tolerance_cells=tolerance,
        to_reference=Distances.of(distances(occupied & counted, truth, side)),
        from_reference=Distances.of(distances(truth & counted, occupied, side)),
        motion=laid.motion,
        aligned=aligned,
        resolution=side,
        map_resolution=map_resolution,
    )


def _probability(grid: OccupancyGrid) -> NDArray[np.float32]:
    return np.where(grid.cells == UNKNOWN, np.float32(0.5), grid.cells / np.float32(100))


def _tally(marked: NDArray[np.bool_], actual: NDArray[np.bool_], p: NDArray[np.floating]) -> GridTally:
    counted = Confusion.count(marked, actual)
    likeness = correlation(p.astype(float), actual)
    return GridTally(
        cells=len(actual),
        tp=counted.tp,
        fp=counted.fp,
        tn=counted.tn,
        fn=counted.fn,
        **counted.rates(),
        correlation=likeness,
    )
