# SPDX-License-Identifier: Apache-2.0
"""Sensor model of a Kinect: quantised disparity, noise, shadows next to edges, limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.frame import Reason
from stereovox.simulate.d435 import beside_nearer_surface, classify, hidden_from_right_eye, on_border

HFOV_DEG, VFOV_DEG = 57.0, 43.0
BASELINE = 0.075
"""Metres from the infrared projector to the camera."""
STEP, NOISE = 0.125, 0.0625
"""Pixels of the full image: disparity has discrete steps, after Gaussian noise of this standard deviation."""
WIDTH = 640


def kinect_camera(width: int = WIDTH) -> PinholeCamera:
    """Return the Kinect's depth camera (IST 2019, III-C), or a smaller image of the same field of view.

    It declares its baseline and the noise of its disparity, including quantisation, so that a mapper knows the
    uncertainty of depth.
    """
    height = round(width * 480 / WIDTH)
    subpixel = math.hypot(NOISE, STEP / math.sqrt(12)) * width / WIDTH
    fx = 0.5 * width / math.tan(math.radians(HFOV_DEG) / 2)
    fy = 0.5 * height / math.tan(math.radians(VFOV_DEG) / 2)
    return PinholeCamera(width, height, fx, fy, (width - 1) / 2, (height - 1) / 2, BASELINE, subpixel=subpixel)


@dataclass(frozen=True)
class Kinect:
    """A depth camera that matches its own projected pattern of dots.

    step, noise: disparity has discrete steps of this many pixels (1/8), after Gaussian noise of this standard deviation
        (1/16; Khoshelham and Elberink 2012, 3.3: half a step): at 5 m a step is 7 cm of depth.
    nearest, farthest: depths in metres it delivers (IST 2019, III-C).
    edge_px, edge_loss: as in `D435`.
    """

    camera: PinholeCamera
    step: float = STEP
    noise: float = NOISE
    nearest: float = 0.8
    farthest: float = 6.0
    edge_px: int = 2
    edge_loss: float = 0.25

    def measure(
        self, true_depth_m: NDArray[np.floating], seed: int | list[int]
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Return depth in whole millimetres (0 = none) and the `Reason` of every pixel.

        TOO_NEAR and TOO_FAR by the measured depth, UNMATCHED in shadows and next to edges.
        true_depth_m: (height, width) along the optical axis, inf if there is nothing. Same seed, same image.
        """
        random = np.random.default_rng(seed)
        # relative to the full image: a smaller one is a scaled copy, with the same noise
        scale = np.float32(self.camera.fx * BASELINE * WIDTH / self.camera.width)
        disparity = scale / np.asarray(true_depth_m, np.float32)
        noisy = disparity + np.float32(self.noise) * random.standard_normal(disparity.shape, np.float32)
        steps = np.maximum(np.rint(noisy / np.float32(self.step)), np.float32(0.5))
        depth = scale / (steps * np.float32(self.step))
        own = disparity * np.float32(self.camera.width / WIDTH)
        lost = _in_shadow(own) | beside_nearer_surface(own, self.edge_px)
        lost |= on_border(own) & (random.random(disparity.shape, np.float32) < self.edge_loss)
        reason = classify(depth, self.nearest, self.farthest)
        reason[lost & (reason != Reason.TOO_NEAR)] = Reason.UNMATCHED
        return np.where(reason == Reason.VALID, np.rint(depth * 1000), 0).astype(np.uint16), reason


def _in_shadow(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels that the projector does not light; its beam is wider than the image."""
    return hidden_from_right_eye(disparity) & (np.arange(disparity.shape[1]) >= disparity)
