# SPDX-License-Identifier: Apache-2.0
"""Surfaces seen so far, as surfels in cubic cells of several sizes, and the registration of depth images to them."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import DepthImage
from stereovox.geometry.se3 import Transform
from stereovox.track._surfels import EMPTY, FIELDS, carry, drop, equations, nearest, normals, patches, put
from stereovox.track.fit import Fit, Stage, solve_stages

PATCHES_ACROSS = 80
"""Patches along the longer side of an image."""
SIZES = (0.3, 0.1, 0.05, 0.025)
"""Sizes of cells in metres, from coarse to fine."""
SLACK = (0.05, 0.015, 0.005, 0.002)
"""Deviation from a plane, in metres, of surfaces within one cell of each size."""
EVERY = (4, 4, 2, 1)
"""One of this many patches is used, at each size."""
SAMPLED = 4
"""One of this many patches is sampled to scale the residuals."""
REACH = 3.0
"""Standard deviations above which a patch has little weight."""
CONVERGED = 0.01
"""Step, in metres and radians, that ends a stage, as a share of the cells' size."""
AGAIN = 0.1
"""Motion of the pose, as a share of the cells' size, after which nearest surfels are searched again."""
MOST = 5e3
"""Weight at which a surfel becomes a running mean."""
ALIKE = 2.0
"""Number of patches with correlated errors, which count as one: neighbours see the same surfel and share the camera's
own distortion. Chosen so that covariances hold in simulation (docs/tracking.md)."""
USUAL = 3.0
"""Standard deviations within which a patch agrees with a surfel."""
MEDIAN = 0.455
"""Median of the square of a standard normal variable."""
QUIETEST = 0.01
"""Least accepted variance of residuals, as a share of the expected one."""
BENT = 0.05
"""Radians by which camera distortion may bend a plane's normals; information of that size is subtracted."""
ELDER, LAG = 1, 30
"""Index of the cell size of older surfels, and their least age in images."""
OWN = np.diag(np.repeat([0.1, 0.1], 3) ** 2)
"""Prior covariance of a pose by older surfels: wide."""
PLANES, PLANE, GUESSES, ALONG, THICK_M = 5, 0.04, 60, np.float32(0.94), np.float32(0.04)
"""Largest planes of a view: their number, least share of it, number of trials, least cosine of normals, and half
thickness in metres."""
FIRST = 1 << 14
"""Slots in a new table."""


