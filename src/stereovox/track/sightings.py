# SPDX-License-Identifier: Apache-2.0
"""Landmarks found in an image, and the camera pose that follows from them."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.geometry.se3 import Transform, inverse
from stereovox.track._sightings import equations
from stereovox.track.fit import Equations

PIXEL = 0.3
"""Standard deviation of a corner's position in pixels."""
USUAL = 16.0
"""Largest squared deviation of an inlier, over three residuals."""
ALIKE = 2.0
"""Number of landmarks with correlated errors, which count as one."""
REACHES, CONVERGED = (1e2, 9.0), 1e-5
"""Squared deviations at which a landmark's weight drops, stage by stage, and the step that ends each stage."""
NEAR, AGREED = 6.7, 15
"""Least inverse distance, in deviations of one observation, of landmarks used to find the pose; fewest that agree."""
LOOKS = 6
"""Observations that improve a landmark's distance: errors of later ones are correlated."""
MAX_AGE = 20
"""Most images through which one corner is tracked."""


@dataclass
class Corners:
    """Landmarks, each on the ray on which it was first seen. World frame.

    pixels: (N, 2) float32, in the latest image. centre, ray: (N, 3) where that camera was, and the direction with depth
    1. inverse: (N,) 1 / depth along the ray's camera's axis, in 1/m; variance: (N,) of it. looks: (N,).
    """

    pixels: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 2), np.float32))
    centre: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    ray: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    inverse: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    variance: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    looks: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.inverse)

    @property
    def points(self) -> NDArray[np.float64]:
        """Return the positions of the landmarks, (N, 3) metres, world frame."""
        return self.centre + self.ray / self.inverse[:, None]

    def those(self, which: NDArray[Any]) -> Corners:
        """Return some of the landmarks."""
        return Corners(*(part[which] for part in vars(self).values()))

    def with_(self, other: Corners) -> Corners:
        """Return these landmarks and others."""
        return Corners(*(np.concatenate(both) for both in zip(vars(self).values(), vars(other).values(), strict=True)))

    def in_camera(self, T: Transform) -> NDArray[np.float64]:
        """Return the landmarks (N, 3) in the frame of a camera at T_world_camera, scaled by their inverse distances."""
        seen = (self.inverse[:, None] * (self.centre - T[:3, 3]) + self.ray) @ T[:3, :3]
        seen[:, 2] = np.maximum(seen[:, 2], 1e-3)
        return seen

    def projected(self, camera: PinholeCamera, T: Transform) -> NDArray[np.float64]:
        """Return their projections seen from T_world_camera: (N, 3) column, row in pixels, inverse depth in 1/m."""
        x, y, z = self.in_camera(T).T
        return np.column_stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, self.inverse / z])


