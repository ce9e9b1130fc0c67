# SPDX-License-Identifier: Apache-2.0
"""Classify each cell as right or wrong, for pictures."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.cells import indices
from stereovox.evaluate.truth_cells import Reading, TruthCells


class Outcome(IntEnum):
    """Outcome of a cell that the map or the truth calls occupied.

    HIT: both do. NEAR: only the map does, with a surface within the tolerance; FALSE: without one. FOUND: only the
    truth does, with an occupied cell of the map within the tolerance; MISSED: without one; UNSEEN: without one, and the
    map has never observed the cell.
    """

    HIT = 0
    NEAR = 1
    FALSE = 2
    FOUND = 3
    MISSED = 4
    UNSEEN = 5


@dataclass(frozen=True, eq=False)
class Outcomes:
    """Cells (M, 3) int32 that the map or the truth calls occupied, and the `Outcome` (M,) uint8 of each."""

    cells: NDArray[np.int32]
    outcome: NDArray[np.uint8]
    voxel_size: float
    up: str


def outcomes(reading: Reading, truth: TruthCells, threshold: float) -> Outcomes:
    """Return the outcome of each cell of the truth that the truth or the map calls occupied."""
    marked, actual = reading.marked(threshold), truth.occupied
    outcome = np.where(truth.near, Outcome.NEAR, Outcome.FALSE).astype(np.uint8)
    missed = np.where(reading.observed[actual], Outcome.MISSED, Outcome.UNSEEN)
    outcome[actual] = np.where(reading.found(threshold), Outcome.FOUND, missed)
    outcome[marked & actual] = Outcome.HIT
    shown = marked | actual
    return Outcomes(indices(truth.cells[shown]), outcome[shown], truth.voxel_size, truth.up)
