# SPDX-License-Identifier: Apache-2.0
"""How uncertain a measured depth is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras import PinholeCamera
from stereovox.config import NoiseConfig


@dataclass(frozen=True)
class RangeNoise:
    """Standard deviation of a depth: sigma(z) = s0 + s1 z + s2 z^2, all in metres."""

    s0: float
    s1: float
    s2: float

    def sigma(self, z: ArrayLike) -> NDArray[np.float64]:
        """Return the standard deviation in metres at depth `z` in metres."""
        z = np.asarray(z, float)
        return self.s0 + self.s1 * z + self.s2 * z * z

    @classmethod
    def of(cls, config: NoiseConfig, camera: PinholeCamera) -> RangeNoise:
        """Return the configured noise; where s2 is not set, that of the camera's stereo geometry.

        s2 = subpixel / (focal_px * baseline): Chien 2020, Eq 3.5 with the square that print lacks (Alg 3 has it).
        """
        baseline = camera.baseline or config.default_baseline
        focal_px = camera.fx * camera.binning  # disparity is measured in the sensor's own pixels
        s2 = config.subpixel / (focal_px * baseline) if config.s2 is None else config.s2
        return cls(config.s0, config.s1, s2)
