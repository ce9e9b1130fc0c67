# SPDX-License-Identifier: Apache-2.0
"""A depth image as a camera would have taken it that sees less far."""

from __future__ import annotations

import numpy as np

from stereovox.depth import _shorten
from stereovox.frame import DepthImage


def shortened(image: DepthImage, valid_to: float, far_from: float) -> DepthImage:
    """Return the image with depths up to `valid_to` metres; what is farther than `far_from` is TOO_FAR.

    What lies between the two is UNMATCHED: near enough for its noise to matter, so nothing may be cleared through it.
    """
    depth_m, reason = np.empty_like(image.depth_m), np.empty_like(image.reason)
    given, made = (image.depth_m, image.reason), (depth_m, reason)
    limits = np.float32(valid_to), np.float32(far_from)
    _shorten.shorten(*(array.reshape(-1) for array in given), *limits, *(array.reshape(-1) for array in made))
    return DepthImage(depth_m, reason, image.camera, image.T_world_sensor, image.stamp_ns)
