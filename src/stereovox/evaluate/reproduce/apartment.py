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

from stereovox.cameras import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused
from stereovox.evaluate.cells import keys
from stereovox.evaluate.reproduce.rooms import RoomsFound, measure_rooms
from stereovox.evaluate.sightings import Sightings
from stereovox.evaluate.truth import touched_cells
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.sources import open_depth
from stereovox.sources.pair import CameraPair
from stereovox.sources.recorder import MOUNT, Recording, record
from stereovox.sources.simulation import Simulation
from stereovox.sources.stage import Stage
from stereovox.sources.t265 import T265

SEEN_FRAMES = 10
"""A wall is judged where so many frames saw it, of those of a whole scan (902)."""
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
class Apartment:
    """All scans, the true apartment in their frame, and how far the tracker was off.

    way: true positions of the camera (N, 3); reported: what the tracker made of them, NaN where it was refused.
    """

    scans: list[RoomsFound]
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
    well_seen = {size: one.cells[one.frames >= needed] for size, one in sightings.items()}
    made = [(scan.name, mapper.map) for scan, mapper in zip(scans, mappers, strict=True)]
    found = [measure_rooms(name, one, stage, well_seen[one.voxel_size]) for name, one in made]
    return Apartment(found, stage, np.array(way), np.array(reported))


def _recorded(simulation: Simulation, tracker: T265, folder: Path) -> tuple[Recording, CameraPair]:
    """Record the tracker beside tiny images: the pair tells where the large ones were taken."""
    tiny = Simulation(f"{simulation.name}{'&' if '?' in simulation.name else '?'}image_width=16", noise=False)
    recording = record(tiny, folder, tracker, MOUNT)
    return recording, CameraPair(folder, open_depth)


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
    assert isinstance(camera, PinholeCamera)  # what the simulation has
    smaller = replace(camera, width=thinned.shape[1], height=thinned.shape[0],
                      fx=camera.fx / n, fy=camera.fy / n, cx=camera.cx / n, cy=camera.cy / n)  # fmt: skip
    for one in sightings.values():
        one.add(thinned, smaller, frame.T_world_sensor)
