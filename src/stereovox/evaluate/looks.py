# SPDX-License-Identifier: Apache-2.0
"""Number of places on a map's own path from which each true surface cell could be seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.evaluate.lidar_truth import project
from stereovox.evaluate.truth_cells import TruthCells
from stereovox.geometry.se3 import Transform, inverse, transform_points
from stereovox.maps import VoxelMap

MOST_PLACES = 100
"""Most places tried; a longer path is sampled evenly."""
_INSIDE = 1e-3
"""Distance in cells from a face to the target point inside the cell."""
_FACES = np.array([sign * axis for axis in np.eye(3, dtype=int) for sign in (-1, 1)])


def looks(voxel_map: VoxelMap, truth: TruthCells) -> NDArray[np.floating] | None:
    """Return the number of places (S,) on the path of `voxel_map` that could see each surface cell of the truth.

    A map keeps places of its camera at least 5 cm or 0.1 rad apart (`VoxelMap.path`), so a standing camera counts once,
    however many frames it takes. None for a map without a path or a camera, such as an imported one, and for one of
    several sensors, whose cameras are not kept.
    """
    path, viewpoint = voxel_map.history.path, voxel_map.viewpoint
    if viewpoint is None or len(path.stops) != 1:
        return None
    poses = path.poses(next(iter(path.stops)))
    chosen = np.unique(np.linspace(0, len(poses) - 1, MOST_PLACES).round().astype(int))
    counted = views(truth, poses[chosen], viewpoint.camera, voxel_map.config.max_range)
    return counted * (len(poses) / len(chosen))


def views(
    truth: TruthCells, poses: Sequence[Transform] | NDArray[np.float64], camera: PinholeCamera, max_range: float
) -> NDArray[np.int64]:
    """Count, for each surface cell of the truth (S,), the `poses`, T_world_camera, that can see it.

    A cell is seen if the middle of one of its faces is in the image, at most `max_range` metres away along the optical
    axis, and the straight line to it meets no other surface cell.
    """
    cells, size = truth.surface(), truth.voxel_size
    counts = np.zeros(len(cells), np.int64)
    for pose in poses:
        seen = np.zeros(len(cells), bool)
        near = _in_reach(cells, pose, max_range, size)
        for face in _FACES:
            middle = (cells[near] + 0.5 + (0.5 - _INSIDE) * face) * size
            turned = (pose[:3, 3] - middle) @ face > 0
            local = transform_points(inverse(pose), middle[turned])
            shown = project(camera, local)[1] & (local[:, 2] <= max_range)
            asked = near[turned][shown]
            seen[asked] |= _reached(truth.map, pose[:3, 3], middle[turned][shown], cells[asked])
        counts += seen
    return counts


def _in_reach(cells: NDArray[np.integer], pose: Transform, max_range: float, size: float) -> NDArray[np.int64]:
    """Return which cells are ahead of the camera, within its range and two cells."""
    ahead = ((cells + 0.5) * size - pose[:3, 3]) @ pose[:3, 2]
    return np.flatnonzero((ahead > -2 * size) & (ahead < max_range + 2 * size))


def _reached(
    truth: VoxelMap, origin: NDArray[np.float64], points: NDArray[np.float64], cells: NDArray[np.integer]
) -> NDArray[np.bool_]:
    """Return which `points` (N, 3), each in its cell, are the first hit of the ray from `origin`."""
    if not len(points):
        return np.zeros(0, bool)
    hits = truth.cast_rays(origin, points - origin, np.inf)
    return (hits.cell == cells).all(axis=1)
