# SPDX-License-Identifier: Apache-2.0
"""Changes from one map to another."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.files.safe_io import replacing
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.voxel_map import cells_where
from stereovox.products.blocks import block_pairs, check_alike, in_memory
from stereovox.products.moved import moved


@dataclass(frozen=True, eq=False)
class Difference:
    """How map `a` became map `b`: cells (N, 3) int32 in ascending order, in the frame of `a`.

    Attributes:
        appeared: Free before, occupied now.
        vanished: Occupied before, free now.
        became_known: Unknown before, known now in any state.
        became_unknown: Known before, unknown now.
        counts: (4, 4) int64, cells by their `State` in `a` (row) and in `b` (column); 0 where unknown to both.
    """

    appeared: NDArray[np.int32]
    vanished: NDArray[np.int32]
    became_known: NDArray[np.int32]
    became_unknown: NDArray[np.int32]
    counts: NDArray[np.int64]


@one_state
def difference(a: VoxelMap, b: VoxelMap, T_a_b: ArrayLike | None = None) -> Difference:
    """Compare two maps cell by cell; each map's own settings determine its states.

    Cells that are tentative in one of the maps count as neither appeared nor vanished.

    Args:
        a: The earlier map.
        b: The later map.
        T_a_b: (4, 4), maps the world frame of `b` into that of `a` (see `moved`); None if they are the same.

    Returns:
        The changes.

    Raises:
        StereovoxError: The cell sizes differ, T_a_b is not a rigid motion, or there is none and the maps' `up` differs.
    """
    check_alike(a, b, T_a_b)
    a, b = in_memory(a), in_memory(b) if T_a_b is None else moved(in_memory(b), T_a_b)
    before, after = CellRules(a.config.map), CellRules(b.config.map)
    found = []
    counts = np.zeros(len(State) ** 2, np.int64)
    for coords, cells_a, cells_b in block_pairs(a, b):
        pairs = before.states(cells_a) * len(State) + after.states(cells_b)
        counts += np.bincount(pairs.ravel(), minlength=len(counts))
        found.append([cells_where(coords, pairs, chosen)[0] for chosen in _kinds(pairs)])
    counts[0] = 0  # from blocks that also hold known cells
    kinds = [_ascending(np.concatenate(kind)) for kind in zip(*found, strict=True)]
    return Difference(*kinds, counts=counts.reshape(4, 4))


def write_difference(changes: Difference, cell: tuple[float, float, float], path: str | Path) -> None:
    """Write the arrays of a `Difference` for `numpy.load`, and `cell`, the sides of a cell in metres.

    Raises MapFileError if the file cannot be written.
    """
    with replacing(path) as file:
        np.savez_compressed(file, cell=np.array(cell), **asdict(changes))


def _kinds(pairs: NDArray[np.uint8]) -> list[NDArray[np.bool_]]:
    """Return masks of the four kinds of changes, by the state numbers before and after."""
    before, after = np.divmod(pairs, len(State))
    return [
        (before == State.FREE) & (after == State.OCCUPIED),
        (before == State.OCCUPIED) & (after == State.FREE),
        (before == State.UNKNOWN) & (after != State.UNKNOWN),
        (before != State.UNKNOWN) & (after == State.UNKNOWN),
    ]


def _ascending(indices: NDArray[np.int32]) -> NDArray[np.int32]:
    return indices[np.lexsort(indices.T[::-1])]
