# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious twins of the kernels in `track/_surfels.py`: patches, normals, surfels by cell, equations of a motion.

They share no code with the kernels; tests compare them with it. A surfel here is the list of the patches in its cell.
"""

from __future__ import annotations

from collections import defaultdict
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.wide import Lens

Cell = tuple[int, int, int]
Vector = NDArray[np.float64]


def patch_points(depth: NDArray[Any], columns: NDArray[Any], rows: NDArray[Any], step: int) -> NDArray[np.float64]:
    """Return the mean point (h, w, 3) of each patch of step x step pixels, 0 where it is no surface."""
    height, width = depth.shape[0] // step, depth.shape[1] // step
    points = np.zeros((height, width, 3))
    for y, x in product(range(height), range(width)):
        middle = float(depth[y * step + step // 2, x * step + step // 2])
        if not np.isfinite(middle) or middle <= 0:
            continue
        pixels = product(range(y * step, (y + 1) * step), range(x * step, (x + 1) * step))
        same = [(v, u) for v, u in pixels if abs(float(depth[v, u]) - middle) < 0.04 * middle]
        if len(same) >= 0.6 * step * step:
            ray = np.mean([(columns[u], *rows[v]) for v, u in same], axis=0)
            points[y, x] = ray / np.mean([1 / float(depth[v, u]) for v, u in same])
    return points


def patch_normals(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the unit normal (h, w, 3) of each patch, towards the camera, by the neighbours there are; else 0."""
    height, width = points.shape[:2]
    normals = np.zeros((height, width, 3))

    def there(y: int, x: int) -> bool:
        return 0 <= y < height and 0 <= x < width and bool(points[y, x].any())

    for y, x in product(range(height), range(width)):
        if not there(y, x):
            continue
        here = points[y, x].astype(float)
        across = [points[y, k].astype(float) for k in (x - 1, x, x + 1) if there(y, k)]
        down = [points[k, x].astype(float) for k in (y - 1, y, y + 1) if there(k, x)]
        if len(across) == 1 or len(down) == 1:
            continue
        one, other = across[-1] - across[0], down[-1] - down[0]
        if max(np.linalg.norm(one), np.linalg.norm(other)) > 0.25 * np.linalg.norm(here):
            continue
        normal = np.cross(one, other)
        normal /= np.linalg.norm(normal)
        cosine = normal @ here / np.linalg.norm(here)
        if abs(cosine) > 0.15:
            normals[y, x] = -np.sign(cosine) * normal
    return normals


class Patch(NamedTuple):
    """A patch in the map's frame."""

    point: Vector
    normal: Vector
    sigma: float


class Surfel(NamedTuple):
    """The weighted mean of a cell's patches: weight, position, normal (not of unit length), variance, their number."""

    weight: float
    position: Vector
    normal: Vector
    variance: float
    number: int


class NaiveSurfels:
    """Surfels of one size, by cell."""

    def __init__(self, size: float):
        self.size = float(np.float32(size))
        self.patches = defaultdict[Cell, list[Patch]](list)

    def add(self, points: NDArray[Any], normals: NDArray[Any], sigma: NDArray[Any], T: NDArray[np.float64]) -> None:
        """Add patches seen from T."""
        for point, normal, one in zip(points.astype(float), normals.astype(float), sigma.astype(float), strict=True):
            place = T[:3, :3] @ point + T[:3, 3]
            x, y, z = np.floor(place / self.size).astype(int).tolist()
            self.patches[x, y, z].append(Patch(place, T[:3, :3] @ normal, float(one)))

    def surfels(self) -> dict[Cell, Surfel]:
        """Return the surfels of all cells."""
        return {cell: _mean(patches) for cell, patches in self.patches.items()}


def _mean(patches: list[Patch]) -> Surfel:
    variances = [patch.sigma**2 for patch in patches]
    weights = [1e-4 / variance for variance in variances]
    position = np.average([patch.point for patch in patches], axis=0, weights=weights)
    normal = np.average([patch.normal for patch in patches], axis=0, weights=weights)
    return Surfel(sum(weights), position, normal, float(np.average(variances, weights=weights)), len(patches))


