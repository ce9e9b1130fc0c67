# SPDX-License-Identifier: Apache-2.0
"""The pyramid of a map in boxes: levels of cells twice as large, so that all of a big map can be shown.

A coarse cell has the worst state of its eight parts, as in `edit.coarsen`: it is free only if all of them are.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.files.places import Place
from stereovox.maps.cells.cell_format import CellRules, State
from stereovox.maps.storage.blocks import CELLS, SIDE
from stereovox.maps.storage.boxes import BoxBlocks, BoxEntry, BoxLayout, Index, read_box, write_blocks

SMALL = 100_000
"""The pyramid ends with a level of at most this many known cells, or of one box."""
HALF = SIDE // 2
PIECE = 4096
"""Blocks that are coarsened at once."""


def coarser_config(config: Config, factor: int) -> Config:
    """Return the settings of a map whose cells are `factor` times longer along each side."""
    steps = config.steps and [float(f"{side * factor:.12g}") for side in config.steps]
    return load_config(config, steps=steps, voxel_size=float(f"{config.voxel_size * factor:.12g}"))


def coarser_layout(layout: BoxLayout) -> BoxLayout:
    """Return the layout of the next level: boxes of as many cells, each twice as long; without times."""
    config = coarser_config(layout.config, 2)
    config = load_config(config, map=config.map.model_copy(update={"keep_times": False, "forget_s": None}).model_dump())
    return BoxLayout(config, layout.side, layout.level + 1)


def parent_of(index: Sequence[int]) -> Index:
    """Return the box of the next level that covers a box."""
    i, j, k = (int(n) // 2 for n in index)
    return i, j, k


def families(entries: Iterable[BoxEntry]) -> dict[Index, list[BoxEntry]]:
    """Return the boxes of a level grouped by the next level's box that covers them, for `write_parent`."""
    found: dict[Index, list[BoxEntry]] = defaultdict(list)
    for entry in entries:
        found[parent_of(entry.box)].append(entry)
    return dict(found)


def names_of(family: Iterable[BoxEntry]) -> frozenset[str]:
    """Return the names of a family, which identify its content: boxes are named after theirs."""
    return frozenset(entry.name for entry in family)


def write_parent(place: Place, layout: BoxLayout, children: Sequence[BoxEntry]) -> BoxEntry | None:
    """Write the next level's box that covers `children`, all boxes of one family; return its entry.

    layout: of the children. None if no coarse cell is known. Raises MapFileError as `read_box` and `write_box` do.
    """
    parts = [halved(layout.rules, *read_box(place, layout, child)[:2]) for child in children]
    blocks = _joined(parts, layout.rules.format.unknown)
    return write_blocks(place, coarser_layout(layout), parent_of(children[0].box), blocks)


def _joined(parts: Sequence[tuple[NDArray[np.int32], NDArray[np.integer]]], unknown: int) -> BoxBlocks:
    """Return the blocks of all parts in order; boxes of an odd number of blocks share blocks, but no cells."""
    coords, of_block = np.unique(np.concatenate([coords for coords, _ in parts]), axis=0, return_inverse=True)
    cells = np.full((len(coords), CELLS), unknown, parts[0][1].dtype)
    ends = np.cumsum([len(own) for own, _ in parts])
    for (_, theirs), ours in zip(parts, np.split(of_block.ravel(), ends[:-1]), strict=True):
        cells[ours] = np.where(theirs == unknown, cells[ours], theirs)
    return BoxBlocks(coords, cells)


def write_levels(place: Place, layout: BoxLayout, entries: Sequence[BoxEntry]) -> list[list[BoxEntry]]:
    """Write all coarser levels of these boxes in order; return their entries, for a manifest."""
    levels: list[list[BoxEntry]] = []
    while not is_top(entries):
        parents = (write_parent(place, layout, family) for family in families(entries).values())
        entries, layout = [parent for parent in parents if parent is not None], coarser_layout(layout)
        levels.append(entries)
    return levels


def is_top(entries: Sequence[BoxEntry]) -> bool:
    """Return whether a level needs none above it: it is small, or one box."""
    return len(entries) <= 1 or sum(entry.known for entry in entries) <= SMALL


def halved(
    rules: CellRules, coords: NDArray[np.int32], cells: NDArray[np.integer]
) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
    """Return the blocks (m, 3) and cells (m, 512), twice as large, that cover blocks (n, 3) with cells (n, 512)."""
    above, of_block = np.unique(coords >> 1, axis=0, return_inverse=True)
    coarse = np.full((len(above), SIDE, SIDE, SIDE), rules.format.unknown, rules.format.dtype)
    octants = coarse.reshape(-1, 2, HALF, 2, HALF, 2, HALF)
    for start in range(0, len(coords), PIECE):
        part = slice(start, start + PIECE)
        x, y, z = (coords[part] & 1).T
        octants[of_block.ravel()[part], x, :, y, :, z] = _eighths(rules, cells[part])
    return above.astype(np.int32), coarse.reshape(-1, CELLS)


def _eighths(rules: CellRules, cells: NDArray[np.integer]) -> NDArray[np.integer]:
    """Return blocks (n, 512) as blocks of coarse cells (n, 4, 4, 4)."""
    unknown = rules.format.unknown
    parts = cells.reshape(-1, HALF, 2, HALF, 2, HALF, 2)
    known = parts != unknown
    worst = np.where(known, parts, np.iinfo(cells.dtype).min).max(axis=(2, 4, 6))
    sure = known.all(axis=(2, 4, 6)) | (known.any(axis=(2, 4, 6)) & (rules.states(worst) != State.FREE))
    return np.where(sure, worst, cells.dtype.type(unknown))
