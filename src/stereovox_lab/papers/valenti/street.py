# SPDX-License-Identifier: Apache-2.0
"""A street cut in two along the path of the car."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

GAP_M = 2.0
"""Least distance in metres between the two halves of a street."""


def halves(way: NDArray[np.floating], points: NDArray[np.floating]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which points (N, 3) are at the first half of a path (F, 3), and which at the second, by its length.

    A point belongs to a half that is nearer by more than GAP_M metres than the other; so any two points of
    different halves are more than GAP_M apart (the difference of two distances changes by at most twice a step).
    """
    from scipy.spatial import KDTree

    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))])
    first = gone <= gone[-1] / 2
    if first.all():
        return np.zeros(len(points), bool), np.zeros(len(points), bool)
    to_first, to_second = (KDTree(way[part]).query(points)[0] for part in (first, ~first))
    return to_first + GAP_M < to_second, to_second + GAP_M < to_first
