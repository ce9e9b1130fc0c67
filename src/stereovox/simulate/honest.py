# SPDX-License-Identifier: Apache-2.0
"""Depth cameras with realistic errors: correlated between neighbouring pixels, in steps, with holes and mismatches.

The numbers of the presets were chosen so that `benchmarks/camera_noise.py` prints similar values for simulations and
recordings; docs/simulations.md shows both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import Reason
from stereovox.geometry.se3 import Transform
from stereovox.simulate import _texture
from stereovox.simulate.d435 import D435, JUMP_PX, extreme, hidden_from_right_eye, smooth_noise
from stereovox.simulate.floors.drive import WIDTH, kinect_camera

Image = NDArray[np.float32]

ALIKE = 2.7
"""Cell size of `_texture.even`, in standard deviations of a Gaussian kernel, that gives noise of the same correlation
length in pixels: both fall to 1/e at two standard deviations."""
PATTERN_PX = 3.0
"""Disparity in pixels over which the errors of a fixed pixel stay similar: beyond, another part of the pattern is
seen."""
BRIGHT_M, MEAN_GREY, SPREAD_GREY = 0.8, 115.0, 45.0
"""Brightness of surfaces in grey levels: its correlation length in metres, its mean and standard deviation."""
DARK_GREY = 80.0
"""Grey below which a surface begins to lose values."""
STEEP = 0.5
"""Cosine of the angle between ray and normal below which a surface begins to lose values."""
TEXTURE_M = 0.6
"""Size of patches of repetitive texture, in metres."""
WRONG_FROM_M = 4.0
"""Depth from which repetitive texture has its full effect, proportional below (Chien 2020, 2.2.4.1: farther away it
misleads)."""
KINECT_TOTAL_PX = 0.067
"""Noise of a Kinect's disparity in pixels, including its steps."""
HOLE_LASTS = 0.5
"""Share of the cause of a hole that is fixed to the surface; the rest is new in each frame."""


