# SPDX-License-Identifier: Apache-2.0
"""Window images of a depth image, made anew for each frame in memory that stays."""

from __future__ import annotations

from math import floor, log2
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.integrate import _windows

LEVELS = _windows.COARSEST + 1
"""Windows of one pixel, and of three tiles of 1 to 128 pixels."""


class Windows(NamedTuple):
    """All window images in one; see `_windows.py`."""

    image: NDArray[np.float32]  # flat; `_windows.place` says where a pixel stands
    pitch: np.int32
    height: np.int32
    lows: NDArray[np.float32]
    highs: NDArray[np.float32]
    tile_offset: NDArray[np.int32]  # (levels, 2) where tiles of 16 and of 64 start
    tile_width: NDArray[np.int32]  # (levels, 2) tiles in a row
    first: np.int32  # lowest level that is filled


class WindowBuilder:
    """Keeps the memory for one camera's window images and fills it for each depth image."""

    def __init__(self, camera: PinholeCamera):
        h, w = camera.height, camera.width
        coarsest = 1 << (LEVELS - 2)
        strides = np.array([1] + [1 << level for level in range(LEVELS - 1)])
        self._shape = np.stack([-(-h // strides), -(-w // strides)], axis=1).astype(np.int32)
        tiles = np.stack([-(-self._shape // 16), -(-self._shape // 64)], axis=1)
        tile_offset = _starts(tiles.prod(axis=2).ravel()).reshape(LEVELS, 2)
        pitch = coarsest * -(-w // coarsest)
        size = pitch * (2 * h + -(-h // 2))
        self._scratch = np.zeros(size, np.float32), np.zeros((4, pitch), np.float32), *np.zeros((4, pitch), np.float32)
        lows, highs = np.zeros((2, tiles.prod(axis=2).sum()), np.float32)
        self._windows = Windows(
            np.zeros(size, np.float32), np.int32(pitch), np.int32(h), lows, highs,
            tile_offset, np.ascontiguousarray(tiles[:, :, 1], np.int32), np.int32(0),
        )  # fmt: skip
        self.nearest = tuple(np.zeros((-(-h // size), -(-w // size)), np.float32) for size in (16, 64))

    def build(self, depth_m: NDArray[np.float32], smallest_tile: float) -> tuple[Windows, float]:
        """Return the window images of a REP 117 depth image, from tiles of about `smallest_tile` pixels on.

        With them the image's farthest depth in metres, `NO_RETURN` where a pixel saw nothing.
        """
        first = min(max(floor(log2(max(smallest_tile, 1e-9))) + 2, 0), LEVELS - 1)
        windows = self._windows._replace(first=np.int32(first))
        base, *rows = self._scratch
        farthest = _windows.build(
            depth_m.reshape(-1), base, windows.image, *rows, windows.lows, windows.highs,
            self._shape, windows.tile_offset, windows.tile_width, first,
        )  # fmt: skip
        return windows, farthest

    def build_nearest(self, depth_m: NDArray[np.float32]) -> None:
        """Fill `nearest`, for sensor models that mark cells beside the hit."""
        low16, low64 = (tiles.reshape(-1) for tiles in self.nearest)
        _windows.nearest_tiles(depth_m.reshape(-1), *depth_m.shape, low16, low64)


def _starts(sizes: NDArray[np.int64]) -> NDArray[np.int32]:
    return np.concatenate([[0], np.cumsum(sizes)[:-1]]).astype(np.int32)
