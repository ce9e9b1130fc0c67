# SPDX-License-Identifier: Apache-2.0
"""Point-to-plane registration with robust weights: the last step, and how certain it is."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry import Transform, orthonormalise, rotation_matrix

REACH = 0.12
"""Metres; points further apart do not belong together."""
ALIKE = 0.9
"""Least cosine of the angle between two normals that belong together."""
CLOSE = 0.03
"""Metres; a partner counts as found when it lies no further off the plane."""
STEPS = 10
VARIETY = 0.02
"""Least share of normals along any axis: noise tilts those of a single wall, but by less."""
FLOOR = (np.radians(0.03), 0.002)
"""Errors that no count of points averages away (radians, metres)."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Points (N, 3) in metres and normals (N, 3) of length one."""

    points: NDArray[np.float64]
    normals: NDArray[np.float64]

    @classmethod
    def of(cls, cloud: Any) -> Surface:
        """Return what a small_gicp cloud holds."""
        return cls(np.array(cloud.points())[:, :3], np.array(cloud.normals())[:, :3])


@dataclass(frozen=True, eq=False)
class Link:
    """Where an image was taken: `T` (4, 4) in the frame of image number `reference` (-1: not known, `T` is NaN).

    covariance: (6, 6) of the small motion (rotation vector, translation) by which it may be off, T_true = T exp(error).
    share: of the image's points that lie on the reference's surfaces.
    """

    reference: int = -1
    T: Transform = field(default_factory=lambda: np.full((4, 4), np.nan))
    covariance: NDArray[np.float64] = field(default_factory=lambda: np.full((6, 6), np.nan))
    share: float = 0.0


def refined(T: Transform, source: Surface, target: Surface, tree: Any) -> Link:
    """Return the motion near `T` that moves the source onto the target's surfaces best.

    Iterated least squares of the distances d to the planes of the nearest points, weighted 1 / (1 + (d / s)^2) (Cauchy)
    with s twice their usual size, so that what only one image sees has little say. `tree` finds points of `target`.
    Surfaces that all look the same way let the other slide: such a link has no reference and share 0.
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
        link = Link(-1, T, np.asarray(covariance, float), float((np.abs(distances) < CLOSE).sum() / len(source.points)))
        T = T @ _motion(change)
        if np.abs(change).max() < 1e-5:
            break
    return replace(link, T=orthonormalise(T))  # or the errors of rounding double from image to image


def _equations(
    T: Transform, source: Surface, target: Surface, tree: Any
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return J (M, 6) and distances (M,) for all points that have a partner.

    A small motion (w, v) of the source changes a distance to a plane by w . (p x n) + v . n, n seen from the source.
    """
    moved = source.points @ T[:3, :3].T + T[:3, 3]
    indices, squared = (np.asarray(found).ravel() for found in tree.batch_nearest_neighbor_search(moved))
    local = target.normals[indices] @ T[:3, :3]
    alike = np.abs(np.einsum("ij,ij->i", local, source.normals)) > ALIKE
    near = alike & (squared < REACH**2)
    local = local[near]
    gaps = target.points[indices[near]] - moved[near]
    return np.hstack([np.cross(source.points[near], local), local]), np.einsum(
        "ij,ij->i", gaps, target.normals[indices[near]]
    )


def _variety(normals: NDArray[np.float64]) -> float:
    """Return the share of normals (N, 3) that look along the axis along which fewest do."""
    return float(np.linalg.eigvalsh(normals.T @ normals / len(normals))[0])


def _motion(change: NDArray[np.float64]) -> Transform:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(change[:3]), change[3:]
    return T