class Equations(NamedTuple):
    """What `_surfels.equations` fills, and the robust cost whose gradient it is where normals are alike."""

    information: NDArray[np.float64]
    gradient: Vector
    spread: Vector
    ratios: Vector
    cost: float


def equations(
    surfels: dict[Cell, Surfel], size: float, patches: list[Patch], centre: Vector, slack: float, reach: float
) -> Equations:
    """Return the normal equations of a small motion of patches (map's frame) that were seen from `centre`."""
    information, gradient, spread, cost = np.zeros((6, 6)), np.zeros(6), np.zeros(10), 0.0
    ratios = []
    for point, normal, sigma in patches:
        surfel = _nearest(surfels, float(np.float32(size)), point, normal)
        if surfel is None:
            continue
        own = surfel.normal / np.linalg.norm(surfel.normal)
        arm, apart = point - centre, point - surfel.position
        off = own @ apart
        variance = sigma**2 + surfel.variance / min(surfel.number, 20) + slack**2
        ratio = off**2 / variance
        weight = 1 / variance / (1 + ratio / reach**2) ** 2
        by_seen, by_own = np.append(np.cross(arm, normal), normal), np.append(np.cross(arm, own), own)
        information += weight * (np.outer(by_seen, by_own) + np.outer(by_own, by_seen)) / 2
        gradient -= weight * (by_seen * off + by_own * (normal @ apart)) / 2
        x, y, z = arm
        spread += weight * np.array([1, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z])
        ratios.append(ratio)
        cost += ratio / (1 + ratio / reach**2) / 2
    return Equations(information, gradient, spread, np.array(ratios), cost)


def _nearest(surfels: dict[Cell, Surfel], size: float, point: Vector, normal: Vector) -> Surfel | None:
    """Return the nearest surfel with a normal that agrees, of the 2 x 2 x 2 cells whose common corner is nearest."""
    corner = np.rint(point / size).astype(int)
    found = []
    for shift in product((-1, 0), repeat=3):
        x, y, z = (corner + shift).tolist()
        surfel = surfels.get((x, y, z))
        if surfel is not None:
            length = np.linalg.norm(surfel.normal)
            if length >= 0.7 and surfel.normal @ normal >= 0.7 * length:
                found.append((float(np.linalg.norm(surfel.position - point)), surfel))
    return min(found, key=lambda both: both[0])[1] if found else None


def cell_of(key: int) -> Cell:
    """Return the cell of a key: three numbers of 21 binary digits, in two's complement."""
    digits = format(key, "063b")
    x, y, z = (int(digits[k : k + 21], 2) - (digits[k] == "1") * 2**21 for k in (0, 21, 42))
    return x, y, z


def seen_at(landmark: Vector, T: NDArray[np.float64], lens: Lens) -> Vector:
    """Return column, row and inverse depth (3,) of a point (3,) for a lens without distortion at T."""
    x, y, z = T[:3, :3].T @ (landmark - T[:3, 3])
    return np.array([lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy, 1 / z])


def inverse_depth_of_plane(
    plane: Vector, T_sensor_camera: NDArray[np.float64], lens: Lens, cell_px: int, shape: tuple[int, ...]
) -> NDArray[np.float64]:
    """Return the inverse depths (h, w) of a plane at the middles of cells of an image; plane: 1 / z = plane . ray.

    plane (3,): in the frame of the sensor, as plane . point = 1; the camera is at T_sensor_camera.
    """
    found = np.zeros(shape)
    normal = T_sensor_camera[:3, :3].T @ plane
    distance = 1 - plane @ T_sensor_camera[:3, 3]
    for i in range(shape[0]):
        for j in range(shape[1]):
            u, v = (j + 0.5) * cell_px - 0.5, (i + 0.5) * cell_px - 0.5
            ray = np.array([(u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, 1.0])
            found[i, j] = normal @ ray / distance
    return found
