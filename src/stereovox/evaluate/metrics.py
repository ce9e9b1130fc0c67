# SPDX-License-Identifier: Apache-2.0
"""Agreement of a map with the truth: pure functions on sets of cells and boolean arrays.

Summary of a run as a dict of numbers, the same for every command.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.truth import Keys, Piece, Truth, indices, keys, position, within
from stereovox.frame import UpdateReport
from stereovox.maps import State, VoxelMap
from stereovox.maps.grid_map import GridMap
from stereovox.maps.record.history import UNCONFIRMED

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


def summarise(voxel_map: VoxelMap | GridMap, reports: Sequence[UpdateReport]) -> dict[str, Any]:
    """Summarise frames, refusals by reason, quality levels, milliseconds, cells and memory of a run.

    `settled`: number of times frames were accepted again after a jump or a reset, by description. `quality`:
    number of frames by quality level, full or reduced to meet the deadline (docs/safety.md).
    `frame_ms` is the whole frame, `match_ms` (stereo pairs only), `depth_ms` and `integrate_ms` are its parts.
    Times leave out the first mapped frame, which may compile kernels. `memory_reserved`: the memory is a
    window's, reserved at the start.
    """
    mapped = [report for report in reports if not report.refused]
    refused = Counter(report.refused for report in reports if report.refused)
    taken_out = max((n for n, report in enumerate(mapped) if report.taken_out), default=0)
    if taken_out:
        refused[UNCONFIRMED] += taken_out
    return {
        "frames": len(mapped) - taken_out,
        "frames_refused": refused.total(),
        "refused": dict(refused.most_common()),
        "settled": dict(Counter(report.detail for report in mapped if report.detail).most_common()),
        "quality": dict(Counter(report.quality for report in mapped).most_common()),
        "match_ms": percentiles([report.match_ms for report in mapped if report.match_ms]),
        "depth_ms": percentiles([report.depth_ms for report in mapped]),
        "integrate_ms": percentiles([report.integrate_ms for report in mapped]),
        "frame_ms": percentiles([report.match_ms + report.depth_ms + report.integrate_ms for report in mapped]),
        **voxel_map.counts(),
        "memory_bytes": voxel_map.memory_bytes,
        "memory_reserved": voxel_map.config.window.size is not None,
    }


def mostly_lost(frames: int, offered: int, what: str, became: str = "are in the map") -> list[dict[str, Any]]:
    """Return, for the summary, a doubt if less than half of the frames are in the map; else nothing.

    frames: number of this run's `offered` frames in the map. what: their name (images). became: predicate of the frames
    that are not lost.
    """
    if 2 * frames >= offered:
        return []
    text = f"only {frames} of {offered} {what} {became}"
    return [{"kind": "mostly_lost", "frames": frames, "offered": offered, "text": text}]


def percentiles(milliseconds: Sequence[float]) -> dict[str, float]:
    """Return median, p90, p99 and max without the first of several values; zeros for no values."""
    values = np.percentile(milliseconds[1:] or milliseconds or [0.0], [50, 90, 99, 100])
    return {name: round(float(value), 4) for name, value in zip(("median", "p90", "p99", "max"), values, strict=True)}
