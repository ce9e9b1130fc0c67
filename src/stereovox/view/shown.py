# SPDX-License-Identifier: Apache-2.0
"""What a viewer shows of a map: the cells in a state, those without evidence beside free ones, and their colours."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.cells import keys, position
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import floor_axes
from stereovox.view.picture import height_scale
from stereovox.view.scale import COLOURS

HEIGHT, PROBABILITY, AGE = "height", "probability", "age"
AGES = "plasma_r"
TIMELESS = "#8a8f98"
"""Colour of cells that were put in without a time."""
BESIDE = np.concatenate([np.eye(3, dtype=np.int32), -np.eye(3, dtype=np.int32)])


def unknown_shell(voxel_map: VoxelMap) -> NDArray[np.int32]:
    """Return indices (N, 3) of the cells without evidence that share a face with a free cell: where knowledge ends."""
    free = voxel_map.cells_in(State.FREE)
    known = np.sort(keys(np.concatenate([free, *map(voxel_map.cells_in, (State.TENTATIVE, State.OCCUPIED))])))
    shell = [np.empty((0, 3), np.int32)]
    for step in BESIDE:
        beside = free + step
        shell.append(beside[position(keys(beside), known) < 0])
    cells = np.concatenate(shell)
    return cells[np.unique(keys(cells), return_index=True)[1]]


def values_of(voxel_map: VoxelMap, cells: NDArray[np.int32], colour: str, up: str) -> NDArray[np.float64]:
    """Return what cells (N, 3) are coloured by, (N,): height in metres along `up`, probability, or age in seconds."""
    if colour == HEIGHT:
        return heights(voxel_map, cells, up)
    centres = voxel_map.centers(cells)
    found = voxel_map.probability(centres) if colour == PROBABILITY else voxel_map.age(centres)
    return np.asarray(found, float)


def heights(voxel_map: VoxelMap, cells: NDArray[np.int32], up: str) -> NDArray[np.float64]:
    """Return the height (N,) in metres along `up` of the middle of cells (N, 3)."""
    _, _, axis, sign = floor_axes(up)
    return sign * (cells[:, axis].astype(np.float64) + 0.5) * voxel_map.voxel_size


def colours_of(values: NDArray[np.floating], colour: str, voxel_size: float) -> Any:
    """Return matplotlib's colours for what `values_of` gave: a mappable."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    known = values[np.isfinite(values)]
    if colour == HEIGHT:
        return height_scale(known, voxel_size)
    if colour == PROBABILITY:
        return ScalarMappable(Normalize(0, 1), LinearSegmentedColormap.from_list(PROBABILITY, COLOURS))
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    return ScalarMappable(Normalize(low, max(high, low + 1e-3)), colormaps[AGES].with_extremes(bad=TIMELESS))