@dataclass(frozen=True, eq=False)
class Sightings:
    """Landmarks that were found in an image.

    Attributes:
        camera: The camera that took it.
        corners: The landmarks, as known before this image.
        measured: (N, 3) their measured column, row in pixels, inverse depth in 1/m.
        deviation: (N,) standard deviation of that inverse depth.
        sought: Number of landmarks searched for.
    """

    camera: PinholeCamera
    corners: Corners = field(default_factory=Corners)
    measured: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    deviation: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    sought: int = 0

    def __len__(self) -> int:
        return len(self.corners)

    def those(self, which: NDArray[Any]) -> Sightings:
        """Return some of the landmarks."""
        return Sightings(
            self.camera, self.corners.those(which), self.measured[which], self.deviation[which], self.sought
        )

    def equations(self, reach: float) -> Equations:
        """Return the equations of the pose T_world_camera; reach: squared deviations above which weights drop."""
        return partial(self._equations, reach)

    def inlier_share(self, T: Transform) -> float:
        """Return the share of inliers among the landmarks, seen from T_world_camera."""
        return float(np.mean(self.residuals(T)[0] < USUAL)) if len(self) else 0.0

    def improved(self, T: Transform) -> Corners:
        """Return the inliers, with distances improved by this observation."""
        corners = self.corners
        if not len(corners):
            return corners
        squares, off, _, _, by_inverse = self.residuals(T)
        fresh = by_inverse / self._variances()
        variance = 1 / (1 / corners.variance + np.einsum("ni,ni->n", fresh, by_inverse))
        closer = np.maximum(corners.inverse + variance * np.einsum("ni,ni->n", fresh, off), 1e-6)
        variance = np.maximum(variance, self.deviation**2 / LOOKS)
        pixels = self.measured[:, :2].astype(np.float32)
        better = Corners(pixels, corners.centre, corners.ray, closer, variance, corners.looks + 1)
        return better.those((squares < USUAL) & (better.looks < MAX_AGE))

    def agreed(self, expected: Transform) -> Transform | None:
        """Return the pose that most landmarks agree on (PnP, RANSAC), from `expected`, or None."""
        near = self.corners.inverse > NEAR * self.deviation
        if near.sum() < AGREED:
            return None
        points = self.corners.those(near).points - expected[:3, 3]
        camera = self.camera
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        R = expected[:3, :3].T
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points @ R.T, self.measured[near, :2], K, None, np.zeros((3, 1)), np.zeros((3, 1)), True, 100, 2.0, 0.999
        )
        if not found or inliers is None or len(inliers) < max(AGREED, 0.5 * near.sum()):
            return None
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        return expected @ inverse(T)

    def _equations(self, reach: float, T: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        camera, corners = self.camera, self.corners
        given = corners.centre, corners.ray, corners.inverse, corners.variance, self.measured, self.deviation
        information, gradient = np.empty((6, 6)), np.empty(6)
        equations(
            *(np.ascontiguousarray(part, np.float64) for part in given),
            np.array([camera.fx, camera.fy, camera.cx, camera.cy]), np.ascontiguousarray(T[:3, :3]), T[:3, 3].copy(),
            PIXEL, ALIKE, reach, np.empty((6, 3, 6)), information, gradient,
        )  # fmt: skip
        return information, gradient

    def _variances(self) -> NDArray[np.float64]:
        """Return the variances (N, 3) of the measurements relative to each landmark's first one."""
        variances = np.full((len(self), 3), 2 * PIXEL**2)
        variances[:, 2] = self.deviation**2
        return variances

    def residuals(self, T: Transform) -> tuple[NDArray[Any], ...]:
        """Return for each landmark: squared deviation (N,), residual (N, 3), the residual's inverse covariance (N, 3,
        3), and the derivatives of its projection by the camera's motion (N, 3, 6) and by its inverse depth (N, 3).
        """
        camera, corners, R = self.camera, self.corners, T[:3, :3]
        x, y, z = corners.in_camera(T).T
        off = self.measured - corners.projected(camera, T)
        by_place = np.zeros((len(corners), 3, 3))
        by_place[:, 0, 0], by_place[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
        by_place[:, 1, 1], by_place[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
        by_place[:, 2, 2] = -corners.inverse / z**2
        by_world = by_place @ R.T
        moved = corners.inverse[:, None] * (corners.centre - T[:3, 3])
        q = moved + corners.ray
        turn = np.zeros((len(corners), 3, 3))
        turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = -q[:, 2], q[:, 1], -q[:, 0]
        turn -= np.swapaxes(turn, 1, 2)
        by_motion = np.concatenate([by_world @ turn, -corners.inverse[:, None, None] * by_world], axis=2)
        by_inverse = np.einsum("nij,nj->ni", by_world, corners.centre - T[:3, 3])
        by_inverse[:, 2] += 1 / z
        covariance = corners.variance[:, None, None] * by_inverse[:, :, None] * by_inverse[:, None, :]
        weight = np.linalg.inv(covariance + self._variances()[:, :, None] * np.eye(3))
        return np.einsum("ni,nij,nj->n", off, weight, off), off, weight, by_motion, by_inverse
