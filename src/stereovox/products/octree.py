# SPDX-License-Identifier: Apache-2.0
"""Cells to a pruned octree of 16 levels, in the node order of OctoMap's files; whole levels at a time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError

DEPTH = 16
"""Levels below the root; a cell of the finest level has a 16-bit key on each axis."""
KEY_ZERO = 1 << (DEPTH - 1)
"""The key of cell index 0: keys are indices plus this."""
FREE, OCCUPIED, BRANCH = 1, 2, 3
"""What a node says about each child, in two bits; 0 where there is none."""


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of one or more levels, in ascending order.

    codes: (n,) uint64 Morton code of the node within its level (x lowest, then y, then z).
    values: (n,) float32, of a branch the largest value below it.
    children: (n,) uint16, two bits a child (child 0 lowest): 0 none, `FREE` (value < 0), `OCCUPIED` or `BRANCH`;
    0 marks a leaf.
    """

    codes: NDArray[np.uint64]
    values: NDArray[np.float32]
    children: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, which: NDArray) -> Nodes:
        return Nodes(self.codes[which], self.values[which], self.children[which])


def build_octree(indices: NDArray[np.integer], values: NDArray[np.float32]) -> Nodes:
    """Return all nodes, root first, each before its children, of the tree of cells (N, 3) with values (N,).

    Eight leaves of equal value become one. The cells are distinct; `codes` of the result are the sorting keys.
    Raises MapFileError for a cell index outside [-32768, 32768).
    """
    codes = morton_codes(indices)
    order = np.argsort(codes)
    level = Nodes(codes[order], np.asarray(values, np.float32)[order], np.zeros(len(order), np.uint16))
    kept = []
    for height in range(DEPTH):
        parents, lasting = _one_level_up(level)
        kept.append(_with_sort_keys(level[lasting], height))
        level = parents
    kept.append(_with_sort_keys(level, DEPTH))
    nodes = Nodes(*(np.concatenate([getattr(part, name) for part in kept]) for name in Nodes.__annotations__))
    return nodes[np.argsort(nodes.codes)]


def morton_codes(indices: NDArray[np.integer]) -> NDArray[np.uint64]:
    """Return the 48-bit Morton codes (N,) of cells (N, 3): bits of x, y and z in turn, x lowest."""
    keys = np.asarray(indices, np.int64) + KEY_ZERO
    outside = ((keys < 0) | (keys >= 2 * KEY_ZERO)).any(axis=1)
    if outside.any():
        cell = tuple(int(k) - KEY_ZERO for k in keys[outside][0])
        raise MapFileError(
            f"cell {cell} does not fit: OctoMap files hold cells {-KEY_ZERO} to {KEY_ZERO - 1} on each axis; "
            "use larger cells or a map nearer the origin"
        )
    x, y, z = (_spread_table()[keys[:, axis]] for axis in range(3))
    return x | (y << np.uint64(1)) | (z << np.uint64(2))


@lru_cache
def _spread_table() -> NDArray[np.uint64]:
    """Every 16-bit number with two empty bits before each bit."""
    numbers = np.arange(2 * KEY_ZERO, dtype=np.uint64)
    spread = np.zeros_like(numbers)
    for bit in range(DEPTH):
        spread |= (numbers >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit)
    return spread


def _one_level_up(level: Nodes) -> tuple[Nodes, NDArray[np.bool_]]:
    """Return the parents of a level's nodes, and which of the nodes last: eight equal leaves become their parent."""
    if not len(level):
        return level, np.zeros(0, bool)
    codes = level.codes >> np.uint64(3)
    first = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
    number = np.diff(np.append(first, len(codes)))
    largest = np.maximum.reduceat(level.values, first)
    uniform = (number == 8) & (largest == np.minimum.reduceat(level.values, first))
    uniform &= np.bitwise_or.reduceat(level.children, first) == 0
    children = np.where(uniform, 0, np.bitwise_or.reduceat(_as_children(level), first)).astype(np.uint16)
    return Nodes(codes[first], largest, children), np.repeat(~uniform, number)


def _as_children(level: Nodes) -> NDArray[np.uint16]:
    kinds = np.where(level.children > 0, BRANCH, np.where(level.values < 0, FREE, OCCUPIED)).astype(np.uint16)
    return kinds << (2 * (level.codes & np.uint64(7))).astype(np.uint16)


def _with_sort_keys(level: Nodes, height: int) -> Nodes:
    """Replace codes by numbers that order nodes of all levels: by their lowest cell, then parents before children."""
    keys = level.codes << np.uint64(3 * height + 5) | np.uint64(DEPTH - height)
    return Nodes(keys, level.values, level.children)
