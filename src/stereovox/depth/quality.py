# SPDX-License-Identifier: Apache-2.0
"""Plausibility of images: enough depths, on surfaces, in metres; neither black nor saturated.

Chien 2020, 5.1, asks for such a filter of overexposed images and miscalculated depth. Whether an image agrees with the
map and the frames before it is checked by the gate.
"""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.depth import _images
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage, Frame, Reason, StereoFrame, name_of
from stereovox.sensors.noise import RangeNoise

ROWS = 16
"""Rows of an image that are sampled."""
BEND_SIGMA, BEND_SLACK = 3 * sqrt(6), 0.02
"""On a surface the second difference of inverse depth along a row is at most three of its standard deviations (that of
a depth times the root of 1 + 4 + 1), and 2 % of the inverse depth on top: surfaces are not all plane."""
FEW = 100
"""Fewer pixels with a depth on both sides prove neither surfaces nor their absence."""
BLACK, WHITE = 5, 250
"""Grey up to which a pixel is black, and from which it is saturated."""
FAR_RANGES, FAR_M = 60, 300.0
"""Median depth, in maximum ranges and in metres, beyond which the unit must be wrong."""
NEAR_RANGE, NEAR_M = 0.1, 0.01
"""Median depth, as a share of the minimum range and in metres, below which the unit must be wrong."""
SPARSE = 0.05
"""The unit is checked where a smaller share of the pixels has a depth within the range."""


def check_depth(image: DepthImage, frame: Frame, config: Config) -> None:
    """Raise FrameRefused where the depth image of `frame` shows no surfaces: `too_few_values`, `no_surfaces`."""
    looked, informative, compared, even = counted(image, config)
    if informative < config.trust.min_valid_share * looked:  # of the sampled rows; now count all
        _check_share(image, frame, config.trust.min_valid_share)
    if even < config.trust.min_surface_share * compared and compared >= FEW:
        detail = f"{even / compared:.0%} of the depths lie on surfaces"
        limit = f"trust.min_surface_share {config.trust.min_surface_share:g}"
        raise FrameRefused("no_surfaces", f"{name_of(frame)}: {detail} ({limit}); check camera and driver")


def counted(image: DepthImage, config: Config) -> tuple[int, int, int, int]:
    """Return four numbers of pixels in the sampled rows: all, and those with a depth or too far; those with a depth
    between two others, and those of them that lie on a surface with both, within the range noise.
    """
    noise, counts = RangeNoise.of(config.noise, image.camera), np.empty(4, np.int64)
    allowed = np.array([BEND_SIGMA * noise.s0, BEND_SIGMA * noise.s1, BEND_SIGMA * noise.s2], np.float32)
    _images.count(image.depth_m, _step(image.depth_m), allowed, np.float32(BEND_SLACK), counts)
    looked, informative, compared, even = counts.tolist()
    return looked, informative, compared, even


def _check_share(image: DepthImage, frame: Frame, least: float) -> None:
    number = np.bincount(image.reason.ravel(), minlength=len(Reason))
    informative, pixels = number[Reason.VALID] + number[Reason.TOO_FAR], number.sum() - number[Reason.MASKED]
    if informative < least * pixels:
        detail = (
            f"{informative} of {pixels} pixels say something (trust.min_valid_share {least:g}); is the view blocked?"
        )
        raise FrameRefused("too_few_values", f"{name_of(frame)}: {detail}")


def check_unit(frame: Frame, depth_m: NDArray[np.floating], config: Config) -> None:
    """Raise FrameRefused `bad_units` where the depths (N,) of a frame, in metres, cannot be metres."""
    depths = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    if not depths.size:
        return
    depths.sort()
    median = float(depths[(depths.size - 1) // 2] + depths[depths.size // 2]) / 2  # np.median takes ten times as long
    if median > max(FAR_RANGES * config.max_range, FAR_M):
        cure = "is it in millimetres? give depth_scale=0.001"
    elif median < min(NEAR_RANGE * config.min_range, NEAR_M):
        cure = "is it in metres already? give depth_scale=1"
    else:
        return
    detail = f"half of its depths are {'beyond' if median > 1 else 'below'} {median:.4g} m with depth_scale"
    raise FrameRefused("bad_units", f"{name_of(frame)}: {detail} {frame.depth_scale:g}; {cure}")


def check_light(frame: StereoFrame, limit: float) -> None:
    """Raise FrameRefused where more than the share `limit` of an image is black or saturated.

    The reason is `too_dark` or `overexposed`.
    """
    for side, image in (("left", frame.left), ("right", frame.right)):
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim < 2 or not image.size:
            continue  # matching refuses it
        rows = image[:: _step(image)]
        dark, bright = float((rows <= BLACK).mean()), float((rows >= WHITE).mean())
        for share, reason, word in ((dark, "too_dark", "black"), (bright, "overexposed", "saturated")):
            if share > limit:
                detail = f"{share:.0%} of its {side} image is {word} (trust.max_unexposed_share {limit:g})"
                raise FrameRefused(reason, f"{name_of(frame)}: {detail}; set the exposure, or clear the lens")


def _step(image: NDArray) -> int:
    """Return the distance between sampled rows."""
    return max(1, len(image) // ROWS)
