# SPDX-License-Identifier: Apache-2.0
"""An apartment scanned by hand (Chien 2020, 4.4.2.1): do its walls stand straight, square and thin in the map?"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.evaluate.cells import Keys, indices, keys
from stereovox.evaluate.sightings import Sightings
from stereovox.evaluate.truth import touched_cells
from stereovox.evaluate.walls import Wall, WallFound, corner_deg, measure_wall, thickness_figures
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.sources.apartment import ROOMS
from stereovox.sources.pair import CameraPair
from stereovox.sources.recorder import MOUNT, Recording, record
from stereovox.sources.simulation import Simulation
from stereovox.sources.stage import Face, Stage
from stereovox.sources.t265 import T265

SEEN_FRAMES = 10
"""A wall is judged where so many frames saw it, of those of a whole scan (902)."""
INSET_M = 0.15
"""So much of a wall beside a corner, the floor and the ceiling is not judged: the other wall stands there too."""
LONG_M = 2.0
"""A wall has a direction worth giving if it was measured over so many metres: one cell of 5 cm on them is 1.4 deg."""
IN_FRONT_M = 0.4
"""Occupied cells up to so far before a face are taken for its wall; behind it, up to the wall's middle."""
INNER_HALF_M, OUTER_M = 0.06, 0.25
"""Half the thickness of inner walls, behind whose middle the other room's face begins; thickness of outer ones."""
BATCH = 16
THINNED = 2
"""Only every so many pixels, across and down, are asked what they see of a wall: it is the wall's cells that count."""


@dataclass(frozen=True)
class Scan:
    """One way to map the apartment. poses: `T265` (drifting, as the camera pair reports them) or `exact`."""

    profile: str
    poses: str
    settings: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """Its name in tables and pictures."""
        return f"{self.profile}, {'T265 model' if self.poses == 'T265' else 'exact poses'}"

    def config(self) -> Config:
        """Return its settings; the window is left out, so that the whole apartment can be shown."""
        return load_config(self.profile, **{"window.size": None, "up": "-y", **dict(self.settings)})


SCANS = (
    Scan("chien2020", "T265"),
    Scan("chien2020", "exact"),
    Scan("default", "T265", (("voxel_size", 0.05),)),
    Scan("default", "exact", (("voxel_size", 0.05),)),
)


@dataclass(frozen=True, eq=False)
class ScanFound:
    """The walls of one map.

    walls: one for each face that could be measured; lengths_m: over which length each was; corners_deg: angles by name,
    `long_corners` those of them whose both walls were measured over `LONG_M` or more.
    """

    scan: Scan
    voxel_map: VoxelMap
    walls: dict[str, WallFound]
    lengths_m: dict[str, float]
    corners_deg: dict[str, float]
    long_corners: list[str]
    missing: list[str]

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        angles = np.array([self.corners_deg[name] for name in self.long_corners])
        offsets = np.array([wall.offset for wall in self.walls.values()])
        straight = np.array([wall.straightness for wall in self.walls.values()])
        return {
            "name": self.scan.name,
            "voxel_size": self.voxel_map.voxel_size,
            "frames": self.voxel_map.frames,
            "frames_refused": self.voxel_map.frames_refused,
            "walls": len(self.walls),
            "missing": self.missing,
            **thickness_figures(list(self.walls.values())),
            "straightness_median_m": float(np.median(straight)),
            "straightness_max_m": float(straight.max()),
            "offset_rms_m": float(np.sqrt(np.mean(offsets**2))),
            "corners": len(angles),
            "corner_error_median_deg": float(np.median(np.abs(angles - 90))),
            "corner_error_max_deg": float(np.abs(angles - 90).max()),
            "corners_within_1_deg": float((np.abs(angles - 90) <= 1).mean()),
            "each_wall": [wall.figures() | {"length_m": self.lengths_m[name]} for name, wall in self.walls.items()],
            "corners_deg": self.corners_deg,
        }


@dataclass(frozen=True, eq=False)
class Apartment:
    """All scans, the true apartment in their frame, and how far the tracker was off.

    way: true positions of the camera (N, 3); reported: what the tracker made of them, NaN where it was refused.
    """

    scans: list[ScanFound]
    stage: Stage
    way: NDArray[np.float64]
    reported: NDArray[np.float64]

    @property
    def drift_m(self) -> NDArray[np.float64]:
        """How far (N,) the tracker was off in metres."""
        return np.linalg.norm(self.reported - self.way, axis=1)


