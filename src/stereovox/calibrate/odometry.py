# SPDX-License-Identifier: Apache-2.0
"""Motion of a depth camera from its images alone: each is registered with an earlier one (small_gicp)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MissingExtra
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rotation_matrix, rotation_vector

PLANE_REACH = 0.12
"""Metres; points farther apart do not correspond."""
MIN_NORMAL_COSINE = 0.9
"""Least cosine of the angle between two corresponding normals."""
INLIER_DISTANCE = 0.03
"""Metres off the plane up to which a point is an inlier."""
STEPS = 10
VARIETY = 0.02
"""Least share of normals along any axis: noise tilts those of a single wall, but by less."""
FLOOR = (np.radians(0.03), 0.002)
"""Errors that no number of points averages out (radians, metres)."""
CELL = 0.08
"""Metres; points nearer to each other than this are merged."""
REACH = 0.3
"""Metres; points farther apart do not correspond."""
MIN_POINTS = 200
"""Fewest points of a usable image."""
INLIERS = 0.55
"""Least share of inlier points."""
NEW_REFERENCE = (np.radians(35), 0.6, 0.7)
"""The reference is replaced beyond this turn (radians) or travel (metres), or below this share of inliers."""
WEAKEST = (np.radians(1.0), 0.05)
"""Uncertainty of turn (radians) or travel (metres) above which a registration fails: one wall does not fix sliding."""


def camera_motion(clouds: Iterable[tuple[int, NDArray[np.float64]]]) -> CameraMotion:
    """Return the motion between images, given in order as time in nanoseconds and (M, 3) points in the optical frame.

    An image that cannot be registered becomes the next reference, without a link to earlier ones.
    Raises MissingExtra without small_gicp.
    """
    register = _Registration()
    stamps: list[int] = []
    links: list[Link] = []
    key, step = -1, np.eye(4)
    for i, (stamp_ns, points) in enumerate(clouds):
        stamps.append(stamp_ns)
        guess = links[-1].T @ step if key >= 0 and key != i - 1 else step
        found = register.against(points, guess) if key >= 0 else None
        links.append(replace(found, reference=key) if found else Link())
        step = np.eye(4)
        if found:
            step = found.T if key == i - 1 else inverse(links[-2].T) @ found.T
        if not found or _is_far(found):
            key = i if register.set_reference(points) else -1
    return CameraMotion(
        np.array(stamps, np.int64),
        np.array([link.reference for link in links], np.intp),
        np.reshape([link.T for link in links], (-1, 4, 4)),
        np.reshape([link.covariance for link in links], (-1, 6, 6)),
    )


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Motion of a camera between the images of a recording.

    stamps_ns: (N,) int64. reference: (N,) the index of the image that each was registered with, -1 if none.
    T_reference_camera: (N, 4, 4), NaN without reference. covariance: (N, 6, 6) of the small error motion (rotation
    vector, then translation), seen from the camera: T_true = T exp(error).
    """

    stamps_ns: NDArray[np.int64]
    reference: NDArray[np.intp]
    T_reference_camera: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def steps(self) -> NDArray[np.float64]:
        """Return (N - 1, 4, 4) T_i_j from each image i to the next j, NaN if unknown."""
        T, reference = self.T_reference_camera, self.reference
        steps = np.full((max(len(T) - 1, 0), 4, 4), np.nan)
        for i in range(len(steps)):
            if reference[i + 1] == i:
                steps[i] = T[i + 1]
            elif reference[i + 1] >= 0 and reference[i + 1] == reference[i]:
                steps[i] = inverse(T[i]) @ T[i + 1]
        return steps


@dataclass(frozen=True, eq=False)
class Link:
    """The pose of an image: `T` (4, 4) in the frame of image `reference` (-1: unknown, `T` is NaN).

    covariance: (6, 6) of the small error motion (rotation vector, translation), T_true = T exp(error).
    share: inlier share of the image's points on the reference's surfaces.
    """

    reference: int = -1
    T: Transform = field(default_factory=lambda: np.full((4, 4), np.nan))
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.full((6, 6), np.nan))
    share: float = 0.0


@dataclass(frozen=True, eq=False)
class Surface:
    """Points (N, 3) in metres and normals (N, 3) of length one."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]

    @classmethod
    def of(cls, cloud: Any) -> Surface:
        """Return a small_gicp cloud's points and normals."""
        return cls(np.array(cloud.points())[:, :3], np.array(cloud.normals())[:, :3])


