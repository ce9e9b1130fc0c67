# SPDX-License-Identifier: Apache-2.0
"""Accuracy of a spherical grid against the surfaces of a simulated scene, direction by direction."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import StereoPair
from stereovox.cameras.wide import SphericalCamera
from stereovox.depth.sphere import SphereGrid, SphereLayout
from stereovox.frame import Reason
from stereovox.geometry.se3 import Transform, inverse, transform_points
from stereovox.simulate.scene import Scene

CLOSE = 0.03
"""Largest error of a range, as a share of the true distance."""
SIGMAS = 2.0
SLACK = 1e-3
"""Share of a distance by which a surface may seem nearer: rays are float32."""


def nearest_surfaces(
    scene: Scene, T_world_body: Transform, layout: SphereLayout, rays: int = 4
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the true range of the nearest and of the farthest surface in each cell (azimuths, polars), metres.

    From rays * rays rays from the body's origin, uniform in both angles. Infinite if there is nothing.
    """
    offsets = ((np.arange(rays) + 0.5) / rays - 0.5) * layout.step
    theta = (layout.polar()[:, None] + offsets).reshape(1, -1)
    phi = (layout.azimuth()[:, None] + offsets).reshape(-1, 1)
    parts = np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
    directions = np.stack(parts, axis=-1).reshape(-1, 3) @ T_world_body[:3, :3].T
    ranges = scene.cast(T_world_body[:3, 3], directions)
    boxes = ranges.reshape(layout.azimuths, rays, layout.polars, rays)
    return boxes.min(axis=(1, 3)), boxes.max(axis=(1, 3))


def seen_cells(
    scene: Scene, pairs: Sequence[StereoPair], T_world_body: Transform, layout: SphereLayout
) -> NDArray[np.bool_]:
    """Return which cells (azimuths, polars) have, at their middle, a surface seen by both eyes of some pair."""
    rays = layout.directions().reshape(-1, 3)
    ranges = scene.cast(T_world_body[:3, 3], rays @ T_world_body[:3, :3].T)
    there = np.isfinite(ranges)
    points = transform_points(T_world_body, rays[there] * ranges[there, None])
    seen = np.zeros(len(rays), bool)
    for pair in pairs:
        seen[there] |= _both_see(scene, pair, T_world_body, points)
    return seen.reshape(layout.shape)


def range_sigma(
    pair: StereoPair, layout: SphereLayout, range_m: NDArray[np.floating], disparity_sigma: float
) -> NDArray[np.float64]:
    """Return the standard deviation (azimuths, polars) in metres of a pair's ranges; NaN if it has none.

    From Valenti 2018, Eq 4.2 and 4.7, along the ray from the pair's left eye. disparity_sigma: pixels.
    """
    finite = np.where(np.isfinite(range_m), range_m, np.nan)
    points = (layout.directions() * finite[..., None]).reshape(-1, 3)
    x, y, z = transform_points(inverse(pair.T_body_camera), points).T
    camera, baseline = pair.camera, pair.camera.baseline or np.nan
    spherical = isinstance(camera, SphericalCamera)
    depth = np.hypot(y, z) if spherical else z
    with np.errstate(all="ignore"):
        if spherical:
            here, there = np.arctan2(x, depth), np.arctan2(x - baseline, depth)
            disparity = (here - there) / camera.step_u
            per_pixel = baseline * np.cos(here) ** 2 * camera.step_u / np.sin(disparity * camera.step_u) ** 2
        else:
            per_pixel = depth**2 / (camera.focal_px * baseline)
        sigma = per_pixel * disparity_sigma * np.linalg.norm([x, y, z], axis=0) / depth
    return np.where(depth > 0, sigma, np.nan).reshape(layout.shape)


def sphere_score(
    grid: SphereGrid, nearest: NDArray[np.floating], seen: NDArray[np.bool_], sigma: NDArray[np.floating]
) -> dict[str, float]:
    """Compare a grid with the truth in the directions seen, as shares from 0 to 1.

    nearest, seen, sigma: (azimuths, polars), true range of the nearest surface of each cell, whether a stereo camera
    sees it, and standard deviation of a range in metres. Each cell counts alike, regardless of its solid angle. known:
    share of the seen directions with a range. close: share of these within 3 % of the truth; close_of_seen: of all seen
    ones. over: share of ranges more than 2 sigma beyond the nearest surface. median: of range / truth - 1.
    """
    known = seen & (grid.reason == Reason.VALID)
    found, truth = grid.range_m[known].astype(float), nearest[known].astype(float)
    close = np.abs(found / truth - 1) <= CLOSE
    return {
        "directions": int(seen.sum()),
        "known": float(known.sum() / max(seen.sum(), 1)),
        "close": float(close.mean()) if known.any() else 0.0,
        "close_of_seen": float(close.sum() / max(seen.sum(), 1)),
        "over": float((found > truth + SIGMAS * sigma[known]).mean()) if known.any() else 0.0,
        "median": float(np.median(found / truth - 1)) if known.any() else 0.0,
    }


def _both_see(
    scene: Scene, pair: StereoPair, T_world_body: Transform, points: NDArray[np.float64]
) -> NDArray[np.bool_]:
    assert pair.eyes is not None
    R_left, _ = pair.eyes.rectifying_rotations()
    T_world_left = T_world_body @ pair.T_body_camera
    T_world_left[:3, :3] = T_world_left[:3, :3] @ R_left.T
    seen = np.ones(len(points), bool)
    for lens, T in ((pair.eyes.left, T_world_left), (pair.eyes.right, T_world_left @ pair.eyes.T_left_right)):
        u, v = lens.project(transform_points(inverse(T), points)).T
        inside = (u >= 0) & (u <= lens.width - 1) & (v >= 0) & (v <= lens.height - 1)
        seen &= inside & (scene.cast(T[:3, 3], points - T[:3, 3]) > 1 - SLACK)
    return seen