def scan_apartment(
    *,
    every: int = 1,
    scans: Sequence[Scan] = SCANS,
    tracker: T265 | None = None,
    location: str = "sim:apartment",
    step: Callable[[], None] = lambda: None,
) -> Apartment:
    """Walk through the apartment once and map the same images in every way.

    every: only each so many-th of the 902 images, 15 a second, is mapped. step: called after each.
    """
    simulation = Simulation(location)
    chosen = range(0, len(simulation), every)
    with tempfile.TemporaryDirectory(prefix="stereovox-reproduce-") as folder:
        recording, pair = _recorded(simulation, tracker or T265(), Path(folder) / "pair")
        mappers = [Mapper(scan.config()) for scan in scans]
        stage = simulation.stage.moved(recording.T_map_world)
        sightings = {size: _wall_sightings(stage, size) for size in {mapper.map.voxel_size for mapper in mappers}}
        way, reported = [], []
        for i, depth, frame in _images(simulation, chosen):
            exact = replace(frame, T_world_sensor=recording.T_map_world @ frame.T_world_sensor)
            tracked = _tracked(pair, i, exact)
            for scan, mapper in zip(scans, mappers, strict=True):
                mapper.add(tracked if scan.poses == "T265" else exact)
            _look(sightings, depth, exact)
            way.append(exact.T_world_sensor[:3, 3])
            reported.append(tracked.T_world_sensor[:3, 3])
            step()
    needed = max(2, round(SEEN_FRAMES / every))
    found = [_measure(scan, mapper.map, stage, sightings[mapper.map.voxel_size], needed)
             for scan, mapper in zip(scans, mappers, strict=True)]  # fmt: skip
    return Apartment(found, stage, np.array(way), np.array(reported))


def _recorded(simulation: Simulation, tracker: T265, folder: Path) -> tuple[Recording, CameraPair]:
    """Record the tracker beside tiny images: the pair tells where the large ones were taken."""
    tiny = Simulation(f"{simulation.name}{'&' if '?' in simulation.name else '?'}image_width=16", noise=False)
    recording = record(tiny, folder, tracker, MOUNT)
    return recording, CameraPair(folder)


def _tracked(pair: CameraPair, i: int, exact: Frame) -> Frame:
    """Return the frame with the pose that the pair has for image `i`, or with the fault that forbids it."""
    stamp_ns = pair.frame(i).stamp_ns
    try:
        return replace(exact, T_world_sensor=pair.pose_at(stamp_ns))
    except FrameRefused as refused:
        return replace(exact, T_world_sensor=np.full((4, 4), np.nan), fault=refused.reason, fault_detail=str(refused))


def _images(simulation: Simulation, chosen: Sequence[int]) -> Iterator[tuple[int, NDArray[np.float32], Frame]]:
    """Yield number, exact depth and frame in order; two threads simulate a batch."""

    def simulate(i: int) -> tuple[int, NDArray[np.float32], Frame]:
        depth = simulation.true_depth(i)
        return i, depth, simulation.observe(i, depth)

    with ThreadPoolExecutor(2) as threads:
        for start in range(0, len(chosen), BATCH):
            yield from list(threads.map(simulate, chosen[start : start + BATCH]))


def _wall_sightings(stage: Stage, size: float) -> Sightings:
    walls = [touched_cells(solid.triangles, size) for solid in stage.scene.part("walls")]
    return Sightings(np.unique(keys(np.concatenate(walls))), size)


def _look(sightings: dict[float, Sightings], depth_m: NDArray[np.float32], frame: Frame) -> None:
    thinned, n = depth_m[::THINNED, ::THINNED], THINNED
    camera = frame.camera
    smaller = replace(camera, width=thinned.shape[1], height=thinned.shape[0],
                      fx=camera.fx / n, fy=camera.fy / n, cx=camera.cx / n, cy=camera.cy / n)  # fmt: skip
    for one in sightings.values():
        one.add(thinned, smaller, frame.T_world_sensor)


def _measure(scan: Scan, voxel_map: VoxelMap, stage: Stage, seen: Sightings, needed: int) -> ScanFound:
    well_seen = seen.cells[seen.frames >= needed]
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
        raise StereovoxError(
            f"{scan.name}: not one wall stands in the map of {voxel_map.frames} frames; map more of them"
        )
    lengths = {face.name: seen_length(face, well_seen, others, voxel_map.voxel_size) for face in stage.faces}
    corners = _corners(walls)
    long = [name for name in corners if min(lengths[wall] for wall in _walls_of(name)) >= LONG_M]
    return ScanFound(scan, voxel_map, walls, lengths, corners, long, missing)


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
    indices, log_odds = voxel_map.cells()
    height = (voxel_map.centers(indices) - face.corners[0]) @ face.normal
    kept = (height >= -behind) & (height <= IN_FRONT_M)
    return VoxelMap.from_cells(voxel_map.config, indices[kept], log_odds[kept])


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
    pairs = {name: [walls.get(wall) for wall in _walls_of(name)] for name in names}
    return {name: corner_deg(one, other) for name, (one, other) in pairs.items() if one and other}


def _walls_of(corner: str) -> tuple[str, str]:
    room, first, second = corner.rsplit(" ", 2)
    return f"{room} {first}", f"{room} {second}"
