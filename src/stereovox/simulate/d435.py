# SPDX-License-Identifier: Apache-2.0
"""A simple model of a RealSense D435: disparity noise, holes next to edges, near and far limits, known reasons.

Photographs of simulated scenes for stereo matching: surfaces with a pattern and light, seen through a lens.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import Lens
from stereovox.frame import Reason
from stereovox.geometry.se3 import Transform
from stereovox.simulate import _texture
from stereovox.simulate.scene import Scene

HFOV_DEG = 91.2
CAMERA = PinholeCamera.from_field_of_view(848, 480, HFOV_DEG, baseline=0.05)
"""The D435's depth camera: the image is the left eye's; the right eye is one baseline along +x."""
SHAPE = 480 / 848
"""Height over width of its images."""
JUMP_PX = 1.0
"""Disparities that differ by more belong to two surfaces."""


@dataclass(frozen=True)
class D435:
    """A stereo depth camera whose matching error is Gaussian in disparity, and new in each frame.

    It is more benign than real ones (`stereovox.simulate.honest`), mainly by independent noise and known reasons.

    subpixel: standard deviation of the disparity in pixels (Chien 2020: 0.08).
    nearest, farthest: depths in metres the camera delivers.
    edge_px: half width of the matching window; background pixels that close to a nearer surface find no match.
    edge_loss: share of the nearer surface's own border pixels that find no match.
    barrel: relative error by which the left and right borders of the image appear too far; it grows with
        the square of the distance from the optical axis (Chien 2020, App. A: 0.1).
    correlation_px: standard deviation in pixels of the Gaussian that smooths the error at constant size; 0: it is
        independent from pixel to pixel.
    toe_in: angle in radians by which the right eye is rotated unknown to the camera: also a barrel, whose share
        grows with the depth, as Chien 2020, App. A, reports.
    """

    camera: PinholeCamera = CAMERA
    subpixel: float = 0.08
    nearest: float = 0.195
    farthest: float = 10.0
    edge_px: int = 2
    edge_loss: float = 0.25
    barrel: float = 0.0
    toe_in: float = 0.0
    correlation_px: float = 0.0

    def measure(
        self, true_depth_m: NDArray[np.floating], seed: int | list[int], T_world_camera: Transform | None = None
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Return depth in whole millimetres (0 = none) and the `Reason` of every pixel.

        true_depth_m: (height, width) along the optical axis, inf if there is nothing. Same seed, same image.
        T_world_camera: for cameras whose errors are fixed to surfaces.
        """
        random = np.random.default_rng(seed)
        scale = self._disparity_at_one_metre
        disparity = scale / np.asarray(true_depth_m, np.float32)
        noise = smooth_noise(disparity.shape, self.correlation_px, random)
        noisy = self._misaligned(disparity) + np.float32(self.subpixel) * noise
        depth = scale / np.maximum(noisy, np.float32(1e-6))
        lost = hidden_from_right_eye(disparity) | beside_nearer_surface(disparity, self.edge_px)
        lost |= on_border(disparity) & (random.random(disparity.shape, np.float32) < self.edge_loss)
        reason = classify(depth, self.nearest, self.farthest)
        reason[lost & (reason != Reason.TOO_NEAR)] = Reason.UNMATCHED
        return np.where(reason == Reason.VALID, np.rint(depth * 1000), 0).astype(np.uint16), reason

    def distorted(self, true_depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the effect of `barrel` and `toe_in` alone on depth (height, width) in metres; inf stays far away."""
        if not (self.barrel or self.toe_in):
            return true_depth_m
        scale = self._disparity_at_one_metre
        seen = self._misaligned(scale / np.asarray(true_depth_m, np.float32))
        return np.where(seen > 0, scale / np.where(seen > 0, seen, 1), np.float32(np.inf))

    @property
    def _disparity_at_one_metre(self) -> np.float32:
        return np.float32(self.camera.fx * (self.camera.baseline or 0.0))

    def _misaligned(self, disparity: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the disparity of misaligned eyes.

        An eye rotated by a small angle a sees a point at slope x moved by f a (1 + x^2); calibration removes f a.
        """
        if not (self.barrel or self.toe_in):
            return disparity
        x, _ = self.camera.ray_slopes()
        too_far = 1 + np.float32(self.barrel) * (x / np.abs(x).max()) ** 2
        return disparity / too_far - np.float32(self.camera.fx * self.toe_in) * x**2


def smooth_noise(shape: tuple[int, ...], sigma_px: float, random: np.random.Generator) -> NDArray[np.float32]:
    """Return noise (height, width) of mean 0 and variance 1: white, smoothed by a Gaussian of `sigma_px` pixels."""
    reach = ceil(4 * sigma_px)
    white = random.standard_normal((shape[0] + 2 * reach, shape[1] + 2 * reach), np.float32)
    if not reach:
        return white
    import cv2

    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    kernel /= sqrt(float((kernel**2).sum()))
    return np.asarray(cv2.sepFilter2D(white, cv2.CV_32F, kernel, kernel), np.float32)[reach:-reach, reach:-reach]


def depth_camera(width: int) -> PinholeCamera:
    """Return a camera with the D435's field of view, baseline and image format, `width` pixels wide (848: its own)."""
    return PinholeCamera.from_field_of_view(width, round(width * SHAPE), HFOV_DEG, CAMERA.baseline)


def classify(depth_m: NDArray[np.floating], nearest: float, farthest: float) -> NDArray[np.uint8]:
    """Return VALID, TOO_NEAR or TOO_FAR for every depth (metres, inf allowed)."""
    reason = np.full(depth_m.shape, Reason.VALID, np.uint8)
    reason[depth_m < nearest] = Reason.TOO_NEAR
    reason[depth_m > farthest] = Reason.TOO_FAR
    return reason


def hidden_from_right_eye(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels of the left image (height, width) that the right eye cannot see.

    Each pixel moves left by its disparity; if a nearer surface lands on the same pixel of the right image, or
    it leaves that image, there is nothing to match.
    """
    height, width = disparity.shape
    column = np.arange(width, dtype=np.float32) - disparity
    left = np.floor(column).astype(np.int32)
    row = (np.arange(height, dtype=np.int32) * (width + 2))[:, None] + 1
    nearest = np.zeros(height * (width + 2), np.float32)
    target = row + np.clip(left, -1, width - 1)
    for step in (0, 1):
        np.maximum.at(nearest, (target + step).ravel(), disparity.ravel())
    seen = nearest[row + np.clip(np.rint(column).astype(np.int32), -1, width - 1)]
    return (seen > disparity + JUMP_PX) | (column < 0)


def beside_nearer_surface(disparity: NDArray[np.float32], radius: int) -> NDArray[np.bool_]:
    """Return the pixels with a nearer surface within `radius` pixels."""
    return extreme(np.maximum, disparity, radius) > disparity + JUMP_PX


def on_border(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels with a farther surface directly next to them."""
    return extreme(np.minimum, disparity, 1) < disparity - JUMP_PX


def extreme(choose: np.ufunc, image: NDArray[np.float32], radius: int) -> NDArray[np.float32]:
    """Return the largest (smallest) value in the square of `radius` pixels around every pixel."""
    for axis in (0, 1):
        image = np.moveaxis(image, axis, 0)
        result = image.copy()
        for step in range(1, radius + 1):
            choose(result[:-step], image[step:], out=result[:-step])
            choose(result[step:], image[:-step], out=result[step:])
        image = np.moveaxis(result, 0, axis)
    return image


WAVE, OCTAVES = 0.4, 7
"""Longest wave of the pattern in metres, and how often it is halved: down to 6 mm."""
CONTRAST = 0.5
"""Default relative change of a surface's brightness by the pattern."""
LIGHT = np.array([0.36, 0.48, 0.8], np.float32)
"""Direction of the light."""
SKY = 205.0
"""Grey value outside the scene."""
STEEPEST = 0.1
"""Cosine below which grazing surfaces are not blurred further."""


def photograph(
    scene: Scene, lens: Lens, T_world_lens: Transform, noise: float, seed: list[int], contrast: float = CONTRAST
) -> NDArray[np.uint8]:
    """Return the grey image (height, width) uint8 of a scene through a lens; black outside the lens's view.

    T_world_lens: (4, 4) of its optical frame. noise: standard deviation in grey levels; same seed, same image.
    contrast: relative change of a surface's brightness by the pattern.
    The pattern is fixed to the surfaces, so two lenses see the same one. It is blurred as by pixels.
    """
    rays = _rays(lens)
    seen = np.isfinite(rays[:, 2])
    directions = rays[seen] @ T_world_lens[:3, :3].T.astype(np.float32)
    grey = np.zeros(len(rays), np.float32)
    grey[seen] = _shade(scene, np.asarray(T_world_lens[:3, 3], np.float32), directions, 1 / lens.fx, contrast)
    if noise:
        grey += np.float32(noise) * np.random.default_rng(seed).standard_normal(grey.shape, np.float32)
    return np.clip(np.rint(np.where(seen, grey, 0)), 0, 255).astype(np.uint8).reshape(lens.height, lens.width)


@lru_cache(maxsize=16)
def _rays(lens: Lens) -> NDArray[np.float32]:
    v, u = np.mgrid[: lens.height, : lens.width]
    return lens.directions(np.stack([u.ravel(), v.ravel()], axis=1)).astype(np.float32)


def _shade(
    scene: Scene, eye: NDArray[np.float32], directions: NDArray[np.float32], pixel: float, contrast: float
) -> NDArray[np.float32]:
    """Return the grey (N,) float32 at the hits of unit directions (N, 3) from `eye`; pixel: its width in radians."""
    distance, normals, triangles = scene.hits(eye, directions)
    there = triangles >= 0
    grey = np.full(len(directions), SKY, np.float32)
    points = eye + directions[there] * distance[there, None]
    cosine = np.abs(np.einsum("ij,ij->i", directions[there], normals[there]))
    footprint = distance[there] * np.float32(pixel) / np.maximum(cosine, STEEPEST)
    pattern = np.empty(len(points), np.float32)
    _texture.pattern(points, footprint.astype(np.float32), np.float32(WAVE), OCTAVES, pattern)
    light = 0.55 + 0.45 * np.abs(normals[there] @ LIGHT)
    grey[there] = _albedo(scene)[triangles[there]] * light * (1 + np.float32(contrast) * pattern)
    return grey


@lru_cache(maxsize=4)
def _albedo(scene: Scene) -> NDArray[np.float32]:
    """Return the grey (M,) of each triangle in full light: each solid has its own."""
    greys = np.random.default_rng(0).uniform(90, 165, len(scene.solids)).astype(np.float32)
    return np.repeat(greys, [len(solid.triangles) for solid in scene.solids])
