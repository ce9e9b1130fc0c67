# SPDX-License-Identifier: Apache-2.0
"""Where a camera would have to stand for its depth image to lie on the surfaces of a map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.frame import DepthImage
from stereovox.geometry import Transform
from stereovox.maps import VoxelMap

POINTS = 400
"""Pixels that are laid onto the map."""
STEPS = 20
REACH_M, REACH_CELLS = 0.6, 3.0
"""How far a point looks for its surface in the first step, and in the last."""
FEWEST = 30
"""Points that must find a surface."""


def pose_on_surfaces(voxel_map: VoxelMap, image: DepthImage) -> Transform | None:
    """Return T_world_sensor (4, 4) near the image's own for which its points lie on occupied cells; None: not found.

    Iterative closest points (Besl and McKay 1992) from points to the centres of occupied cells, whose reach shrinks.
    """
    points, T = _points(image), image.T_world_sensor
    if len(points) < FEWEST:
        return None
    last = min(REACH_M, REACH_CELLS * voxel_map.voxel_size)
    for reach in np.geomspace(max(REACH_M, last), last, STEPS):
        there = points @ T[:3, :3].T + T[:3, 3]
        found = voxel_map.nearest_obstacle(there, float(reach))
        near = np.isfinite(found.distance)
        if near.sum() < FEWEST:
            return None
        T = _motion(there[near], voxel_map.centers(found.cell[near])) @ T
    return T


def _points(image: DepthImage) -> NDArray[np.float64]:
    """Return some of the image's points (N, 3) in the camera's frame."""
    step = max(1, round((image.depth_m.size / POINTS) ** 0.5))
    columns, rows = (rays.astype(float) for rays in image.camera.rays())
    depth = image.depth_m[::step, ::step].astype(float)
    x, y, z = np.broadcast_arrays(columns[None, ::step], rows[::step, :1], rows[::step, 1:])
    seen = np.isfinite(depth)
    return np.stack([x[seen], y[seen], z[seen]], axis=1) * depth[seen][:, None]


def _motion(of: NDArray[np.float64], onto: NDArray[np.float64]) -> Transform:
    """Return the rigid motion (4, 4) that brings points (N, 3) nearest to others, one by one (Kabsch 1976)."""
    middle, target = of.mean(axis=0), onto.mean(axis=0)
    u, _, vt = np.linalg.svd((of - middle).T @ (onto - target))
    flip = np.diag([1.0, 1.0, np.linalg.det(u @ vt)])
    T = np.eye(4)
    T[:3, :3] = (u @ flip @ vt).T
    T[:3, 3] = target - T[:3, :3] @ middle
    return T