class Patches(NamedTuple):
    """Patches of an image that lie on surfaces, camera frame: points, normals (N, 3), sigma (N,) in metres; float32.

    sigma: standard deviation along the ray.
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    sigma: NDArray[np.float32]

    def thinned(self, every: int) -> Patches:
        """Return one of `every` patches."""
        return self if every == 1 else Patches(*(np.ascontiguousarray(part[::every]) for part in self))


def patches_of(image: DepthImage, sigma_of: NDArray[np.float64], rows_per_metre: float) -> Patches:
    """Return the patches of an image. sigma_of: standard deviation of a depth, by depth times `rows_per_metre`."""
    depth = image.depth_m
    step = max(1, round(max(depth.shape) / PATCHES_ACROSS))
    shape = (depth.shape[0] // step, depth.shape[1] // step, 3)
    point, normal = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    columns, rows = (np.ascontiguousarray(rays, np.float32) for rays in image.camera.rays())
    patches(depth, columns, rows, step, point)
    normals(point, normal)
    there = normal.any(axis=2)
    away = np.linalg.norm(point, axis=2)
    row = np.minimum(away[there] * rows_per_metre, len(sigma_of) - 1).astype(int)
    return Patches(point[there], normal[there], sigma_of[row].astype(np.float32))


def beside_planes(seen: Patches) -> Patches:
    """Return the patches of an image outside its largest planes: floor, walls, ceiling."""
    few = seen.thinned(2)
    offset = np.einsum("ni,ni->n", few.points, few.normals)
    left = np.ones(len(few.points), bool)
    for _ in range(PLANES):
        tried = np.flatnonzero(left)[:: max(1, int(left.sum()) // GUESSES)]
        on = left & (few.normals[tried] @ few.normals.T > ALONG)
        on &= np.abs(few.normals[tried] @ few.points.T - offset[tried, None]) < THICK_M + few.sigma
        number = on.sum(axis=1)
        if not len(number) or number.max() < PLANE * len(left):
            break
        left &= ~on[number.argmax()]
    return Patches(*(np.ascontiguousarray(part[left]) for part in few))


class Surfels:
    """Surfels of one size, in a hash table that grows."""

    def __init__(self, size: float):
        self.size, self.number = np.float32(size), 0
        self._keys = np.full(FIRST, EMPTY)
        self._surfels = np.zeros((FIRST, FIELDS), np.float32)
        self.forget(np.zeros(3), 1.0)  # compile now, not in the middle of a run
        carry(self._keys[:0], self._surfels[:0], self._keys[:0].copy(), self._surfels[:0].copy())

    def add(self, seen: Patches, T: Transform) -> None:
        """Add patches seen from T_map_camera."""
        while 2 * (self.number + len(seen.points)) > len(self._keys):
            self._grow()
        R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        self.number += put(self._keys, self._surfels, self.size, *seen[:3], R, t, np.float32(MOST))

    def forget(self, centre: NDArray[np.float64], radius: float) -> None:
        """Drop all surfels farther than `radius` metres from `centre` (3,) along an axis."""
        self.number -= drop(self._keys, self._surfels, float(self.size), np.asarray(centre, float), float(radius))

    def nearest(self, seen: Patches, T: Transform) -> NDArray[np.int64]:
        """Return the number (N,) of the surfel of each patch seen from T_map_camera, -1 if there is none."""
        slots = np.empty(len(seen.points), np.int64)
        R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        nearest(self._keys, self._surfels, self.size, seen.points, seen.normals, R, t, slots)
        return slots

    def equations(
        self, seen: Patches, slots: NDArray[np.int64], T: Transform, slack: float, reach: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32]]:
        """Return information (6, 6), less the part due to bent normals, and gradient (6,): `_surfels.equations`.

        Also the squared residuals, over their variance, of the patches that have a surfel.
        """
        information, gradient, spread = np.zeros((6, 6)), np.zeros(6), np.zeros(10)
        R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
        ratios = np.empty(len(seen.points), np.float32)
        known = equations(
            self._keys, self._surfels, self.size, slots, *seen[:3], R, t, np.float32(slack), reach,
            information, gradient, spread, ratios,
        )  # fmt: skip
        ratios = ratios[:known]
        noise = max(float(np.minimum(ratios, USUAL**2).mean()), QUIETEST) if known else 1.0
        information -= BENT**2 * _held_by_any(spread)
        return information / (ALIKE * noise), gradient / (ALIKE * noise), ratios

    def _grow(self) -> None:
        """Move the surfels into a table twice as large."""
        keys = np.full(2 * len(self._keys), EMPTY)
        surfels = np.zeros((len(keys), FIELDS), np.float32)
        carry(self._keys, self._surfels, keys, surfels)
        self._keys, self._surfels = keys, surfels


class SurfelMap:
    """Surfels of all sizes."""

    def __init__(self) -> None:
        self._levels = [Surfels(size) for size in SIZES]

    def add(self, seen: Patches, T_map_camera: Transform) -> None:
        """Add the patches of an image."""
        for level in self._levels:
            level.add(seen, T_map_camera)

    def forget(self, centre: NDArray[np.float64], radius: float) -> None:
        """Drop all surfels farther than `radius` metres from `centre` (3,) along an axis."""
        for level in self._levels:
            level.forget(centre, radius)

    def levels(self, seen: Patches, quietest: float = 1.0) -> list[Level]:
        """Return the equations of an image on the surfels of each size, from coarse to fine.

        quietest: residuals far beyond those of most patches at the expected pose have little weight, down to this share
            of the expected variance. 1: only residuals far beyond the expected variance.
        """
        sizes = zip(self._levels, SLACK, EVERY, strict=True)
        return [Level(level, slack, seen.thinned(every), quietest) for level, slack, every in sizes]


class Elders:
    """Surfels learned a while ago, which check poses on newer ones.

    A moving object carries along surfels just learned from it, but none of these.
    """

    def __init__(self) -> None:
        self._surfels, self._number = Surfels(SIZES[ELDER]), 0
        self._waiting: deque[tuple[Patches, Transform]] = deque()

    def add(self, seen: Patches, T_map_camera: Transform) -> None:
        """Add the patches of an image once `LAG` others have arrived; early on, once as many as preceded it."""
        self._waiting.append((seen.thinned(2), T_map_camera))
        self._number += 1
        while len(self._waiting) > min(LAG, self._number / 2):
            self._surfels.add(*self._waiting.popleft())

    def forget(self, centre: NDArray[np.float64], radius: float) -> None:
        """Drop all surfels farther than `radius` metres from `centre` (3,) along an axis."""
        self._surfels.forget(centre, radius)

    def fit(self, seen: Patches, T_map_camera: Transform) -> Fit:
        """Return the pose that they support, near a given one; its covariance is wide if they constrain none."""
        level = Level(self._surfels, SLACK[ELDER], seen.thinned(SAMPLED), 1.0)
        T, covariance = solve_stages([Stage(level, CONVERGED * level.size)], T_map_camera, OWN)
        return Fit(T, covariance, level.known, level.inlier_share)


class Level:
    """The equations that register an image to the surfels of one size.

    Attributes:
        size: Of the surfels' cells, in metres.
        seen: Patches of the image.
        ratios: (N,) squared residuals, over their variance, of the patches that had a surfel at the latest pose.
    """

    def __init__(self, level: Surfels, slack: float, seen: Patches, quietest: float):
        self.size, self.seen = float(level.size), seen
        self._level, self._slack, self._quietest = level, slack, quietest
        self._reach = REACH
        self._slots, self._at = np.empty(0, np.int64), np.full((4, 4), np.inf)
        self.ratios = np.empty(0, np.float32)

    def __call__(self, T: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return information (6, 6) and gradient (6,) at a pose: `Equations`."""
        if not np.abs(T - self._at).max() < AGAIN * self.size:
            self._slots, self._at = self._level.nearest(self.seen, T), T
        if not len(self.ratios) and self._quietest < 1:
            some, slots = self.seen.thinned(SAMPLED), np.ascontiguousarray(self._slots[::SAMPLED])
            ratios = self._level.equations(some, slots, T, self._slack, REACH)[2]
            self._reach *= float(np.sqrt(max(_scale(ratios), self._quietest)))
        information, gradient, self.ratios = self._level.equations(self.seen, self._slots, T, self._slack, self._reach)
        return information, gradient

    @property
    def known(self) -> float:
        """Share of the patches that had a surfel."""
        return len(self.ratios) / max(len(self.seen.points), 1)

    @property
    def inlier_share(self) -> float:
        """Share of those patches that agree with it."""
        return float(np.mean(self.ratios < USUAL**2)) if len(self.ratios) else 0.0


def _scale(ratios: NDArray[np.float32]) -> float:
    """Return a robust variance of the residuals, relative to the expected one; at most 1."""
    return float(min(np.median(ratios) / MEDIAN, 1.0)) if len(ratios) else 1.0


def _held_by_any(spread: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the information (6, 6) that patches with normals in all directions would give; spread: (10,) moments."""
    weight, (x, y, z) = spread[0], spread[1:4]
    xx, xy, xz, yy, yz, zz = spread[4:]
    held = np.zeros((6, 6))
    held[:3, :3] = [[yy + zz, -xy, -xz], [-xy, xx + zz, -yz], [-xz, -yz, xx + yy]]
    held[:3, 3:] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    held[3:, :3] = held[:3, 3:].T
    held[3:, 3:] = weight * np.eye(3)
    return held
