# SPDX-License-Identifier: Apache-2.0
"""Plain pictures without axes or text, in NumPy alone: a layer of a map, its cells in 3-D, a depth image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import layer
from stereovox.view.drawn import turned
from stereovox.view.figures import STATE_COLOURS
from stereovox.view.render import Direction

SIZE_PX = 640
"""Width or height of a picture of a map, whichever is longer."""
MAX_PX = 24.0
"""Largest side of a cube."""
FROM = Direction.of(-60, 38)
_LIGHT = np.array([0.8, 0.62, 1.0])
"""Brightness of the faces perpendicular to each axis."""
_STATES = np.array([[int(STATE_COLOURS[state][i : i + 2], 16) for i in (1, 3, 5)] for state in sorted(State)], np.uint8)


def plan_pixels(voxel_map: VoxelMap) -> NDArray[np.uint8]:
    """Return the layer at the camera's height (or at 0) in the colours of its states: (rows, columns, 3) RGB."""
    axis = "xyz".index(voxel_map.config.up[-1])
    viewpoint = voxel_map.viewpoint
    at_m = 0.0 if viewpoint is None else float(viewpoint.T_world_camera[axis, 3])
    states = layer(voxel_map, "xyz"[axis], at_m).state[::-1]
    times = max(1, SIZE_PX // max(states.shape))
    return _STATES[states].repeat(times, axis=0).repeat(times, axis=1)


def space_pixels(voxel_map: VoxelMap) -> NDArray[np.uint8]:
    """Return the occupied cells as shaded cubes coloured by height, from the side and above: (rows, columns, 3) RGB."""
    up = voxel_map.config.up
    cells = turned(np.floor(voxel_map.occupied() / voxel_map.voxel_size) + 0.5, up)
    if not len(cells):
        return np.full((SIZE_PX, SIZE_PX, 3), 255, np.uint8)
    cells = cells[np.argsort(cells @ FROM.toward)]  # far ones first: nearer ones overwrite them
    flat = FROM.flat(cells)
    low, high = flat.min(0) - 1, flat.max(0) + 1
    scale = min(SIZE_PX / float((high - low).max()), MAX_PX)
    width, height = np.ceil((high - low) * scale).astype(int) + 2
    column, row = (np.rint((flat - low) * scale) * [1, -1] + [0, height - 2]).astype(np.int64).T
    front = _painted(row * width + column, *_cube(scale), width, np.zeros(height * width, np.int32))
    levels = cells[:, 2] - cells[:, 2].min()
    shade = _RAINBOW[(255 * levels / max(float(levels.max()), 1.0)).astype(np.uint8)]
    colours = (shade[:, None, :] * _LIGHT[:, None]).astype(np.uint8).reshape(-1, 3)
    return np.concatenate([[[255, 255, 255]], colours]).astype(np.uint8)[front].reshape(height, width, 3)


def colour_depth(depth_m: NDArray[np.floating], max_range: float) -> NDArray[np.uint8]:
    """Return a depth image (height, width) in metres as RGB (height, width, 3): near red, far blue, no value black."""
    shade = np.zeros(depth_m.shape, np.uint8)
    known = np.isfinite(depth_m)
    scaled = np.multiply(depth_m, 254 / max_range, where=known, out=np.zeros(depth_m.shape, np.float32))
    np.add(np.minimum(scaled, 254), 1, where=known, out=shade, casting="unsafe")
    return _DEPTHS[shade]


def _cube(scale: float) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the pixels of a cube `scale` pixels long, from its centre: columns, rows, and the axis of their face."""
    reach = int(np.ceil(0.9 * scale)) + 1
    down, across = (grid.ravel() for grid in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    points = (across[:, None] * FROM.right - down[:, None] * FROM.up) / scale
    half = np.sign(FROM.toward) * (0.5 + 0.4 / scale)  # a little larger: rounding must leave no gaps
    leaves, enters = (half - points) / FROM.toward, (-half - points) / FROM.toward
    seen = enters.max(axis=1) < leaves.min(axis=1)
    return across[seen], down[seen], np.argmin(leaves[seen], axis=1)


def _painted(
    middle: NDArray[np.int64],
    across: NDArray[np.int64],
    down: NDArray[np.int64],
    face: NDArray[np.int64],
    width: int,
    front: NDArray[np.int32],
) -> NDArray[np.int32]:
    """Return `front` (pixels,) with 1 + 3 * cell + face of the last cell in order that covers each pixel."""
    number = 1 + 3 * np.arange(len(middle), dtype=np.int32)
    for dx, dy, side in zip(across.tolist(), down.tolist(), face.tolist(), strict=True):
        place = (middle + (dy * width + dx)).clip(0, len(front) - 1)
        front[place] = np.maximum(front[place], number + side)  # of equal places the last, the nearest, wins
    return front


def _rainbow() -> NDArray[np.uint8]:
    """Return 256 colours (256, 3) from blue over green to red."""
    position = np.linspace(0, 4, 256)[:, None]
    peaks = np.array([3.0, 2.0, 1.0])
    return (255 * np.clip(1.5 - np.abs(position - peaks), 0, 1)).astype(np.uint8)


_RAINBOW = _rainbow()
_DEPTHS = np.concatenate([np.zeros((1, 3), np.uint8), _RAINBOW[:0:-1]])
