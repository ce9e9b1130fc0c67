# SPDX-License-Identifier: Apache-2.0
"""Smaller depth images: blocks of pixels become one (Chien 2020, 3.2), and a camera that sees less far."""

from __future__ import annotations

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth import _images
from stereovox.errors import ConfigError, FrameRefused, StereovoxError
from stereovox.frame import DepthImage


def shortened(image: DepthImage, valid_to: float, far_from: float) -> DepthImage:
    """Return the image with depths up to `valid_to` metres; what is farther than `far_from` is TOO_FAR.

    What lies between the two is UNMATCHED: near enough for its noise to matter, so nothing may be cleared through it.
    """
    depth_m, reason = np.empty_like(image.depth_m), np.empty_like(image.reason)
    given, made = (image.depth_m, image.reason), (depth_m, reason)
    limits = np.float32(valid_to), np.float32(far_from)
    _images.shorten(*(array.reshape(-1) for array in given), *limits, *(array.reshape(-1) for array in made))
    return DepthImage(depth_m, reason, image.camera, image.T_world_sensor, image.stamp_ns)


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
    _images.block_minimum(image.depth_m, image.reason, n, np.empty(image.camera.width, np.float32), depth_m, reason)
    return DepthImage(depth_m, reason, camera, image.T_world_sensor, image.stamp_ns)
