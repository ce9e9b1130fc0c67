# SPDX-License-Identifier: Apache-2.0
"""Stereo matchers by name: from two rectified grey images to a raw disparity."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox import registry
from stereovox.config import StereoConfig

MATCHERS = {
    "census": "stereovox.depth.stereo.semiglobal:Census",
    "sgm": "stereovox.depth.stereo.opencv:ThreeWay",
    "sgm8": "stereovox.depth.stereo.opencv:EightWay",
    "hh4": "stereovox.depth.stereo.opencv:FourWay",
    "block": "stereovox.depth.stereo.opencv:Block",
    "onnx": "stereovox.depth.stereo.opencv:Network",
}


class Matcher(Protocol):
    """A stereo matcher.

    Args:
        config: Settings of stereo matching; lengths are in pixels of the images passed to the matcher.

    Raises:
        ConfigError: The settings do not suit the method.
        MissingExtra: The method's library is not installed.
    """

    def __init__(self, config: StereoConfig) -> None: ...

    def __call__(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the disparity of the left image.

        Args:
            left: (height, width) uint8, rectified.
            right: The same for the right eye: the match of left pixel (u, v) is at (u - disparity, v).

        Returns:
            (height, width) float32 pixels; NaN: no value.
        """
        ...


def make_matcher(config: StereoConfig) -> Matcher:
    """Return the configured matcher. Other packages register theirs in the entry point group `stereovox.matchers`.

    Raises ConfigError for an unknown name, MissingExtra if a library is missing.
    """
    return registry.find("matchers", MATCHERS, config.method)(config)
