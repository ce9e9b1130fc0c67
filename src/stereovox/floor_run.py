# SPDX-License-Identifier: Apache-2.0
"""A ground robot's recording becomes a floor's map on disk, as `run.py` makes one in space.

What `stereovox grid` does, for Python: `map_floor` in one call, `FloorRun` in steps. Whatever ends the run, the files
hold all readings up to the last checkpoint. They do not say which readings these are: `resume` goes on with the cells,
and with the readings that it is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError, did_you_mean
from stereovox.formats.map_server import MODES, read_map_server
from stereovox.frame import Frame, Scan
from stereovox.localize.robot_track import (
    Progress,
    check_start,
    fit_of,
    localise_robot,
    no_progress,
    refused_line,
    slam_robot,
)
from stereovox.localize.track import Track
from stereovox.mapper import GridMapper
from stereovox.maps.grid_map import GridMap
from stereovox.maps.lock import only_writer_of_floor
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.opening import open_robot, parse_slice
from stereovox.run import CHECKPOINT_S, Checkpoints, MapResult, Observer, add_all, interrupt_between_steps
from stereovox.safe_io import FLOOR_ENDINGS, FLOOR_READABLE, check_file
from stereovox.sources.robots.robot import Robot, in_time_order

SLAM, ODOMETRY = "slam", "odometry"


def map_floor(
    source: str | Path | Robot,
    out: str | Path,
    *,
    profile: str | Path | Config | None = None,
    poses: str | Path | None = None,
    use: str | None = None,
    frames: str | None = None,
    start: ArrayLike | None = None,
    mode: str = "trinary",
    resume: bool | str | Path = False,
    checkpoint_s: float = CHECKPOINT_S,
    observers: Sequence[Observer] = (),
    tell: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> MapResult[GridMap]:
    """Make a floor's map of a ground robot's recording, and save it while it is made, as files of map_server.

    Args:
        source: As for `open_robot` (a bag, a CARMEN log, `sim:floor`), or a robot of your own.
        out: The `.yaml`, `.pgm` or `.png` to write. An older map there stays whole until the first save.
        profile: Profile name, TOML file or Config; None: `default`.
        poses: Where the robot was: `"slam"` finds it out by itself, the `.yaml` of a map localises the robot in that
            map, `"odometry"` believes the wheels. None: the map to go on with, else SLAM, both where there is a lidar.
        use: What to map: `"depth"`, `"lidar"` or `"both"`; None: depth images if there are any.
        frames: Only these of them, as a Python slice: `"::4"`.
        start: Where the robot stood first in the map it is localised in: x, y in metres and yaw in radians; None:
            anywhere.
        mode: How the files tell probabilities: `"trinary"`, `"scale"` or `"raw"` (see `write_map_server`).
        resume: Go on with the cells of the map at `out` (True), or of the one whose `.yaml` this is. All readings
            that `frames` picks are added: the files do not say which were in it.
        checkpoint_s: Seconds from one save to the next; 0: only at the end.
        observers: What is to see each reading.
        tell: Takes lines that a user should see: what had to be assumed, how well the scans fit the map.
        **overrides: Settings by name, as for `GridMapper`.

    Returns:
        The map, the robot's way in it, and what became of each reading.

    Raises:
        StereovoxError: One line, where recording, settings or place are wrong, another run writes there, the disk is
            full or not one reading could be used.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, between two readings; what is there is saved.
    """
    with FloorRun(
        source, out, profile=profile, poses=poses, use=use, frames=frames, start=start, mode=mode, resume=resume,
        checkpoint_s=checkpoint_s, tell=tell, **overrides,
    ) as run:  # fmt: skip
        return run.finish(observers)


class FloorRun:
    """`map_floor` in steps: entered, all is open and checked; `find_way` finds where the robot was; `finish` maps.

    While it is open nobody else can write at `out`. Arguments as of `map_floor`.

    Attributes:
        robot: The recording.
        mapper: Makes the map.
        left: How many readings are to be mapped.
    """

    robot: Robot
    mapper: GridMapper
    left: int

    def __init__(
        self,
        source: str | Path | Robot,
        out: str | Path,
        *,
        profile: str | Path | Config | None = None,
        poses: str | Path | None = None,
        use: str | None = None,
        frames: str | None = None,
        start: ArrayLike | None = None,
        mode: str = "trinary",
        resume: bool | str | Path = False,
        checkpoint_s: float = CHECKPOINT_S,
        tell: Callable[[str], None] = lambda line: None,
        **overrides: Any,
    ):
        self.out = Path(out)
        self._where, self._profile, self._overrides = source, profile, overrides
        self._poses, self._use, self._frames, self._mode = None if poses is None else str(poses), use, frames, mode
        self._start = None if start is None else np.asarray(start, float)
        self._before = (self.out if resume is True else Path(resume)) if resume else None
        self._checkpoint_s, self._tell, self._open = checkpoint_s, tell, ExitStack()

    def __enter__(self) -> FloorRun:
        check_file(self.out, FLOOR_ENDINGS)
        if self._mode not in MODES:
            raise StereovoxError(f"{self.out}: no mode '{self._mode}'{did_you_mean(self._mode, MODES)}")
        if self._mode == "scale" and self.out.suffix.lower() == ".pgm":
            raise StereovoxError(f"{self.out}: mode scale has no grey for unknown cells; name a .yaml or .png")
        if self._before == self.out and not self.out.exists():
            raise StereovoxError(f"{self.out}: no map to go on with; start it without resume")
        with ExitStack() as stack:
            stack.enter_context(only_writer_of_floor(self.out))
            self.config = load_config(self._profile or "default", **self._overrides)
            self.robot = self._opened()
            self._seen, self.left = self._chosen()
            self._how, self._floor = self._where_to_look()
            self.mapper = self._mapper()
            self._checkpoints = Checkpoints(
                lambda: self.mapper.save(self.out, self._mode), self.out, self._checkpoint_s
            )
            self._track: Track | None = None
            self._open = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.close()

    def find_way(self, progress: Progress = no_progress) -> Track | None:
        """Return the robot's way in the map, found once; None: as its odometry has it. Raises as `map_floor`.

        Args:
            progress: Called with scans done, scans in all, and what is being done.
        """
        if self._track is None and self._how != ODOMETRY:
            self._track = self._slam(progress) if self._floor is None else self._localised(self._floor, progress)
        return self._track

    def finish(self, observers: Sequence[Observer] = ()) -> MapResult[GridMap]:
        """Add all readings, and save the map. Raises as `map_floor`."""
        track = self.find_way()
        readings = (track.corrected(one) if track else one for one in self._seen)
        with interrupt_between_steps() as check:
            reports = add_all(self.mapper, readings, self._checkpoints, check, observers, self._stopped)
            if not self.mapper.map.frames:
                raise StereovoxError(f"not one reading could be used, no map is written ({reports[0].detail})")
            self._checkpoints.save(len(reports))
        return MapResult(self.mapper.map, self.out, reports, track=track)

    def _stopped(self, done: int) -> None:
        self._tell(f"stopped after {done} of {self.left} readings; they are saved in {self.out.with_suffix('.yaml')}")

    def _opened(self) -> Robot:
        robot = open_robot(self._where) if isinstance(self._where, str | Path) else self._where
        for note in robot.notes:
            self._tell(f"note: {note}")
        return robot

    def _chosen(self) -> tuple[Iterator[Scan | Frame], int]:
        """Return what is to be mapped in order of time, and how much that is."""
        robot = self.robot
        use = self._use or ("depth" if len(robot.frames) else "lidar")
        kinds: dict[str, Sequence[Any]] = {"depth": robot.frames, "lidar": robot.scans}
        if use not in (*kinds, "both"):
            raise StereovoxError(f"use '{use}': give depth, lidar or both")
        wanted = {name: kinds[name] for name in (kinds if use == "both" else (use,))}
        missing = [name for name, there in wanted.items() if not len(there)]
        if missing:
            what, other = {"depth": ("depth images", "lidar"), "lidar": ("lidar scans", "depth")}[missing[0]]
            raise StereovoxError(f"{robot.name}: holds no {what}; use {other}")
        picked = {name: range(len(there))[parse_slice(self._frames or ":")] for name, there in wanted.items()}
        if not all(picked.values()):
            raise StereovoxError(f"frames '{self._frames}' picks none of {robot.name}; widen it")
        streams = [map(wanted[name].__getitem__, numbers) for name, numbers in picked.items()]
        return in_time_order(*streams), sum(map(len, picked.values()))

    def _where_to_look(self) -> tuple[str, OccupancyGrid | None]:
        """Return whose poses to take: `slam`, `odometry`, or the file of a map and that map."""
        how = self._poses
        if how == SLAM and self._before:
            raise StereovoxError(
                f"{self._before}: SLAM makes a frame of its own; to go on, leave poses out: the robot is localised in "
                "the map"
            )
        if how is None:
            how = str(self._before or SLAM) if len(self.robot.scans) else ODOMETRY
        if how in (SLAM, ODOMETRY):
            if self._start is not None:
                raise StereovoxError(f"poses {how}: start says where in a map; give the map's .yaml, or no start")
            return how, None
        if Path(how).suffix.lower() not in FLOOR_READABLE:
            raise StereovoxError(f"poses {how}: give slam, odometry, or the .yaml of a map to localise in")
        floor = read_map_server(how)
        check_start(self._start, floor)
        return how, floor

    def _mapper(self) -> GridMapper:
        if self._before is None:
            return GridMapper(self.config)
        before = read_map_server(self._before)
        size = self._overrides.get("voxel_size", before.resolution)
        return GridMapper(self.config, voxel_size=size, resume=before)

    def _slam(self, progress: Progress) -> Track:
        self._tell("finding the robot's way by SLAM; poses could also be localised in a map, or the odometry's own")
        found = slam_robot(self.robot, self.config, progress)
        self._say(refused_line(found.refused))
        return found.track

    def _localised(self, floor: OccupancyGrid, progress: Progress) -> Track:
        self._tell(f"finding the robot's way in {self._how}")
        track = localise_robot(self.robot, floor, self.config, self._start, progress)
        self._say(refused_line(track.refused, track.first_refusal))
        self._say(fit_of(self.robot, floor, track)[1])
        return track

    def _say(self, line: str) -> None:
        if line:
            self._tell(line)
