# SPDX-License-Identifier: Apache-2.0
"""Semi-global matching (Hirschmueller 2008) along three paths, by gradient and census, in 8 bits."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.config import StereoConfig
from stereovox.depth.stereo import _disparity, _semiglobal
from stereovox.threads import in_shards, shards

STRIP, WARM = 90, 16
SCALE = 0.7


def shards2(l,t):
    t=min(t,l)
    return [slice(l * i // t, l * (i + 1) // t) for i in range(t)]


class Census:
    lag_rows = 0.35
    locking = 1.0

    def __init__(self, config: StereoConfig) -> None:
        self._config = config
        from stereovox.depth.stereo.opencv import _fractions
        self._fractions = _fractions(self.locking if config.unlock else 1.0) + np.float32(1 / 32)
        self._scratch = {}

    def __call__(self, left, right):
        raw = self.raw(left, right)
        import cv2
        c = self._config
        if c.speckle_size:
            cv2.filterSpeckles(raw, -16, c.speckle_size, round(max(1, c.speckle_range) * 16))
        out = np.empty(raw.shape, np.float32)
        _disparity.pixels(raw, self._fractions, np.float32(self.lag_rows), out)
        return out

    def raw(self, left, right):
        import cv2

        c, rim = self._config, _semiglobal.RIM
        n = -(-c.disparities // 64) * 64
        h, w = left.shape
        wide = cv2.copyMakeBorder(left, rim, rim, rim, rim, cv2.BORDER_REPLICATE), cv2.copyMakeBorder(right, rim, rim, rim + n, rim, cv2.BORDER_REPLICATE)
        planes = np.empty((6, h, w), np.uint8), np.empty((6, h, w + n), np.uint8)

        def describe(part):
            for image, into, mirrored in zip(wide, planes, (False, True)):
                _semiglobal.describe(image, part.start, part.stop, mirrored, np.empty(into.shape[2] + 2, np.uint8), into)

        in_shards(describe, shards(h, c.threads))
        raw = np.empty((h, w), np.int16)
        count = max(1, round(h / STRIP))
        r = c.block_size // 2
        side = 2 * r + 1
        settings = np.array([r, round(c.p1 * SCALE), round(c.p2 * SCALE), c.uniqueness, round(c.left_right) if c.left_right else -1, min(65535, 65536 // side**2), c.disparities], np.int32)

        def strips(part):
            sc = [np.empty((side + 1, w, n), np.uint8), np.empty((w, n), np.uint16), np.empty(n, np.uint16), np.empty((w, n), np.uint8), np.empty((2, w, n + 64), np.uint8), np.empty((2, w, n + 64), np.uint8), np.empty(n, np.uint16), np.empty(n, np.uint16), np.empty(w + n, np.uint16), np.empty(w + n, np.uint16)]
            for i in range(part.start, part.stop):
                first, end = h * i // count, h * (i + 1) // count
                rows = np.array([max(0, first - WARM), first, end], np.int32)
                _semiglobal.match(*planes, rows, settings, *sc, raw)

        in_shards(strips, shards2(count, c.threads))
        return raw
