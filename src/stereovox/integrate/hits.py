# SPDX-License-Identifier: Apache-2.0
"""The cells that hold measured points, found anew for each frame in memory that stays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.config import Config
from stereovox.integrate import _hits
from stereovox.integrate.views import KernelTable, View, check_blocks, uses_wide_keys
from stereovox.maps.blocks import BlockPool


class HitFinder:
    """Keeps the memory for one camera's hits.

    blocks: what `find` found: evidence in thousandths on each cell that holds a point, 0 elsewhere; blocks count from
    the one the camera stands in.
    """

    def __init__(self, camera: PinholeCamera, table: KernelTable, config: Config):
        self.blocks = BlockPool(np.int16, capacity=1024)
        self._camera, self._table = camera, table
        self._full_share = np.float32(config.projective.full_share)
        pixels = _hits.GROUP * -(-camera.width // _hits.GROUP)
        kind = np.int64 if uses_wide_keys(camera, config.max_range, config) else np.int32
        self._keys, self._seen = np.zeros((2, camera.width + 1), kind), np.zeros(_hits.SEEN, kind)
        self._news, self._fresh = np.zeros(pixels, np.uint8), np.zeros(pixels + 1, np.int32)
        self._listed = np.zeros(camera.height * camera.width, np.int32)
        self._lanes = np.zeros((9, _hits.LANES), np.float32)

    def find(self, depth_m: NDArray[np.float32], view: View) -> None:
        """Fill `blocks` from a REP 117 depth image."""
        blocks = self.blocks
        blocks.clear()
        while (n := self._scatter(depth_m, view)) < 0:
            check_blocks(2 * len(blocks.coords), self._camera)
            blocks.clear()
            blocks.reserve(2 * len(blocks.coords))
        _hits.weigh(
            depth_m, view, self._table, self._full_share, self._listed, n, blocks.coords, blocks.values, self._lanes
        )

    def _scatter(self, depth_m: NDArray[np.float32], view: View) -> int:
        scratch = self._keys, self._news, self._fresh, self._seen, self._listed
        blocks = self.blocks
        return _hits.scatter(depth_m, view, *scratch, blocks.table, blocks.coords, blocks.count, blocks.values)
