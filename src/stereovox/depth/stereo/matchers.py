# SPDX-License-Identifier: Apache-2.0
"""Stereo matchers by name: two rectified grey images go in, a raw disparity comes out."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox import registry
from stereovox.config import StereoConfig

MATCHERS = {
    "sgm": "stereovox.depth.stereo.opencv:ThreeWay",
    "sgm8": "stereovox.depth.stereo.opencv:EightWay",
    "hh4": "stereovox.depth.stereo.opencv:FourWay",
    "block": "stereovox.depth.stereo.opencv:Block",
    "onnx": "stereovox.depth.stereo.onnx:Network",
}


class Matcher(Protocol):
    """What a matcher must do; it is made with a `StereoConfig` whose lengths are pixels of the images it will get."""

    def __init__(self, config: StereoConfig) -> None: ...

    def __call__(self, left: NDArray[np.uint8], right: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the disparity (height, width) of the left image in pixels, NaN: none.

        left, right: (height, width) uint8, rectified: what the left image has at (u, v), the right has at
        (u - disparity, v).
        """
        ...


def make_matcher(config: StereoConfig) -> Matcher:
    """Return the matcher that `config` names. Other packages add theirs in the entry point group `stereovox.matchers`.

    Raises ConfigError for an unknown name, MissingExtra where a library is missing.
    """
    return registry.find("matchers", MATCHERS, config.method)(config)
