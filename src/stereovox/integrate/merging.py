# SPDX-License-Identifier: Apache-2.0
"""Evidence of several images that were taken at once, as that of one frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.integrate import _lanes
from stereovox.maps.blocks import CELLS, BlockPool
from stereovox.maps.evidence import Evidence


def strongest(parts: Sequence[Evidence]) -> Evidence:
    """Return one frame's evidence: a cell keeps the strongest, positive before negative, of all `parts`.

    Blocks that are wholly free in one part alone stay so; they are spelt out where another part has the block as well.
    """
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return Evidence(
            np.empty((0, 3), np.int32),
            np.empty((0, CELLS), np.int16),
            np.empty((0, 3), np.int32),
            np.empty(0, np.int16),
        )
    pool = BlockPool(np.int16, capacity=max(1, sum(len(part.coords) + len(part.uniform) for part in parts)))
    free, free_values, shared = _alone(parts)
    for part, both in zip(parts, shared, strict=True):
        _lanes.merge(pool.values, part.values, pool.insert(part.coords), False)
        spelt = np.repeat(part.uniform_values[both, None], CELLS, axis=1)
        _lanes.merge(pool.values, spelt, pool.insert(part.uniform[both]), False)
    n = len(pool)
    return Evidence(pool.coords[:n].copy(), pool.values[:n].copy(), free, free_values)


def _alone(parts: Sequence[Evidence]) -> tuple[NDArray[np.int32], NDArray[np.int16], list[NDArray[np.bool_]]]:
    """Return the uniform blocks that no part spells out, each once with its strongest value, and for each part which of
    its own others do."""
    spelt = np.unique(np.concatenate([part.coords for part in parts]), axis=0)
    known = {tuple(block) for block in spelt.tolist()}
    shared = [np.array([tuple(b) in known for b in part.uniform.tolist()], bool) for part in parts]
    pairs = list(zip(parts, shared, strict=True))
    alone, of_block = np.unique(
        np.concatenate([part.uniform[~both] for part, both in pairs]), axis=0, return_inverse=True
    )
    values = np.zeros(len(alone), np.int16)
    np.minimum.at(values, of_block.ravel(), np.concatenate([part.uniform_values[~both] for part, both in pairs]))
    return alone.astype(np.int32).reshape(-1, 3), values, shared
