# SPDX-License-Identifier: Apache-2.0
"""The sides of the apartment's rooms as they stand in a map: thickness, straightness, corners."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.cells import Keys, indices, keys
from stereovox.evaluate.truth import touched_cells
from stereovox.evaluate.walls import Wall, WallFound, corner_deg, measure_wall, thickness_figures
from stereovox.maps import VoxelMap
from stereovox.sources.apartment import ROOMS
from stereovox.sources.stage import Face, Stage

INSET_M = 0.15
"""So much of a wall beside a corner, the floor and the ceiling is not judged: the other wall stands there too."""
LONG_M = 2.5
"""A wall has a direction worth giving if it was measured over so many metres: one cell of 5 cm on them is 1.1 deg."""
IN_FRONT_M = 0.4
"""Occupied cells up to so far before a face are taken for its wall; behind it, up to the wall's middle."""
INNER_HALF_M, OUTER_M = 0.06, 0.25
"""Half the thickness of inner walls, behind whose middle the other room's face begins; thickness of outer ones."""


@dataclass(frozen=True, eq=False)
class RoomsFound:
    """The walls of one map, `name` in tables and pictures.

    walls: one for each face that could be measured; lengths_m: over which length each was; corners_deg: angles by name,
    `long_corners` those of them whose both walls were measured over `LONG_M` or more.
    """

    name: str
    voxel_map: VoxelMap
    walls: dict[str, WallFound]
    lengths_m: dict[str, float]
    corners_deg: dict[str, float]
    long_corners: list[str]
    missing: list[str]

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        off = {name: abs(angle - 90) for name, angle in self.corners_deg.items()}
        long = np.array([off[corner] for corner in self.long_corners] or [0.0])
        offsets = np.array([wall.offset for wall in self.walls.values()])
        straight = np.array([wall.straightness for wall in self.walls.values()])
        return {
            "name": self.name,
            "voxel_size": self.voxel_map.voxel_size,
            "frames": self.voxel_map.frames,
            "frames_refused": self.voxel_map.frames_refused,
            "walls": len(self.walls),
            "missing": self.missing,
            **thickness_figures(list(self.walls.values())),
            "straightness_median_m": float(np.median(straight)),
            "straightness_max_m": float(straight.max()),
            "offset_rms_m": float(np.sqrt(np.mean(offsets**2))),
            "corners": len(off),
            "corner_error_median_deg": float(np.median(list(off.values()) or [0.0])),
            "corner_error_max_deg": max(off.values(), default=0.0),
            "long_corners": self.long_corners,
            "long_corner_error_median_deg": float(np.median(long)),
            "long_corner_error_max_deg": float(long.max()),
            "each_wall": [wall.figures() | {"length_m": self.lengths_m[side]} for side, wall in self.walls.items()],
            "corners_deg": self.corners_deg,
        }


def measure_rooms(name: str, voxel_map: VoxelMap, stage: Stage, well_seen: Keys) -> RoomsFound:
    """Measure all sides of all rooms in a map in Chien's axes (y down).

    stage: the apartment in the map's frame; well_seen: cells that its walls touch and that were seen often enough.
    Raises StereovoxError where not one wall can be measured.
    """
    others = _other_things(stage, voxel_map.voxel_size)
    occupied = _occupied(voxel_map)
    walls: dict[str, WallFound] = {}
    missing = []
    for face in stage.faces:
        try:
            walls[face.name] = measure_face(occupied, face, well_seen, others)
        except StereovoxError:
            missing.append(face.name)
    if not walls:
        raise StereovoxError(f"{name}: not one wall stands in the map of {voxel_map.frames} frames; map more of them")
    lengths = {face.name: seen_length(face, well_seen, others, voxel_map.voxel_size) for face in stage.faces}
    corners = _corners(walls)
    long = [name for name in corners if min(lengths[wall] for wall in walls_of(name)) >= LONG_M]
    return RoomsFound(name, voxel_map, walls, lengths, corners, long, missing)


def measure_face(voxel_map: VoxelMap, face: Face, only: Keys | None = None, others: Keys | None = None) -> WallFound:
    """Measure one side of a room. Cells behind the middle of an inner wall belong to the other room's side.

    Raises StereovoxError where too little of it stands in the map.
    """
    behind = OUTER_M if _outer(face.name) else INNER_HALF_M
    return measure_wall(_only_near(voxel_map, face, behind), _inset(face), only=only, others=others, reach=IN_FRONT_M)


def seen_length(face: Face, only: Keys, others: Keys, size: float) -> float:
    """Return over how many metres from side to side a face can be judged: where it was seen and nothing stands."""
    wall = _inset(face)
    length = np.linalg.norm(wall.along, axis=1)
    units = wall.along / length[:, None]
    level = int(np.argmin(np.abs(units[:, 1])))  # y points down

    def places(cells: Keys, reach: float) -> NDArray[np.int64]:
        centre = (indices(cells) + 0.5) * size - wall.corner
        along = centre @ units.T
        near = ((along > size) & (along < length - size)).all(axis=1) & (np.abs(centre @ wall.normal) <= reach)
        return np.unique(np.floor(along[near] / size).astype(np.int64), axis=0)

    free = np.setdiff1d(keys(_flat(places(only, size))), keys(_flat(places(others, IN_FRONT_M))))
    return len(np.unique(indices(free)[:, level])) * size


def _flat(places: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.column_stack([places, np.zeros(len(places), np.int64)])


def _occupied(voxel_map: VoxelMap) -> VoxelMap:
    """Return a map of the occupied cells alone: smaller, for what looks at no others."""
    cells = np.floor(voxel_map.occupied() / voxel_map.voxel_size).astype(np.int64)
    return VoxelMap.from_cells(voxel_map.config, cells, np.full(len(cells), voxel_map.config.map.log_odds_max))


def _only_near(voxel_map: VoxelMap, face: Face, behind: float) -> VoxelMap:
    """Return a map of the cells that lie before the face, or up to `behind` metres behind it."""
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
    """Tell whether there is no other room behind a face: it stands at the apartment's rim."""
    room, _, side = name.rpartition(" ")
    index = {"west": 0, "south": 1, "east": 2, "north": 3}[side]
    rim = [limits[index] for limits in ROOMS.values()]
    return ROOMS[room][index] == (min(rim) if index < 2 else max(rim))


def _other_things(stage: Stage, size: float) -> Keys:
    """Return the cells of all that stands in the rooms: furniture and door frames."""
    others = [solid for solid in stage.scene.solids if solid.part not in ("walls", "floor", "ceiling")]
    return np.unique(keys(np.concatenate([touched_cells(solid.triangles, size) for solid in others])))


def _corners(walls: dict[str, WallFound]) -> dict[str, float]:
    """Return the angle in every corner of a room both of whose walls were measured."""
    names = [f"{room} {sides}" for room in ROOMS for sides in ("west south", "south east", "east north", "north west")]
    pairs = {name: [walls.get(wall) for wall in walls_of(name)] for name in names}
    return {name: corner_deg(one, other) for name, (one, other) in pairs.items() if one and other}


def walls_of(corner: str) -> tuple[str, str]:
    """Return the names of the two walls of a corner (`hall west south`)."""
    room, first, second = corner.rsplit(" ", 2)
    return f"{room} {first}", f"{room} {second}"
