# SPDX-License-Identifier: Apache-2.0
"""Which cells a pinhole camera has in view: their centre falls into the image and is no farther than the range."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.frame import Viewpoint
from stereovox.geometry import transform_points
from stereovox.maps.blocks import SIDE

COARSE = 16
"""The search starts with boxes this many blocks wide and halves them."""
AT_ONCE = 2048
"""Blocks looked at together: what is computed for them stays in the cache."""
OCTANTS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
CELLS = np.stack(np.meshgrid(*[np.arange(SIDE)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5


@dataclass(frozen=True, eq=False)
class Volume:
    """A convex volume: points x with normals @ x + offsets >= 0, in all rows; normals (P, 3), offsets (P,).

    low, high: (3,) of a box around it.
    """

    normals: NDArray[np.float64]
    offsets: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def project(camera: PinholeCamera, points: NDArray[np.floating]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the pixels (N, 2) of points (N, 3) in the optical frame, and which fall into the image.

    The image reaches half a pixel beyond the centres of its outermost pixels. Pixels of points behind the camera are
    NaN.
    """
    x, y, z = np.asarray(points, float).T
    ahead = z > 0
    z = np.where(ahead, z, np.nan)
    pixels = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    with np.errstate(invalid="ignore"):
        shown = ((pixels >= -0.5) & (pixels < [camera.width - 0.5, camera.height - 0.5])).all(axis=1)
    return pixels, np.asarray(shown)


def view_volume(viewpoint: Viewpoint, max_range: float, voxel_size: float) -> Volume:
    """Return what the camera sees up to `max_range` metres along its axis, in cells of `voxel_size`, world frame."""
    camera, T = viewpoint.camera, viewpoint.T_world_camera
    left, right = camera.cx + 0.5, camera.width - 0.5 - camera.cx
    top, bottom = camera.cy + 0.5, camera.height - 0.5 - camera.cy
    sides = [[camera.fx, 0, left], [-camera.fx, 0, right], [0, camera.fy, top], [0, -camera.fy, bottom]]
    normals = np.array([*sides, [0, 0, 1], [0, 0, -1]], float) @ T[:3, :3].T
    offsets = np.array([0, 0, 0, 0, 0, max_range]) / voxel_size - normals @ T[:3, 3] / voxel_size
    far = np.array([[x / camera.fx, y / camera.fy, 1] for x in (-left, right) for y in (-top, bottom)]) * max_range
    corners = transform_points(T, np.vstack([np.zeros(3), far])) / voxel_size
    return Volume(normals, offsets, corners.min(axis=0), corners.max(axis=0))


def blocks_in(volume: Volume) -> Iterator[tuple[NDArray[np.int32], NDArray[np.bool_]]]:
    """Yield blocks (n, 3) of 8x8x8 cells and which of their cells (n, 512) have their centre in `volume`."""
    inner, border = _candidates(volume)
    for some in _pieces(inner):
        yield some, np.ones((len(some), SIDE**3), bool)
    for some in _pieces(border):
        cells = _cells_in(volume, some)
        any_cell = cells.any(axis=1)
        yield some[any_cell], cells[any_cell]


def _candidates(volume: Volume) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the blocks wholly in the volume, and those that may be in it in part."""
    size = COARSE
    low = np.floor(volume.low / (size * SIDE)).astype(int)
    counts = np.floor(volume.high / (size * SIDE)).astype(int) - low + 1
    blocks = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, 3) + low
    while True:
        wholly, partly = _sides(volume, blocks, size * SIDE)
        if size == 1:
            return blocks[wholly].astype(np.int32), blocks[partly].astype(np.int32)
        blocks = (2 * blocks[wholly | partly][:, None, :] + OCTANTS).reshape(-1, 3)
        size //= 2


def _sides(volume: Volume, boxes: NDArray[np.int_], width: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell which boxes (n, 3), `width` cells wide, lie wholly in the volume and which perhaps partly."""
    distance = (boxes + 0.5) * width @ volume.normals.T + volume.offsets
    reach = width / 2 * np.abs(volume.normals).sum(axis=1)
    wholly = (distance >= reach).all(axis=1)
    return wholly, (distance >= -reach).all(axis=1) & ~wholly


def _cells_in(volume: Volume, blocks: NDArray[np.int32]) -> NDArray[np.bool_]:
    found = np.ones((len(blocks), SIDE**3), bool)
    for normal, offset in zip(volume.normals, volume.offsets, strict=True):
        found &= (SIDE * blocks @ normal + offset)[:, None] + CELLS @ normal >= 0
    return found


def _pieces(blocks: NDArray[np.int32]) -> Iterator[NDArray[np.int32]]:
    return (blocks[start : start + AT_ONCE] for start in range(0, len(blocks), AT_ONCE))
