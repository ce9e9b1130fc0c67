# SPDX-License-Identifier: Apache-2.0
"""How far the walls of two 2-D maps lie apart: measures that do not punish a wall for standing one cell aside."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.metrics import ratio


@dataclass(frozen=True)
class Distances:
    """Metres from each of N cells to the nearest of others; None where there are none on either side.

    mean, median, p95 (95 % are not further), max.
    """

    mean: float | None = None
    median: float | None = None
    p95: float | None = None
    max: float | None = None

    @classmethod
    def of(cls, metres: NDArray[np.floating]) -> Distances:
        """Return the figures of (N,) distances."""
        if not len(metres):
            return cls()
        median, p95 = np.percentile(metres, [50, 95])
        return cls(float(metres.mean()), float(median), float(p95), float(metres.max()))


def distances(start: NDArray[np.bool_], goal: NDArray[np.bool_], resolution: float) -> NDArray[np.float64]:
    """Return (N,) metres from the middle of each cell of `start` to that of the nearest of `goal`; () where none is."""
    from scipy.ndimage import distance_transform_edt

    if not goal.any():
        return np.zeros(0)
    metres = np.asarray(distance_transform_edt(~goal, sampling=resolution))
    return metres[start]


@dataclass(frozen=True)
class Overlap:
    """How many cells of two sets match; None where there is nothing to divide by.

    iou: intersection over union. tolerance_precision: share of the map's cells with one of the reference within the
    tolerance; tolerance_recall: of the reference's with one of the map. iou_tolerant: the iou where the intersection is
    the mean of the two numbers of cells that have one within the tolerance.
    """

    iou: float | None
    iou_tolerant: float | None
    tolerance_precision: float | None
    tolerance_recall: float | None


def overlap(ours: NDArray[np.bool_], theirs: NDArray[np.bool_], tolerance: int, counted: NDArray[np.bool_]) -> Overlap:
    """Compare two sets of cells, (rows, columns) bool each, in cells that are `counted`.

    tolerance: cells along each axis. A neighbour that is not counted may still be what is near.
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
    """Return the cells that lie within `tolerance` cells, along each axis, of one of `cells`."""
    from scipy.ndimage import maximum_filter

    return np.asarray(maximum_filter(cells, size=2 * tolerance + 1, mode="constant", cval=0), bool)
