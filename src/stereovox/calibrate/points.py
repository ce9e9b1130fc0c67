# SPDX-License-Identifier: Apache-2.0
"""A depth image as a few thousand points of little noise, for registration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.frame import DepthImage, Reason

COLUMNS = 106
"""About how many blocks an image is wide: 8 pixels each for 848."""
SPREAD = 0.15
"""Blocks whose inverse depths differ by more than this share of their mean lie across an edge."""


def reduced_points(image: DepthImage, farthest: float) -> NDArray[np.float64]:
    """Return (N, 3) points up to depth `farthest`, one for each block of pixels that sees one smooth surface.

    The mean is taken over inverse depth: there a stereo camera's noise is even, and a plane is linear in the pixel.
    A block counts when half of its pixels are VALID and their inverse depths lie close together. The image must reach
    further than `farthest`: a limit on pixels would keep those that noise makes nearer, a shell that moves along.
    """
    n = max(1, round(image.camera.width / COLUMNS))
    valid = image.reason == Reason.VALID
    inverse = np.divide(1.0, image.depth_m, where=valid, out=np.zeros(valid.shape))
    counts, sums = _blocks(valid, n).sum((1, 3)), _blocks(inverse, n).sum((1, 3))
    lowest = _blocks(np.where(valid, inverse, np.inf), n).min((1, 3))
    highest = _blocks(inverse, n).max((1, 3))
    usable = counts >= max(1, n * n // 2)
    mean = np.divide(sums, counts, where=usable, out=np.ones(sums.shape))
    usable &= (highest - lowest <= SPREAD * mean) & (mean * farthest >= 1)
    rows, columns = np.nonzero(usable)
    camera, middle = image.camera, (n - 1) / 2
    assert isinstance(camera, PinholeCamera)
    depth = 1 / mean[rows, columns]
    x = (columns * n + middle - camera.cx) / camera.fx
    y = (rows * n + middle - camera.cy) / camera.fy
    return np.stack([x * depth, y * depth, depth], axis=1)


def _blocks(image: NDArray, n: int) -> NDArray:
    """Return (rows, n, columns, n); what is left over at the right and lower border is cut off."""
    height, width = image.shape[0] // n * n, image.shape[1] // n * n
    return image[:height, :width].reshape(height // n, n, width // n, n)
