# SPDX-License-Identifier: Apache-2.0
"""Noise of measured depths and of poses."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.rigs import VirtualCamera
from stereovox.cameras.wide import SphericalCamera
from stereovox.config import NoiseConfig

SUBPIXEL = 0.08
"""Default disparity noise in pixels: a RealSense D435 (Chien 2020, 2.2.4)."""


def kept_by_means(correlation_px: float) -> float:
    """Return by how much correlation along an axis raises the variance of means of many pixels; 1: independent.

    The noise is white noise smoothed by a Gaussian of this standard deviation. The factor sums its correlation over
    all lags, (sum k)^2 / sum k^2 of the kernel k: about 3.54 standard deviations unless these are small.
    """
    if correlation_px <= 0:
        return 1.0
    reach = np.arange(-int(5 * correlation_px) - 2, int(5 * correlation_px) + 3)
    kernel = np.exp(-0.5 * (reach / correlation_px) ** 2)
    return float(kernel.sum() ** 2 / (kernel**2).sum())


def looks(side: int, correlation_px: float) -> float:
    """Return how many independent measurements are as accurate on average as a square of side x side pixels."""
    if correlation_px <= 0:
        return float(side * side)
    lags = np.arange(1, side)
    along = 1 + 2 * np.sum((1 - lags / side) * np.exp(-(lags**2) / (4 * correlation_px**2)))
    return float((side / along) ** 2)


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
    def of(cls, config: NoiseConfig, camera: VirtualCamera | Lidar) -> RangeNoise:
        """Return the noise of a lidar as it is, and of a camera as configured, or from its stereo geometry if s2 is not
        set.

        s2 = subpixel / (focal_px * baseline): Chien 2020, Eq 3.5 with the square missing in print (Alg 3 has it), which
        is also Valenti 2018, Eq 6.9. A spherical camera has subpixel * baseline / focal_px more at every depth: Eq 6.11
        in 6.10, with 1 / focal_px for the angle of a pixel. That holds at the middle of its rows; towards the sides
        the noise grows (`stereovox.depth.stereo.disparity`), which the thesis also leaves out.
        """
        if isinstance(camera, Lidar):
            return cls(camera.sigma, 0.0, 0.0)
        if config.s2 is not None:
            return cls(config.s0, config.s1, config.s2)
        baseline = camera.baseline or config.default_baseline
        subpixel = config.subpixel or camera.subpixel or SUBPIXEL
        noise_rad = subpixel / camera.focal_px  # disparity is measured in the sensor's own pixels
        always = baseline * noise_rad if isinstance(camera, SphericalCamera) else 0.0
        return cls(config.s0 + always, config.s1, noise_rad / baseline)


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviation of a camera's poses: `position` in metres along each axis, `angle` in radians about each."""

    position: float
    angle: float

    def sigma(self, z: ArrayLike) -> NDArray[np.float64]:
        """Return the standard deviation in metres, along each axis, of a point at depth `z`."""
        return np.hypot(self.position, self.angle * np.asarray(z, float))

    @classmethod
    def of(cls, config: NoiseConfig) -> PoseNoise:
        """Return the configured noise."""
        return cls(config.pose_m, radians(config.pose_deg))