@dataclass(frozen=True)
class RealisticDepthCamera(D435):
    """A depth camera with the errors of a real one. Lengths in pixels are those of its own image.

    subpixel: standard deviation of the disparity before it is rounded to steps.
    step: size of the disparity's discrete steps in pixels.
    correlation_px: standard deviation of the Gaussian that smooths the noise at constant size: the correlation
        falls to 1/e at twice that.
    of_surface, of_pixel: shares of its variance that are fixed to the surface, and to the pixel as long as
        the depth there stays the same; the rest is new in each frame.
    edge_px: within this many pixels of a step in depth a pixel is lost (share `edge_loss`) or measures a value
        in between (share `flying`).
    holes: share of invalid pixels anywhere; in addition `holes_far` at `farthest`, falling with the square of
        the depth, `holes_steep` on surfaces seen at a grazing angle, `holes_dark` on black ones.
    hole_px: standard deviation of the Gaussian that makes holes patchy.
    repetitive: share of the surfaces whose texture repeats every `period` metres; `mismatched`: share of their far
        pixels whose disparity is too large by that period: they appear too near.
    """

    edge_loss: float = 0.25
    correlation_px: float = 1.8
    of_surface: float = 0.2
    of_pixel: float = 0.0
    step: float = 1 / 32
    flying: float = 0.75
    holes: float = 0.01
    holes_far: float = 0.25
    holes_steep: float = 0.2
    holes_dark: float = 0.2
    hole_px: float = 3.5
    repetitive: float = 0.04
    mismatched: float = 0.1
    period: float = 0.08

    def measure(
        self, true_depth_m: NDArray[np.floating], seed: int | list[int], T_world_camera: Transform | None = None
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Return depth in whole millimetres, 0 if there is none, and the reason, which is always UNKNOWN for invalid
        pixels.

        true_depth_m: (height, width) along the optical axis, inf if there is nothing. seed: its first number is for
        errors fixed to surfaces and pixels, all of them for the rest. T_world_camera: (4, 4), the camera's
        pose.
        """
        first = seed if isinstance(seed, int) else seed[0]
        there = _Places.of(self, np.asarray(true_depth_m, np.float32), T_world_camera, first)
        random = np.random.default_rng(seed)
        true = self._disparity_at_one_metre / there.depth
        disparity, lost = self._at_edges(self._mismatched(true, there, random), true, random)
        seen = self._misaligned(disparity) + np.float32(self.subpixel) * self._noise(there, true, random)
        steps = np.maximum(np.rint(seen / np.float32(self.step)), np.float32(0.5))
        depth = self._disparity_at_one_metre / (steps * np.float32(self.step))
        lost |= hidden_from_right_eye(true) | self._holes(there, random)
        lost |= (depth < self.nearest) | (depth > self.farthest) | ~np.isfinite(true_depth_m)
        millimetres = np.rint(np.where(lost, 0, depth) * 1000).astype(np.uint16)
        return millimetres, np.where(millimetres, Reason.VALID, Reason.UNKNOWN).astype(np.uint8)

    def _noise(self, there: _Places, true: Image, random: np.random.Generator) -> Image:
        """Return noise (height, width) of variance 1."""
        new = 1 - self.of_surface - self.of_pixel
        noise = np.float32(sqrt(new)) * smooth_noise(true.shape, self.correlation_px, random)
        if self.of_surface:
            noise += np.float32(sqrt(self.of_surface)) * there.at_surface(self.correlation_px, 1)
        if self.of_pixel:
            noise += np.float32(sqrt(self.of_pixel)) * there.at_pixel(self.correlation_px, true)
        return noise

    def _mismatched(self, true: Image, there: _Places, random: np.random.Generator) -> Image:
        """Return the disparity with mismatches of a period on repetitive texture."""
        if not (self.repetitive and self.mismatched):
            return true
        share = np.float32(self.mismatched) * np.minimum(there.depth / np.float32(WRONG_FROM_M), 1)
        wrong = smooth_noise(true.shape, self.hole_px, random) < _below(share)
        wrong &= there.at_metres(TEXTURE_M, 5) < _below(self.repetitive)
        return np.where(wrong, true + np.float32(self.period * self.camera.fx) / there.depth, true)

    def _at_edges(self, disparity: Image, true: Image, random: np.random.Generator) -> tuple[Image, NDArray[np.bool_]]:
        """Return the disparity with flying pixels between fore- and background, and the pixels lost next to edges."""
        import cv2

        near, far = extreme(np.maximum, true, self.edge_px), extreme(np.minimum, true, self.edge_px)
        edge = near > far + JUMP_PX
        side = 2 * self.edge_px + 1
        between = np.asarray(cv2.blur(true, (side, side), borderType=cv2.BORDER_REPLICATE), np.float32)
        chance = smooth_noise(true.shape, self.edge_px / 2, random)
        flying = edge & (chance > -_below(self.flying))
        return np.where(flying, between, disparity), edge & (chance < _below(self.edge_loss))

    def _holes(self, there: _Places, random: np.random.Generator) -> NDArray[np.bool_]:
        """Return the pixels of flat surfaces without a value."""
        share = np.float32(self.holes) + np.float32(self.holes_far) * (there.depth / np.float32(self.farthest)) ** 2
        share += np.float32(self.holes_steep) * np.maximum(1 - there.cosine() / np.float32(STEEP), 0)
        share += np.float32(self.holes_dark) * np.maximum(1 - there.grey() / np.float32(DARK_GREY), 0)
        field = np.float32(sqrt(1 - HOLE_LASTS)) * smooth_noise(share.shape, self.hole_px, random)
        field += np.float32(sqrt(HOLE_LASTS)) * there.at_surface(self.hole_px, 3)
        return field < _below(share)


def honest_d435(own: D435) -> RealisticDepthCamera:
    """Return a camera of the same size and limits with the errors of the RealSense D400 family."""
    return RealisticDepthCamera(own.camera, nearest=own.nearest, farthest=own.farthest)


def honest_kinect(width: int = WIDTH) -> RealisticDepthCamera:
    """Return a first-generation Kinect, whose image is `width` pixels wide: a scaled copy of the full one.

    Khoshelham and Elberink (2012): steps of 1/8 pixel; its minimum range is 0.5 m.
    """
    size = width / WIDTH
    return RealisticDepthCamera(
        replace(kinect_camera(width), subpixel=KINECT_TOTAL_PX * size),
        subpixel=0.056 * size, step=0.125 * size, correlation_px=1.5 * size, of_surface=0.15, of_pixel=0.25,
        nearest=0.5, farthest=6.0, edge_loss=0.0, flying=0.03,
        holes=0.005, holes_far=0.2, holes_steep=0.15, holes_dark=0.03, hole_px=5.0 * size, repetitive=0.0,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Places:
    """The points on surfaces that the pixels of an image see.

    depth: (height, width) float32 metres; missing values are the farthest a camera could see. points:
    (height * width, 3) float32 in the world, metres. x, y: slopes of the rays. fx, fy: focal lengths in pixels.
    """

    depth: Image
    points: NDArray[np.float32]
    x: Image
    y: Image
    fx: float
    fy: float
    seed: int

    @classmethod
    def of(cls, device: D435, true_depth_m: Image, T_world_camera: Transform | None, seed: int) -> _Places:
        T = np.eye(4) if T_world_camera is None else T_world_camera
        x, y = (np.asarray(slope, np.float32) for slope in device.camera.ray_slopes())
        depth = np.minimum(np.maximum(true_depth_m, np.float32(1e-3)), np.float32(100))
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1) * depth[..., None]
        points = rays.reshape(-1, 3) @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        return cls(depth, points, x, y, device.camera.fx, device.camera.fy, seed % 2**31)

    def at_metres(self, metres: float, number: int) -> Image:
        """Return noise of variance 1, fixed to surfaces and correlated over this many metres; one field per number."""
        return self._even(self.points / np.float32(metres), number)

    def at_surface(self, pixels: float, number: int) -> Image:
        """Return noise of variance 1, fixed to surfaces and correlated over about this many pixels.

        Like texture it changes with the apparent size: each of the two scales next to the pixel's
        has its own.
        """
        wanted = np.log2(self.depth * np.float32(ALIKE * max(pixels, 0.2) / self.fx))
        low = np.floor(wanted)
        part = (wanted - low).astype(np.float32)
        noise = np.zeros_like(self.depth)
        for level in range(int(low.min()), int(low.max()) + 2):
            weight = np.where(low == level, np.sqrt(1 - part), np.where(low == level - 1, np.sqrt(part), np.float32(0)))
            some = weight > 0
            if some.any():
                field = np.empty(int(some.sum()), np.float32)
                points = self.points[some.ravel()] * np.float32(2.0**-level)
                _texture.even(points, np.uint32(self._number(number) + 101 * (level + 40)), field)
                noise[some] += weight[some] * field
        return noise

    def at_pixel(self, pixels: float, disparity: Image) -> Image:
        """Return noise of variance 1 that is fixed to pixels, as long as their disparity stays about the same."""
        height, width = disparity.shape
        cell = np.float32(ALIKE * max(pixels, 0.2))
        v, u = np.mgrid[:height, :width].astype(np.float32) / cell
        return self._even(np.stack([u, v, disparity / np.float32(PATTERN_PX)], axis=-1).reshape(-1, 3), 7)

    def grey(self) -> Image:
        """Return the brightness of surfaces in grey levels."""
        return np.clip(np.float32(MEAN_GREY) + np.float32(SPREAD_GREY) * self.at_metres(BRIGHT_M, 9), 0, 255)

    def cosine(self) -> Image:
        """Return the cosine of the angle between ray and surface, from the slope of 1/z, in which planes are linear."""
        inverse = 1 / self.depth
        b, c = np.gradient(inverse, axis=1) * np.float32(self.fx), np.gradient(inverse, axis=0) * np.float32(self.fy)
        x, y = self.x[None, :], self.y[:, None]
        a = inverse - b * x - c * y
        return (inverse / np.sqrt((a * a + b * b + c * c) * (1 + x * x + y * y))).astype(np.float32)

    def _even(self, points: NDArray[np.float32], number: int) -> Image:
        field = np.empty(len(points), np.float32)
        _texture.even(np.ascontiguousarray(points, np.float32), np.uint32(self._number(number)), field)
        return field.reshape(self.depth.shape)

    def _number(self, number: int) -> int:
        return (self.seed * 7919 + number * 1_000_003) % 2**31


def _below(share: Image | float) -> Image:
    """Return the bound that a normal variable stays below with this probability."""
    from scipy.special import ndtri

    return ndtri(np.clip(np.asarray(share, np.float32), np.float32(1e-7), np.float32(1 - 1e-7)))