def refined(T: Transform, source: Surface, target: Surface, tree: Any) -> Link:
    """Return the motion near `T` that best registers the source to the target's surfaces.

    Iterated least squares of the distances d to the planes of the nearest points, weighted 1 / (1 + (d / s)^2) (Cauchy)
    with s twice their usual size, so that surfaces in only one image have little weight. `tree` finds points of
    `target`. If all surfaces face the same way the others can slide: such a link has no reference and share 0.
    """
    link = Link()
    for _ in range(STEPS):
        J, distances = _equations(T, source, target, tree)
        if len(distances) < 6 or _variety(J[:, 3:]) < VARIETY:
            return Link()
        usual = max(1.4826 * float(np.median(np.abs(distances))), 1e-3)
        weights = 1 / (1 + (distances / (2 * usual)) ** 2)
        information = (J.T * weights) @ J + 1e-6 * np.eye(6)
        change = np.asarray(np.linalg.solve(information, (J.T * weights) @ distances), float)
        covariance = usual**2 * np.linalg.inv(information) + np.diag(np.repeat(np.square(FLOOR), 3))
        link = Link(
            -1,
            T,
            np.asarray(covariance, float),
            float((np.abs(distances) < INLIER_DISTANCE).sum() / len(source.points)),
        )
        T = T @ _motion(change)
        if np.abs(change).max() < 1e-5:
            break
    return replace(link, T=orthonormalise(T))  # or rounding errors double from image to image


def _equations(
    T: Transform, source: Surface, target: Surface, tree: Any
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return J (M, 6) and distances (M,) for all points with a partner.

    A small motion (w, v) of the source changes a distance to a plane by w . (p x n) + v . n, n seen from the source.
    """
    moved = source.points @ T[:3, :3].T + T[:3, 3]
    indices, squared = (np.asarray(found).ravel() for found in tree.batch_nearest_neighbor_search(moved))
    local = target.normals[indices] @ T[:3, :3]
    alike = np.abs(np.einsum("ij,ij->i", local, source.normals)) > MIN_NORMAL_COSINE
    near = alike & (squared < PLANE_REACH**2)
    local = local[near]
    gaps = target.points[indices[near]] - moved[near]
    return np.hstack([np.cross(source.points[near], local), local]), np.einsum(
        "ij,ij->i", gaps, target.normals[indices[near]]
    )


def _variety(normals: NDArray[np.float64]) -> float:
    """Return the share of normals (N, 3) along the axis that has fewest."""
    return float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0])


def _motion(change: NDArray[np.float64]) -> Transform:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(change[:3]), change[3:]
    return T


def _is_far(link: Link) -> bool:
    turn, way, share = NEW_REFERENCE
    turned, moved = np.linalg.norm(rotation_vector(link.T[:3, :3])), np.linalg.norm(link.T[:3, 3])
    return bool(turned > turn or moved > way or link.share < share)


class _Registration:
    """Registers point clouds with the current reference."""

    def __init__(self) -> None:
        self._gicp = _small_gicp()
        self._target: Any = None

    def set_reference(self, points: NDArray[np.float64]) -> bool:
        """Make these points the reference; return False if they are too few."""
        if len(points) < MIN_POINTS:
            return False
        self._target = self._gicp.preprocess_points(points, CELL, num_neighbors=12)
        return True

    def against(self, points: NDArray[np.float64], guess: Transform) -> Link | None:
        """Return the camera's pose in the reference's frame; None if it is too uncertain."""
        if len(points) < MIN_POINTS:
            return None
        cloud, _ = self._gicp.preprocess_points(points, CELL, num_neighbors=12)
        target, tree = self._target
        limits = {"max_correspondence_distance": REACH, "max_iterations": 30}
        rough = self._gicp.align(target, cloud, tree, guess, registration_type="GICP", **limits)
        link = refined(np.array(rough.T_target_source), Surface.of(cloud), Surface.of(target), tree)
        return link if link.share >= INLIERS and _is_certain(link) else None


def _is_certain(link: Link) -> bool:
    parts = link.covariance[:3, :3], link.covariance[3:, 3:]
    return all(np.linalg.eigvalsh(part).max() < limit**2 for part, limit in zip(parts, WEAKEST, strict=True))


def _small_gicp() -> Any:
    try:
        import small_gicp
    except ImportError:
        raise MissingExtra("small_gicp", "pair") from None
    return small_gicp
