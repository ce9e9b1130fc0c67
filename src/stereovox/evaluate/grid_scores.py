# SPDX-License-Identifier: Apache-2.0
"""How good is a 2-D map beside another? The error of IST 2019, Eq 7, and measures that forgive a cell."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_align import align_grids
from stereovox.evaluate.grid_distance import Distances, Overlap, distances, overlap
from stereovox.evaluate.grid_errors import CellErrors, cell_errors, differences
from stereovox.evaluate.grid_lattice import Laid, Rectangle, lay, three_states
from stereovox.evaluate.metrics import Confusion, ratio
from stereovox.evaluate.reliability import brier, correlation
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.voxel_map import State


@dataclass(frozen=True)
class GridTally:
    """Measures over one set of cells that the reference knows; positive: the map calls it occupied (Valenti 2018, 8.3).

    correlation: Pearson's, of the map's probability (0.5 where unknown) and the truth.
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

    errors: Eq 7 and what it is made of. tally: over all cells the reference knows, where one that the map does not
    know is not called occupied; observed: over those that both know. error: mean squared error of the map's
    probabilities over those (Brier score). coverage: share of the reference's cells that the map knows.
    occupied: how well the occupied cells match, exactly and within `tolerance_cells` along each axis, also where the
    reference knows nothing; free_iou: intersection over union of the free cells.
    to_reference, from_reference: metres from each occupied cell of the map to the nearest of the reference, and back.
    motion: (3,) pose_reference_map by which the map was moved; aligned: whether that was searched for.
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
    motion: planar.Pose
    aligned: bool
    resolution: float
    map_resolution: float

    @property
    def eq7_percent(self) -> float:
        """IST 2019, Eq 7, in per cent."""
        return self.errors.eq7_percent

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers: JSON without NaN."""
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

    exclude: regions (x0, y0, x1, y1) in metres of the reference's map frame that do not count. align: whether to search
    for the motion that lays the map on the reference; else the map is moved by `start`, (3,) pose_reference_map.
    tolerance: cells along each axis. Raises StereovoxError for a reference that knows nothing, maps that lie too far
    apart, and numbers out of range.
    """
    return score_laid(laid_on(grid, reference, exclude, align, start), grid.resolution, align, tolerance)


def laid_on(
    grid: OccupancyGrid,
    reference: OccupancyGrid,
    exclude: Iterable[Rectangle] = (),
    align: bool = True,
    start: ArrayLike = (0, 0, 0),
) -> Laid:
    """Return both maps on the reference's cells, aligned or moved by `start`; see `score_grids`."""
    return lay(grid, reference, align_grids(grid, reference, start) if align else start, exclude)


def score_laid(laid: Laid, map_resolution: float, aligned: bool, tolerance: int = 1) -> GridScores:
    """Return the measures of two maps that lie on the same cells."""
    if not 0 <= tolerance <= 1000:
        raise StereovoxError(f"tolerance {tolerance}: give the cells that are forgiven, 0 to 1000")
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
