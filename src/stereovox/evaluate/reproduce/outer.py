# SPDX-License-Identifier: Apache-2.0
"""The apartment's four outer walls, eight metres along several rooms each, as they stand in a map."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.cells import Keys, keys
from stereovox.evaluate.truth import touched_cells
from stereovox.evaluate.walls import Wall, WallFound, corner_deg, measure_wall
from stereovox.maps import VoxelMap
from stereovox.sources.scene import Solid
from stereovox.sources.stage import Face, Stage

SIDES = ("west", "south", "east", "north")
INNER = "outer wall"
BESIDE_M = 0.15
"""So far on either side of an inner wall that ends at an outer one the outer one is not judged."""
REACH_M = 0.24
"""Occupied cells up to so far before and behind a wall's face are taken for the wall, which is 0.25 m thick."""


def measure_outer(voxel_map: VoxelMap, stage: Stage, only: Keys, others: Keys) -> dict[str, WallFound]:
    """Return the outer walls by side, as their faces towards the rooms stand in a map.

    only, others: see `measure_wall`; places where inner walls end are left out besides.
    Raises StereovoxError where one of them stands in too few columns.
    """
    ends = _inner_walls(stage, voxel_map.voxel_size)
    of_side = {side: [face for face in stage.faces if face.name.endswith(f" {side}")] for side in SIDES}
    faces = {side: _whole_face(side, several) for side, several in of_side.items()}
    blocked = np.union1d(others, ends)
    return {
        side: measure_wall(voxel_map, wall, only=only, others=blocked, reach=REACH_M) for side, wall in faces.items()
    }


def outer_corners(walls: dict[str, WallFound]) -> dict[str, float]:
    """Return the angle in degrees in each of the apartment's four corners."""
    pairs = zip(SIDES, (*SIDES[1:], SIDES[0]), strict=True)
    return {f"{one} {other}": corner_deg(walls[one], walls[other]) for one, other in pairs}


def grown(solid: Solid, metres: float) -> Solid:
    """Return a box that is larger by so much on every side."""
    normals, offsets = solid.planes[:, :3], solid.planes[:, 3]
    corners = solid.triangles.reshape(-1, 3)
    on = np.abs(corners @ normals.T - offsets) < 1e-6
    return Solid(solid.part, solid.name, (corners + metres * (on @ normals)).reshape(-1, 3, 3))


def _whole_face(side: str, faces: Sequence[Face]) -> Wall:
    """Return the outermost of these faces, which look one way, made as long as all that lie in its plane."""
    normal = faces[0].normal
    depth = [float(face.corners[0] @ normal) for face in faces]
    coplanar = [face for face, at in zip(faces, depth, strict=True) if at < min(depth) + 1e-6]
    corner, along = coplanar[0].corners[0], coplanar[0].corners[[1, 3]] - coplanar[0].corners[0]
    length = np.linalg.norm(along, axis=1)
    units = along / length[:, None]
    reach = (np.concatenate([face.corners for face in coplanar]) - corner) @ units.T
    low, high = reach.min(0), reach.max(0)
    inset = BESIDE_M
    start = corner + (low + inset) @ units
    return Wall(f"outer wall, {side}", start, units * (high - low - 2 * inset)[:, None], normal)


def _inner_walls(stage: Stage, size: float) -> NDArray[np.int64]:
    inner = [grown(solid, BESIDE_M) for solid in stage.scene.part("walls") if not solid.name.startswith(INNER)]
    return np.unique(keys(np.concatenate([touched_cells(solid.triangles, size) for solid in inner])))
