# SPDX-License-Identifier: Apache-2.0
"""The walls of the apartment's rooms in a map: thickness, straightness, corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.truth import Keys, keys, occupied_cells, touched_cells
from stereovox.maps import VoxelMap
from stereovox.simulate.scene import Solid
from stereovox.simulate.scenes.apartment import ROOMS
from stereovox.simulate.stage import Face, Stage
from stereovox_lab.papers.chien.walls import (
    Wall,
    WallFound,
    corner_deg,
    judged_columns,
    measure_wall,
    thickness_figures,
)

SIDES = ("west", "south", "east", "north")
INNER = "outer wall"
BESIDE_M = 0.15
"""Metres on either side of an inner wall's end within which the outer wall is not judged."""
REACH_M = 0.24
"""Occupied cells within this distance of a wall's face count as the wall, which is 0.25 m thick."""
INSET_M = 0.15
"""Metres of a wall next to a corner, floor or ceiling that are not judged: the other surface is there too."""
IN_FRONT_M = 0.4
"""Occupied cells up to this far in front of a face count as its wall; behind it, up to the wall's middle."""
INNER_HALF_M, OUTER_M = 0.06, 0.25
"""Half the thickness of inner walls, behind whose middle the other room's face begins; thickness of outer ones."""


def measure_outer(voxel_map: VoxelMap, stage: Stage, only: Keys, others: Keys) -> dict[str, WallFound]:
    """Return the outer walls by side, measured in a map by their faces towards the rooms.

    only, others: see `measure_wall`; the ends of inner walls are also left out.
    Raises StereovoxError if one of them has too few columns.
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
    """Return a box that is larger by `metres` on every side."""
    normals, offsets = solid.planes[:, :3], solid.planes[:, 3]
    corners = solid.triangles.reshape(-1, 3)
    on = np.abs(corners @ normals.T - offsets) < 1e-6
    return Solid(solid.part, solid.name, (corners + metres * (on @ normals)).reshape(-1, 3, 3))


def _whole_face(side: str, faces: Sequence[Face]) -> Wall:
    """Return the outermost of these faces, all facing one way, extended over all those in its plane."""
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


@dataclass(frozen=True, eq=False)
class RoomsFound:
    """The walls of one map, `name` in tables and pictures.

    walls: one for each measurable side of a room; missing: the others, each with its number of well-seen columns with
    at most two occupied cells; corners_deg: the rooms' angles.
    outer: the apartment's own four walls, along several rooms each.
    """

    name: str
    voxel_map: VoxelMap
    walls: dict[str, WallFound]
    missing: dict[str, int]
    corners_deg: dict[str, float]
    outer: dict[str, WallFound]

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        off = {name: abs(angle - 90) for name, angle in self.corners_deg.items()}
        outer = outer_corners(self.outer)
        offsets = np.array([wall.offset for wall in self.walls.values()])
        straight = np.array([wall.straightness for wall in self.walls.values()])
        seen = sum(wall.columns for wall in self.walls.values()) + sum(self.missing.values())
        filled = sum(len(wall.thickness) for wall in self.walls.values())
        return {
            "name": self.name,
            "voxel_size": self.voxel_map.voxel_size,
            "frames": self.voxel_map.frames,
            "frames_refused": self.voxel_map.frames_refused,
            "walls": len(self.walls),
            "missing": self.missing,
            **thickness_figures(list(self.walls.values())),
            "solid_share": filled / seen,
            "straightness_median_m": float(np.median(straight)),
            "straightness_max_m": float(straight.max()),
            "offset_rms_m": float(np.sqrt(np.mean(offsets**2))),
            "corners": len(off),
            "corner_error_median_deg": float(np.median(list(off.values()) or [0.0])),
            "corner_error_max_deg": max(off.values(), default=0.0),
            "corners_deg": self.corners_deg,
            "outer_corner_error_max_deg": max(abs(angle - 90) for angle in outer.values()),
            "outer_corners_deg": outer,
            "outer_walls": [wall.figures() for wall in self.outer.values()],
            "each_wall": [wall.figures() for wall in self.walls.values()],
        }


def measure_rooms(name: str, voxel_map: VoxelMap, stage: Stage, well_seen: Keys) -> RoomsFound:
    """Measure all sides of all rooms in a map in Chien's axes (y down).

    stage: the apartment in the map's frame; well_seen: cells that its walls touch and that were seen often enough.
    Raises StereovoxError if no wall can be measured.
    """
    size = voxel_map.voxel_size
    others = _other_things(stage, size)
    occupied = _occupied(voxel_map)
    walls: dict[str, WallFound] = {}
    missing: dict[str, int] = {}
    for face in stage.faces:
        try:
            walls[face.name] = measure_face(occupied, face, well_seen, others)
        except StereovoxError:
            missing[face.name] = seen_columns(face, size, well_seen, others)
    if not walls:
        raise StereovoxError(f"{name}: not one wall stands in the map of {voxel_map.frames} frames; map more of them")
    outer = measure_outer(occupied, stage, well_seen, others)
    return RoomsFound(name, voxel_map, walls, missing, _corners(walls), outer)


def measure_face(voxel_map: VoxelMap, face: Face, only: Keys | None = None, others: Keys | None = None) -> WallFound:
    """Measure one side of a room. Cells behind the middle of an inner wall belong to the other room's side.

    Raises StereovoxError if too little of it is in the map.
    """
    behind = OUTER_M if _outer(face.name) else INNER_HALF_M
    return measure_wall(_only_near(voxel_map, face, behind), _inset(face), only=only, others=others, reach=IN_FRONT_M)


def seen_columns(face: Face, size: float, only: Keys, others: Keys) -> int:
    """Return the number of columns through one side of a room, in cells of `size` metres, for `measure_face`."""
    return len(judged_columns(_inset(face), size, only=only, others=others, reach=IN_FRONT_M))


def _occupied(voxel_map: VoxelMap) -> VoxelMap:
    """Return a map of the occupied cells alone: smaller, for code that needs no others."""
    cells = occupied_cells(voxel_map)
    return VoxelMap.from_cells(voxel_map.config, cells, np.full(len(cells), voxel_map.config.map.log_odds_max))


def _only_near(voxel_map: VoxelMap, face: Face, behind: float) -> VoxelMap:
    """Return a map of the cells in front of the face, or up to `behind` metres behind it."""
    cells, log_odds = voxel_map.cells()
    height = (voxel_map.centers(cells) - face.corners[0]) @ face.normal
    kept = (height >= -behind) & (height <= IN_FRONT_M)
    return VoxelMap.from_cells(voxel_map.config, cells[kept], log_odds[kept])


def _inset(face: Face) -> Wall:
    a, b, _, d = face.corners
    sides = np.stack([b - a, d - a])
    units = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    return Wall(face.name, a + INSET_M * units.sum(0), sides - 2 * INSET_M * units, face.normal)


def _outer(name: str) -> bool:
    """Return whether there is no other room behind a face: it is at the apartment's rim."""
    room, _, side = name.rpartition(" ")
    index = SIDES.index(side)
    rim = [limits[index] for limits in ROOMS.values()]
    return ROOMS[room][index] == (min(rim) if index < 2 else max(rim))


def _other_things(stage: Stage, size: float) -> Keys:
    """Return the cells of furniture and door frames."""
    others = [solid for solid in stage.scene.solids if solid.part not in ("walls", "floor", "ceiling")]
    return np.unique(keys(np.concatenate([touched_cells(solid.triangles, size) for solid in others])))


def _corners(walls: dict[str, WallFound]) -> dict[str, float]:
    """Return the angle in every room corner whose walls were both measured."""
    angles = {}
    for room in ROOMS:
        for a, b in zip(SIDES, (*SIDES[1:], SIDES[0]), strict=True):
            one, other = walls.get(f"{room} {a}"), walls.get(f"{room} {b}")
            if one and other:
                angles[f"{room} {a} {b}"] = corner_deg(one, other)
    return angles
