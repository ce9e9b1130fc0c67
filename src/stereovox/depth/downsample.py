# SPDX-License-Identifier: Apache-2.0
"""Blocks of n by n pixels become one pixel that holds their smallest valid depth (Chien 2020, 3.2)."""

from __future__ import annotations

import numpy as np

from stereovox.cameras import PinholeCamera
from stereovox.depth import _downsample
from stereovox.errors import ConfigError, FrameRefused, StereovoxError
from stereovox.frame import DepthImage


def downsample(image: DepthImage, n: int) -> DepthImage:
    """Return the image of block minima and its camera; n = 1 returns the image itself.

    A block without any valid pixel is TOO_NEAR where one of its pixels is, TOO_FAR only where all of them are, else
    MASKED where one is, else UNMATCHED where one is, else UNKNOWN. Blocks at the right and lower border may be cut.
    Raises ConfigError for a wide camera, FrameRefused `bad_camera` where larger pixels are no pinhole's any more.
    """
    if n == 1:
        return image
    if not isinstance(image.camera, PinholeCamera):
        raise ConfigError(f"depth.downsample {n}: a wide camera's image cannot be downsampled; use sphere.step_deg")
    try:
        camera = image.camera.binned(n)
    except StereovoxError as error:
        raise FrameRefused("bad_camera", f"blocks of {n} by {n} pixels: {error}") from None
    depth_m = np.empty((camera.height, camera.width), np.float32)
    reason = np.empty(depth_m.shape, np.uint8)
    _downsample.block_minimum(image.depth_m, image.reason, n, np.empty(image.camera.width, np.float32), depth_m, reason)
    return DepthImage(depth_m, reason, camera, image.T_world_sensor, image.stamp_ns)
