# SPDX-License-Identifier: Apache-2.0
"""Whether an image can be a picture of something: enough depths, on surfaces, in metres; light, but not too much.

Chien 2020, 5.1, asks for it: a threshold that filters out images that are overexposed, or whose depth is miscalculated.
Whether it fits to the map and to the frames before it is for the gate to say.
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
"""Rows of an image that are looked at."""
BEND_SIGMA, BEND_SLACK = 3 * sqrt(6), 0.02
"""On a surface the second difference of inverse depth along a row is at most three of its standard deviations (that of
a depth times the root of 1 + 4 + 1), and 2 % of the inverse depth on top: surfaces are not all plane."""
FEW = 100
"""Fewer pixels than these, with a depth on both sides, show no surface, nor that there is none."""
BLACK, WHITE = 5, 250
"""Grey up to which a pixel is black, and from which it is saturated."""
FAR_RANGES, FAR_M = 60, 300.0
"""Median depth beyond as many maximum ranges, and as many metres, that no camera means."""
NEAR_RANGE, NEAR_M = 0.1, 0.01
"""Median depth below this share of the minimum range, and below as many metres, that no camera means."""
SPARSE = 0.05
"""Share of pixels with a depth within the range below which their unit is looked at."""


def check_depth(image: DepthImage, frame: Frame, config: Config) -> None:
    """Raise FrameRefused where `image`, made of `frame`, is none of surfaces: `too_few_values`, `no_surfaces`."""
    looked, saying, compared, even = counted(image, config)
    if saying < config.trust.min_valid_share * looked:  # of some rows; then all of them are looked at
        _check_share(image, frame, config.trust.min_valid_share)
    if even < config.trust.min_surface_share * compared and compared >= FEW:
        said = f"{even / compared:.0%} of the depths lie on surfaces"
        limit = f"trust.min_surface_share {config.trust.min_surface_share:g}"
        raise FrameRefused("no_surfaces", f"{name_of(frame)}: {said} ({limit}); check camera and driver")


def counted(image: DepthImage, config: Config) -> tuple[int, int, int, int]:
    """Return of some rows how many pixels there are, and how many have a depth or are too far; how many have a depth
    between two others, and how many of these lie on a surface with them, as far as the range noise can tell.
    """
    noise, counts = RangeNoise.of(config.noise, image.camera), np.empty(4, np.int64)
    allowed = np.array([BEND_SIGMA * noise.s0, BEND_SIGMA * noise.s1, BEND_SIGMA * noise.s2], np.float32)
    _images.count(image.depth_m, _step(image.depth_m), allowed, np.float32(BEND_SLACK), counts)
    looked, saying, compared, even = counts.tolist()
    return looked, saying, compared, even


def _check_share(image: DepthImage, frame: Frame, least: float) -> None:
    number = np.bincount(image.reason.ravel(), minlength=len(Reason))
    says, pixels = number[Reason.VALID] + number[Reason.TOO_FAR], number.sum() - number[Reason.MASKED]
    if says < least * pixels:
        said = f"{says} of {pixels} pixels say something (trust.min_valid_share {least:g}); is the view blocked?"
        raise FrameRefused("too_few_values", f"{name_of(frame)}: {said}")


def check_unit(frame: Frame, depth_m: NDArray[np.floating], config: Config) -> None:
    """Raise FrameRefused `bad_units` where the depths (N,) that a frame holds, in metres, are no metres."""
    said = depth_m[np.isfinite(depth_m) & (depth_m > 0)]
    if not said.size:
        return
    median = float(np.median(said))
    if median > max(FAR_RANGES * config.max_range, FAR_M):
        cure = "is it in millimetres? give depth_scale=0.001"
    elif median < min(NEAR_RANGE * config.min_range, NEAR_M):
        cure = "is it in metres already? give depth_scale=1"
    else:
        return
    told = f"half of its depths are {'beyond' if median > 1 else 'below'} {median:.4g} m with depth_scale"
    raise FrameRefused("bad_units", f"{name_of(frame)}: {told} {frame.depth_scale:g}; {cure}")


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
                told = f"{share:.0%} of its {side} image is {word} (trust.max_unexposed_share {limit:g})"
                raise FrameRefused(reason, f"{name_of(frame)}: {told}; set the exposure, or clear the lens")


def _step(image: NDArray) -> int:
    """Return the distance of the rows that are looked at."""
    return max(1, len(image) // ROWS)
