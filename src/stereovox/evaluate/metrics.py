# SPDX-License-Identifier: Apache-2.0
"""Agreement of a map with the truth: pure functions on sets of cells and boolean arrays."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.cells import Keys, indices, keys, position, within
from stereovox.evaluate.truth import Piece, Truth
from stereovox.maps import State, VoxelMap

MIN_SHARE = 0.9
MAX_GAP = 0.1
"""A piece is missing if a smaller share of its seen cells is found, or a gap in metres is longer."""


def ratio(part: float, whole: float) -> float | None:
    """Return part / whole, None if the whole is zero."""
    return float(part / whole) if whole else None


@dataclass(frozen=True)
class Confusion:
    """Confusion matrix of cells (positive = called occupied)."""

    tp: int
    fp: int
    tn: int
    fn: int

    @classmethod
    def count(cls, predicted: NDArray[np.bool_], actual: NDArray[np.bool_]) -> Confusion:
        """Compare two boolean arrays (N,)."""
        tp, fp = int((predicted & actual).sum()), int((predicted & ~actual).sum())
        fn = int((~predicted & actual).sum())
        return cls(tp, fp, len(predicted) - tp - fp - fn, fn)

    def rates(self) -> dict[str, float | None]:
        """Return accuracy, precision, recall, specificity and negative predictive value (Valenti 2018, 8.3)."""
        tp, fp, tn, fn = self.tp, self.fp, self.tn, self.fn
        return {
            "accuracy": ratio(tp + tn, tp + fp + tn + fn),
            "precision": ratio(tp, tp + fp),
            "recall": ratio(tp, tp + fn),
            "specificity": ratio(tn, tn + fp),
            "npv": ratio(tn, tn + fn),
        }


def compare(
    known: Keys, occupied: NDArray[np.bool_], surface: Keys, excluded: Keys, tolerance: int = 1
) -> dict[str, Any]:
    """Compare the known cells of a map with the true surface.

    known: the map's cells, ascending keys (N,); occupied: (N,) whether the map calls them occupied; surface and
    excluded: sets of true cells; known cells in `excluded` are ignored.
    tolerance_precision is the share of occupied cells with a surface cell within `tolerance` cells,
    tolerance_recall the share of known surface cells with an occupied cell within `tolerance` cells.
    """
    counted = position(known, excluded) < 0
    actual = position(known, surface) >= 0
    result = Confusion.count(occupied[counted], actual[counted])
    marked, found = known[occupied & counted], known[actual & counted]
    near, reached = within(marked, surface, tolerance), within(found, known[occupied], tolerance)
    return {
        **asdict(result),
        **result.rates(),
        "tolerance_cells": tolerance,
        "tolerance_precision": ratio(near.sum(), len(near)),
        "tolerance_recall": ratio(reached.sum(), len(reached)),
        "excluded": int((~counted).sum()),
    }


def known_cells(voxel_map: VoxelMap) -> tuple[Keys, NDArray[np.uint8]]:
    """Return the ascending keys (N,) of a map's known cells, and the `State` (N,) of each."""
    cells, _ = voxel_map.cells()
    return keys(cells), voxel_map.state(voxel_map.centers(cells))


def compare_map(voxel_map: VoxelMap, truth: Truth, tolerance: int = 1) -> dict[str, Any]:
    """Compare a map with the exact occupancy of its scene over the cells the map knows.

    Keys as in `compare`, and `free_in_solid`: cells the map calls free that contain a surface or are in a solid.
    """
    known, state = known_cells(voxel_map)
    free = known[state == State.FREE]
    wrong = (position(free, truth.surface) >= 0) | (position(free, truth.inside) >= 0)
    result = compare(known, state == State.OCCUPIED, truth.surface, truth.inside, tolerance)
    return {**result, "free_in_solid": int(wrong.sum())}


@dataclass(frozen=True)
class Found:
    """How much of one piece of the scene is in the map.

    seen: its cells seen by enough frames; exact: occupied ones; near: ones with an occupied cell within the
    tolerance; longest_gap: the longest stretch in metres along the piece's longest axis where seen cells have none.
    """

    part: str
    name: str
    seen: int
    exact: int
    near: int
    longest_gap: float
    missing: bool


def find_piece(piece: Piece, seen: NDArray[np.bool_], occupied: Keys, voxel_size: float, tolerance: int = 1) -> Found:
    """Find `piece` among the `occupied` cells; `seen` (N,) marks the piece's cells that must be found.

    The piece is missing if less than MIN_SHARE of those have an occupied cell within `tolerance` cells, or if a stretch
    of it longer than MAX_GAP metres and two cells has none. An unseen piece is not missing.
    """
    cells = piece.cells[seen]
    near = within(cells, occupied, tolerance)
    exact = int((position(cells, occupied) >= 0).sum())
    gap = longest_gap((indices(cells) + 0.5) @ piece.axis, near) * voxel_size
    missing = bool(near.sum() < MIN_SHARE * len(cells) or gap > max(MAX_GAP, 2 * voxel_size) + 1e-9)
    return Found(piece.part, piece.name, len(cells), exact, int(near.sum()), gap, missing)


def longest_gap(along: NDArray[np.float64], found: NDArray[np.bool_]) -> int:
    """Return the largest number of consecutive whole steps of `along` (N,) that have cells but none `found` (N,)."""
    steps, of_cell = np.unique(np.floor(along).astype(np.int64), return_inverse=True)
    empty = np.bincount(of_cell, found, minlength=len(steps)) == 0
    longest = run = 0
    for i, is_empty in enumerate(empty):
        follows = i > 0 and steps[i] == steps[i - 1] + 1
        run = (run + 1 if follows else 1) if is_empty else 0
        longest = max(longest, run)
    return longest


def find_pieces(
    voxel_map: VoxelMap, truth: Truth, frames_seen: NDArray[np.integer], min_frames: int = 20, tolerance: int = 1
) -> list[Found]:
    """Find every piece of the scene in the map.

    frames_seen: (N,) number of frames that saw each cell of `truth.surface`; cells with fewer than `min_frames` do
    not count.
    """
    known, state = known_cells(voxel_map)
    occupied = known[state == State.OCCUPIED]
    return [
        find_piece(
            piece,
            frames_seen[position(piece.cells, truth.surface)] >= min_frames,
            occupied,
            truth.voxel_size,
            tolerance,
        )
        for piece in truth.pieces
    ]


def by_part(pieces: list[Found]) -> dict[str, dict[str, Any]]:
    """Summarise each part: number of pieces, names of missing ones, seen cells, recalls and longest gap."""
    parts: dict[str, list[Found]] = {}
    for piece in pieces:
        parts.setdefault(piece.part, []).append(piece)
    return {part: _summary([piece for piece in group if piece.seen]) for part, group in parts.items()}


def _summary(group: list[Found]) -> dict[str, Any]:
    seen = sum(piece.seen for piece in group)
    return {
        "pieces": len(group),
        "missing": [piece.name for piece in group if piece.missing],
        "seen_cells": seen,
        "recall": ratio(sum(piece.exact for piece in group), seen),
        "tolerance_recall": ratio(sum(piece.near for piece in group), seen),
        "longest_gap": max((piece.longest_gap for piece in group), default=0.0),
    }
