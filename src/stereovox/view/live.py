# SPDX-License-Identifier: Apache-2.0
"""Plain pictures for a screen, without axes or words: a map's layer, its cells in space, a depth image. NumPy alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import State, VoxelMap
from stereovox.products.slices import layer
from stereovox.view.drawn import upright
from stereovox.view.panels import STATE_COLOURS
from stereovox.view.render import Direction, render

SIZE_PX = 640
"""Width and height of a picture of a map."""


def plan_pixels(voxel_map: VoxelMap) -> NDArray[np.uint8]:
    """Return the layer at the camera's height (or at 0) in the colours of its states: (rows, columns, 3) RGB."""
    axis = "xyz".index(voxel_map.config.up[-1])
    viewpoint = voxel_map.viewpoint
    at_m = 0.0 if viewpoint is None else float(viewpoint.T_world_camera[axis, 3])
    states = layer(voxel_map, "xyz"[axis], at_m).state[::-1]
    times = max(1, SIZE_PX // max(states.shape))
    return _STATES[states].repeat(times, axis=0).repeat(times, axis=1)


def space_pixels(voxel_map: VoxelMap) -> NDArray[np.float32]:
    """Return the occupied cells in space, coloured by height: (rows, columns, 4) RGBA, 0 to 1."""
    cells = upright(voxel_map, None, voxel_map.config.up).occupied
    if not len(cells):
        return np.zeros((SIZE_PX, SIZE_PX, 4), np.float32)
    height = cells[:, 2] - cells[:, 2].min()
    shade = (255 * height // max(int(height.max()), 1)).astype(np.uint8)
    colours = _RAINBOW[shade].astype(np.float32) / 255
    return render(cells, colours, voxel_map.voxel_size, Direction.of(-60, 38), SIZE_PX, SIZE_PX).image


def colour_depth(depth_m: NDArray[np.floating], max_range: float) -> NDArray[np.uint8]:
    """Return a depth image (height, width) in metres as RGB (height, width, 3): near red, far blue, no value black."""
    shade = np.zeros(depth_m.shape, np.uint8)
    known = np.isfinite(depth_m)
    scaled = np.multiply(depth_m, 254 / max_range, where=known, out=np.zeros(depth_m.shape, np.float32))
    np.add(np.minimum(scaled, 254), 1, where=known, out=shade, casting="unsafe")
    return _DEPTHS[shade]


def _rainbow() -> NDArray[np.uint8]:
    """Return 256 colours (256, 3) from blue over green to red."""
    position = np.linspace(0, 4, 256)[:, None]
    peaks = np.array([3.0, 2.0, 1.0])
    return (255 * np.clip(1.5 - np.abs(position - peaks), 0, 1)).astype(np.uint8)


_RAINBOW = _rainbow()
_DEPTHS = np.concatenate([np.zeros((1, 3), np.uint8), _RAINBOW[:0:-1]])
_STATES = np.array([[int(STATE_COLOURS[state][i : i + 2], 16) for i in (1, 3, 5)] for state in sorted(State)], np.uint8)
