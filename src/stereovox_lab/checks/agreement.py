# SPDX-License-Identifier: Apache-2.0
"""Agreement of two maps of the same frames on occupied cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.truth import keys, within
from stereovox.maps import State, VoxelMap


def agreement(voxel_map: VoxelMap, reference: VoxelMap) -> dict[str, float]:
    """Compare two maps of one voxel size cell by cell.

    precision, recall: share of the occupied cells of `voxel_map` (of `reference`) that are occupied in the other;
    precision_1, recall_1: the same within one cell; wrongly_free: share of the reference's occupied cells that are
    free in `voxel_map`; free_precision, free_recall: the same shares for free cells.
    """
    ours, theirs = _occupied(voxel_map), _occupied(reference)
    our_free, their_free = keys(_of_state(voxel_map, State.FREE)), keys(_of_state(reference, State.FREE))
    return {
        "precision": _share(np.isin(ours, theirs)),
        "recall": _share(np.isin(theirs, ours)),
        "precision_1": _share(within(ours, theirs, 1)),
        "recall_1": _share(within(theirs, ours, 1)),
        "wrongly_free": _share(np.isin(theirs, our_free)),
        "free_precision": _share(np.isin(our_free, their_free)),
        "free_recall": _share(np.isin(their_free, our_free)),
    }


def _occupied(voxel_map: VoxelMap) -> NDArray[np.int64]:
    return keys(_of_state(voxel_map, State.OCCUPIED))


def _of_state(voxel_map: VoxelMap, state: State) -> NDArray[np.int32]:
    indices, _ = voxel_map.cells()
    return indices[voxel_map.state(voxel_map.centers(indices)) == state]


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if len(flags) else 1.0
