# SPDX-License-Identifier: Apache-2.0
"""What a map says on one layer of cells, and along one ray (Chien 2020, Fig 4.6 and 4.9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap

ACROSS = {"x": ("y", "z"), "y": ("x", "z"), "z": ("x", "y")}
"""For the axis a layer stands across: the axes of its columns and of its rows."""


@dataclass(frozen=True, eq=False)
class Layer:
    """One layer of cells.

    log_odds: (rows, columns) float32, NaN where unknown; state: (rows, columns) uint8 of `State`; row 0 and column 0
    are the lowest. extent: left, right, bottom, top in metres. axes: names of columns' and rows' axis. at_m: where the
    middle of the layer stands on its axis `across`.
    """

    log_odds: NDArray[np.float32]
    state: NDArray[np.uint8]
    extent: tuple[float, float, float, float]
    axes: tuple[str, str]
    across: str
    at_m: float


def layer(voxel_map: VoxelMap, across: str, at_m: float) -> Layer:
    """Return the layer that holds the plane `across` = `at_m` metres, as large as the map's known cells.

    Raises StereovoxError where `across` is none of x, y, z, or the map is empty.
    """
    if across not in ACROSS:
        raise StereovoxError(f"layer across '{across}': name one of x, y, z")
    indices, log_odds = voxel_map.cells()
    if not len(indices):
        raise StereovoxError("the map is empty: there is no layer to show")
    normal, columns, rows = ("xyz".index(name) for name in (across, *ACROSS[across]))
    low, high = indices.min(0), indices.max(0) + 1
    number = int(np.floor(at_m / voxel_map.voxel_size))
    here = indices[:, normal] == number
    values = np.full((high[rows] - low[rows], high[columns] - low[columns]), np.nan, np.float32)
    values[indices[here, rows] - low[rows], indices[here, columns] - low[columns]] = log_odds[here]
    centres = np.empty((*values.shape, 3))
    centres[..., normal] = number
    centres[..., rows] = np.arange(low[rows], high[rows])[:, None]
    centres[..., columns] = np.arange(low[columns], high[columns])[None, :]
    state = voxel_map.state((centres.reshape(-1, 3) + 0.5) * voxel_map.voxel_size).reshape(values.shape)
    edges = np.array([low[columns], high[columns], low[rows], high[rows]]) * voxel_map.voxel_size
    extent = (float(edges[0]), float(edges[1]), float(edges[2]), float(edges[3]))
    return Layer(values, state, extent, ACROSS[across], across, (number + 0.5) * voxel_map.voxel_size)


def along_ray(
    voxel_map: VoxelMap, origin: ArrayLike, direction: ArrayLike, length_m: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return what a ray meets: distance (N + 1,) in metres at which it enters each cell, and its end; log-odds (N,).

    origin (3,) in metres, direction (3,) of any length but zero, world frame. Log-odds are 0 where nothing is known.
    """
    start, towards = np.asarray(origin, float), np.asarray(direction, float)
    if not np.linalg.norm(towards) > 0:
        raise StereovoxError(f"direction {towards.tolist()} points nowhere")
    towards = towards / np.linalg.norm(towards)
    cuts = [np.array([0.0, length_m])]
    for s, t in zip(start / voxel_map.voxel_size, towards / voxel_map.voxel_size, strict=True):
        if t != 0:
            first, last = sorted((s, s + t * length_m))
            cuts.append((np.arange(np.ceil(first), np.floor(last) + 1) - s) / t)
    distance = np.unique(np.concatenate(cuts).clip(0, length_m))
    distance = distance[np.append(True, np.diff(distance) > 1e-9)]
    middle = (distance[:-1] + distance[1:]) / 2
    return distance, voxel_map.log_odds(start + middle[:, None] * towards)
