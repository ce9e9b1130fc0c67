# SPDX-License-Identifier: Apache-2.0
"""Blocks of n by n pixels become one pixel that holds their smallest valid depth (Chien 2020, 3.2)."""

from __future__ import annotations

import numpy as np

from stereovox.depth import _downsample
from stereovox.frame import DepthImage


def downsample(image: DepthImage, n: int) -> DepthImage:
    """Return the image of block minima and its camera; n = 1 returns the image itself.

    A block without any valid pixel is TOO_NEAR where one of its pixels is, TOO_FAR only where all of them are, else
    MASKED where one is, else UNMATCHED. Blocks at the right and lower border may be cut.
    """
    if n == 1:
        return image
    camera = image.camera.binned(n)
    depth_m = np.empty((camera.height, camera.width), np.float32)
    reason = np.empty(depth_m.shape, np.uint8)
    _downsample.block_minimum(image.depth_m, image.reason, n, np.empty(image.camera.width, np.float32), depth_m, reason)
    return DepthImage(depth_m, reason, camera, image.T_world_sensor, image.stamp_ns)
