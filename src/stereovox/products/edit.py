# SPDX-License-Identifier: Apache-2.0
"""Make a map from others: crop to a box, coarsen to larger cells, merge by adding evidence."""

from __future__ import annotations

from collections import Counter
from copy import deepcopy
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap, unbounded
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.cell_pool import LAST, NEVER, UNIT_NS
from stereovox.maps.cells.pyramid import coarser_config
from stereovox.maps.record.camera_path import CameraPath
from stereovox.maps.record.history import MAX_REASONS, OTHERS, History
from stereovox.maps.storage.blocks import CELLS, SIDE
from stereovox.maps.storage.storage import EVERYWHERE
from stereovox.maps.voxel_map import cells_where
from stereovox.products.blocks import add_blocks, cells_at, check_alike, in_memory, set_times
from stereovox.products.moved import moved


@one_state
def crop(voxel_map: VoxelMap, low: ArrayLike, high: ArrayLike) -> VoxelMap:
    """Keep the cells whose centre lies in a box.

    Boxes that share a face share no cell and leave none out.

    Args:
        voxel_map: The map.
        low: Lowest corner (3,) in metres, world frame, inclusive; -inf for no limit.
        high: Highest corner (3,), exclusive; inf for no limit.

    Returns:
        An unbounded map with the settings and the history of `voxel_map`.

    Raises:
        StereovoxError: `high` is not above `low`.
    """
    sides = np.array(voxel_map.config.cell)
    first, beyond = (np.ceil(corner / sides - 0.5) for corner in corners_of(low, high))
    cropped = VoxelMap(voxel_map.config)
    ends = np.clip([np.floor(first / SIDE), np.ceil(beyond / SIDE)], *EVERYWHERE[:, :1]).astype(np.int64)
    for coords, cells in voxel_map.storage.slabs_within(*ends):
        inside = _inside(coords, first, beyond)
        add_blocks(
            cropped, voxel_map, coords, np.where(inside, cells, cells.dtype.type(voxel_map.storage.cell_format.unknown))
        )
    cropped.storage.take_history(voxel_map.storage)
    return cropped


def corners_of(low: ArrayLike, high: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Validate the corners (3,) of a box; raises StereovoxError if they are invalid."""
    corners = np.asarray(low, float), np.asarray(high, float)
    if corners[0].shape != (3,) or corners[1].shape != (3,) or not (corners[0] < corners[1]).all():
        raise StereovoxError(f"box from {low} to {high}: give two corners X, Y, Z, the second above the first on each")
    return corners


def _inside(coords: NDArray[np.int32], first: NDArray[np.float64], beyond: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which cells (n, 512) of blocks (n, 3) have indices in [first, beyond)."""
    numbers = coords[:, :, None] * SIDE + np.arange(SIDE)
    x, y, z = ((numbers >= first[:, None]) & (numbers < beyond[:, None])).swapaxes(0, 1)
    return (x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]).reshape(-1, CELLS)


Parents = tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], NDArray[np.uint32]]
"""Cells (N, 3); and (N,) the number of known cells in each, the largest value these store, their latest time."""


@one_state
def coarsen(voxel_map: VoxelMap, factor: int) -> VoxelMap:
    """Merge cells into larger ones.

    A coarse cell has the worst state of its parts: occupied, then tentative, unknown, free. So it is free only if
    all of them are, and nothing occupied is lost. Its log-odds are the largest of theirs, its time the latest.

    Args:
        voxel_map: The map.
        factor: How many times longer each side becomes; a whole number, 1 or more.

    Returns:
        An unbounded map with the history of `voxel_map`.

    Raises:
        StereovoxError: `factor` is not such a number, or makes cells too large.
    """
    if not 1 <= factor < 2**31 or factor != int(factor):
        raise StereovoxError(f"factor {factor}: give a whole number of cells, 1 or more")
    settings = coarser_config(voxel_map.config, int(factor))
    parts = [_parents(voxel_map, coords, cells, int(factor)) for coords, cells in voxel_map.storage.slabs()]
    indices, number, stored, times = _grouped(*map(np.concatenate, zip(*parts, strict=True)))
    sure = (number == int(factor) ** 3) | (CellRules(voxel_map.config.map).states(stored) != State.FREE)
    coarse = VoxelMap.from_cells(settings, indices[sure], voxel_map.storage.cell_format.log_odds(stored[sure]))
    if settings.map.keep_times:
        set_times(coarse, indices[sure], times[sure], voxel_map.storage.times_start_ns)
    coarse.storage.take_history(voxel_map.storage)
    return coarse


def _parents(voxel_map: VoxelMap, coords: NDArray[np.int32], cells: NDArray[np.integer], factor: int) -> Parents:
    known = cells != voxel_map.storage.cell_format.unknown
    indices, stored = cells_where(coords, cells, known)
    times = np.zeros(len(stored), np.uint32)
    if voxel_map.config.map.keep_times:
        times = voxel_map.storage.times_of(coords)[known]
    return _grouped(indices.astype(np.int64) // factor, np.ones(len(stored), np.int64), stored.astype(np.int64), times)


def _grouped(
    indices: NDArray[np.int64], number: NDArray[np.int64], stored: NDArray[np.int64], times: NDArray[np.uint32]
) -> Parents:
    """Return each cell once, with the sum of the numbers of cells and the largest of the rest."""
    if not len(indices):
        return indices, number, stored, times
    order = np.lexsort(indices.T)
    indices = indices[order]
    starts = np.flatnonzero(np.append(True, (indices[1:] != indices[:-1]).any(axis=1)))
    highest, latest = (np.maximum.reduceat(values[order], starts) for values in (stored, times))
    return indices[starts], np.add.reduceat(number[order], starts), highest, latest


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
