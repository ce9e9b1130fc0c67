# SPDX-License-Identifier: Apache-2.0
"""Merge two maps by adding their evidence."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap, unbounded
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.cell_times import LAST, NEVER, UNIT_NS
from stereovox.maps.record.camera_path import CameraPath
from stereovox.maps.record.history import MAX_REASONS, OTHERS, History
from stereovox.maps.storage.blocks import CELLS
from stereovox.products.block_pairs import cells_at, check_alike, in_memory
from stereovox.products.moved import moved


@one_state
def merge(a: VoxelMap, b: VoxelMap, T_a_b: ArrayLike | None = None) -> VoxelMap:
    """Merge two maps.

    Evidence adds up: log-odds a + b - prior, each counted from its own prior, then clamped (Thrun et al. 2005,
    Probabilistic Robotics, 9.2). If nothing was clamped before, the result is the map of all frames together, except
    for one step of a stored number if a sum hit "unknown" exactly. A cell unknown to one map is the other's.
    Times and viewpoint are the later ones; frames and refusals are summed.

    Args:
        a: A map, whose settings the result has.
        b: Another map.
        T_a_b: (4, 4), maps the world frame of `b` into that of `a` (see `moved`); None if they are the same.

    Returns:
        An unbounded map.

    Raises:
        StereovoxError: The cell sizes differ, T_a_b is not a rigid motion, or there is none and the maps' `up` differs.
    """
    check_alike(a, b, T_a_b)
    b = in_memory(b)
    if T_a_b is not None:
        b = moved(b, T_a_b)
    merged = unbounded(a)
    start_ns = b.storage.times_start_ns if a.storage.times_start_ns is None else a.storage.times_start_ns
    for coords, cells in b.storage.slabs():
        times = _later(merged, b, coords, start_ns) if a.config.map.keep_times else None
        merged.storage.insert(coords, _summed(a, cells_at(merged, coords), b, cells))
        if times is not None:
            merged.storage.set_times(coords, times, start_ns)
    merged.history = together(a.history, b.history)
    viewpoints = [one.viewpoint for one in (a, b) if one.viewpoint]
    merged.viewpoint = max(viewpoints, key=lambda viewpoint: viewpoint.stamp_ns, default=None)
    return merged


def _summed(a: VoxelMap, mine: NDArray[np.integer], b: VoxelMap, theirs: NDArray[np.integer]) -> NDArray[np.integer]:
    """Return `a`'s stored cells with the evidence of `b`'s stored cells added."""
    rules, other = CellRules(a.config.map), CellRules(b.config.map)
    scale = rules.format.per_log_odds / other.format.per_log_odds
    evidence = np.rint((theirs.astype(np.int32) - other.prior) * scale).astype(np.int32)
    number = np.where(mine == rules.format.unknown, rules.prior, mine) + evidence
    number = np.clip(number, rules.lowest, rules.highest)
    number += number == rules.format.unknown
    return np.where(theirs == other.format.unknown, mine, number).astype(mine.dtype)


def _later(a: VoxelMap, b: VoxelMap, coords: NDArray[np.int32], start_ns: int | None) -> NDArray[np.uint32]:
    """Return the later time (n, 512) of each cell of blocks (n, 3), counted from `start_ns`; NEVER if none is kept."""
    times = np.full((len(coords), CELLS), NEVER, np.int64)
    for one in (a, b):
        if one.config.map.keep_times and one.storage.times_start_ns is not None and start_ns is not None:
            kept = np.where(
                cells_at(one, coords) == one.storage.cell_format.unknown, NEVER, one.storage.times_of(coords)
            )
            shifted = kept.astype(np.int64) + (one.storage.times_start_ns - start_ns) // UNIT_NS
            times = np.maximum(times, np.where(kept == NEVER, NEVER, np.clip(shifted, NEVER + 1, LAST)))
    return times.astype(np.uint32)


def together(a: History, b: History) -> History:
    """Return the summed counts; which sensor each map trusted last does not carry over to the next frame."""
    names = dict.fromkeys(name for name in (a.recording, b.recording) if name)
    lasts = [one for one in (a.last_frame, b.last_frame) if one]
    return History(
        frames=a.frames + b.frames,
        refused=_counts(a.refused + b.refused),
        settled=_counts(a.settled + b.settled),
        quality=_counts(a.quality + b.quality),
        recording=" + ".join(names),
        last_frame=max(lasts, key=lambda last: last[1], default=None),
        path=_both_paths(a.path, b.path),
        recordings=a.recordings + b.recordings,
    )


def _both_paths(a: CameraPath, b: CameraPath) -> CameraPath:
    """Return the paths of all cameras; a camera of `b` with a name of `a` gets a plus sign."""
    path = replace(deepcopy(a), spacing=max(a.spacing, b.spacing))
    for sensor, stops in b.stops.items():
        while sensor in path.stops:
            sensor += "+"
        for seen in stops:
            path.walk(sensor, seen)
    return path


def _counts(counts: Counter[str]) -> Counter[str]:
    """Return the counts, limited to as many reasons as a saved map may have."""
    kept = Counter(dict(counts.most_common(MAX_REASONS)))
    if rest := counts.total() - kept.total():
        kept[OTHERS] += rest
    return kept
