# SPDX-License-Identifier: Apache-2.0
"""Map a ground robot's recording to a 2-D floor map on disk, as `run.py` does for 3-D maps.

The Python side of `stereovox grid`: `map_floor` does it in one call, `FloorRun` in steps. However the run ends, the
files hold all readings up to the last checkpoint. They do not record which readings: `resume` continues with the saved
cells and adds the readings it is given.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config, load_config
from stereovox.errors import MissingExtra, StereovoxError, did_you_mean
from stereovox.files.safe_io import FLOOR_ENDINGS, FLOOR_READABLE, check_file
from stereovox.formats.map_server import MODES, read_map_server
from stereovox.frame import Frame, Scan
from stereovox.localize.robot_track import (
    Progress,
    check_start,
    doubt_lines,
    fit_of,
    localise_robot,
    no_progress,
    refused_line,
    slam_robot,
)
from stereovox.localize.slam.doubts import MapDoubt
from stereovox.localize.track import Track
from stereovox.mapper import GridMapper
from stereovox.maps.files.lock import only_writer_of_floor
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.opening import open_robot, parse_slice
from stereovox.runs.pose_choice import NOT_COMPARED, uncompared
from stereovox.runs.recording import (
    CHECKPOINT_S,
    Checkpoints,
    MapResult,
    Observer,
    add_all,
    first_refusal,
    interrupt_between_steps,
)
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
    notify: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> MapResult[GridMap]:
    """Map a ground robot's recording to a 2-D floor map, saved at regular checkpoints as map_server files.

    Args:
        source: As for `open_robot` (a bag, a CARMEN log, `sim:floor`), or a `Robot` of your own.
        out: The `.yaml`, `.pgm` or `.png` to write. An older map there stays whole until the first save.
        profile: Profile name, TOML file or Config; None: `default`.
        poses: Source of the robot's poses: `"slam"`, `"odometry"`, or the `.yaml` of a map to localise the robot in.
            None: with a lidar, the map to resume, else SLAM; without one, odometry.
        use: What to map: `"depth"`, `"lidar"` or `"both"`; None: depth images if there are any, else lidar.
        frames: Python slice that selects readings: `"::4"`.
        start: The robot's first pose in the map it is localised in: x, y in metres and yaw in radians; None: unknown.
        mode: How the files store probabilities: `"trinary"`, `"scale"` or `"raw"` (see `write_map_server`).
        resume: Continue with the cells of the map at `out` (True), or of the map whose `.yaml` this is. All readings
            that `frames` selects are added: the files do not record which ones the map already holds.
        checkpoint_s: Seconds between two saves; 0: save only at the end.
        observers: Called after each reading.
        notify: Called with each line that a user should see: assumptions about the recording, how well scans fit the
            map.
        **overrides: Settings by name, as for `GridMapper`.

    Returns:
        The map, the robot's trajectory in it, and the report of each reading.

    Raises:
        StereovoxError: One line: invalid recording, settings or output file, another run writes there, the disk is
            full, or no reading could be used.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two readings after saving the map.
    """
    with FloorRun(
        source, out, profile=profile, poses=poses, use=use, frames=frames, start=start, mode=mode, resume=resume,
        checkpoint_s=checkpoint_s, notify=notify, **overrides,
    ) as run:  # fmt: skip
        return run.finish(observers)


class FloorRun:
    """`map_floor` in steps: entering opens and checks everything, `find_track` finds the poses, `finish` maps.

    While it is open, no other run can write to `out`.

    Args:
        source: As for `map_floor`, like all other arguments.

    Attributes:
        robot: The recording, once entered.
        mapper: The mapper, once entered.
        remaining: Number of readings to map, once entered.
        config: All settings, once entered.
        out: File of the map.

    Raises:
        StereovoxError: On entering: invalid recording, settings or output file, or another run writes there.
    """

    robot: Robot
    mapper: GridMapper
    remaining: int

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
        notify: Callable[[str], None] = lambda line: None,
        **overrides: Any,
    ):
        self.out = Path(out)
        self._source, self._profile, self._overrides = source, profile, overrides
        self._poses, self._use, self._frames, self._mode = None if poses is None else str(poses), use, frames, mode
        self._start = None if start is None else _pose_of(start)
        self._resumed = (self.out if resume is True else Path(resume)) if resume else None
        self._checkpoint_s, self._notify, self._open = checkpoint_s, notify, ExitStack()

    def __enter__(self) -> FloorRun:
        check_file(self.out, FLOOR_ENDINGS)
        if self._mode not in MODES:
            raise StereovoxError(f"{self.out}: no mode '{self._mode}'{did_you_mean(self._mode, MODES)}")
        if self._mode == "scale" and self.out.suffix.lower() == ".pgm":
            raise StereovoxError(f"{self.out}: mode scale has no grey for unknown cells; name a .yaml or .png")
        if self._resumed == self.out and not self.out.exists():
            raise StereovoxError(f"{self.out}: no map to go on with; start it without resume")
        with ExitStack() as stack:
            stack.enter_context(only_writer_of_floor(self.out))
            self.config = load_config(self._profile or "default", **self._overrides)
            self.robot = self._open_robot()
            self._readings, self.remaining = self._select_readings()
            self._poses_from, self._floor = self._pose_source()
            self.mapper = self._make_mapper()
            self._checkpoints = Checkpoints(
                lambda: self.mapper.save(self.out, self._mode), self.out, self._checkpoint_s
            )
            self._track: Track | None = None
            self._doubts: list[MapDoubt] = []
            self._open = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.close()

    def find_track(self, progress: Progress = no_progress) -> Track | None:
        """Find the robot's trajectory by SLAM or localisation, once; later calls return the same.

        Args:
            progress: Called with the number of scans done, their total, and the current step in words.

        Returns:
            The trajectory in the map; None: the odometry's poses are used.

        Raises:
            StereovoxError: SLAM or localisation failed.
        """
        if self._track is None and self._poses_from != ODOMETRY:
            self._track = self._slam(progress) if self._floor is None else self._localise(self._floor, progress)
        return self._track

    def finish(self, observers: Sequence[Observer] = ()) -> MapResult[GridMap]:
        """Map all readings and save the map; finds the trajectory first where that was not done.

        Args:
            observers: Called after each reading.

        Returns:
            The map, the robot's trajectory in it, and the report of each reading.

        Raises:
            StereovoxError: SLAM or localisation failed, the disk is full, or no reading could be used.
            KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two readings after saving the map.
        """
        track = self.find_track()
        readings = (track.corrected(one) if track else one for one in self._readings)
        with interrupt_between_steps() as check:
            reports = add_all(self.mapper, readings, self._checkpoints, check, observers, self._stopped)
            if not self.mapper.map.frames:
                raise StereovoxError(f"not one reading could be used, no map is written ({first_refusal(reports)})")
            self._checkpoints.save(len(reports))
        return MapResult(self.mapper.map, self.out, reports, track=track, doubts=self._doubts)

    def _stopped(self, done: int) -> None:
        saved = f"they are saved in {self.out.with_suffix('.yaml')}"
        self._notify(f"stopped after {done} of {self.remaining} readings; {saved}")

    def _open_robot(self) -> Robot:
        robot = open_robot(self._source) if isinstance(self._source, str | Path) else self._source
        for note in robot.notes:
            self._notify(f"note: {note}")
        return robot

    def _select_readings(self) -> tuple[Iterator[Scan | Frame], int]:
        """Return the readings to map, in order of time, and their number."""
        robot = self.robot
        use = self._use or ("depth" if len(robot.frames) else "lidar")
        kinds: dict[str, Sequence[Any]] = {"depth": robot.frames, "lidar": robot.scans}
        if use not in (*kinds, "both"):
            raise StereovoxError(f"use '{use}': give depth, lidar or both")
        selected = {name: kinds[name] for name in (kinds if use == "both" else (use,))}
        missing = [name for name, readings in selected.items() if not len(readings)]
        if missing:
            what, other = {"depth": ("depth images", "lidar"), "lidar": ("lidar scans", "depth")}[missing[0]]
            raise StereovoxError(f"{robot.name}: holds no {what}; use {other}")
        picked = {name: range(len(readings))[parse_slice(self._frames or ":")] for name, readings in selected.items()}
        if not all(picked.values()):
            raise StereovoxError(f"frames '{self._frames}' selects none of {robot.name}; widen it")
        streams = [map(selected[name].__getitem__, numbers) for name, numbers in picked.items()]
        return in_time_order(*streams), sum(map(len, picked.values()))

    def _pose_source(self) -> tuple[str, OccupancyGrid | None]:
        """Return the source of poses: `slam`, `odometry`, or the file of a map and that map."""
        how = self._poses
        if how == SLAM and self._resumed:
            raise StereovoxError(
                f"{self._resumed}: SLAM makes a frame of its own; to go on, leave poses out: the robot is localised in "
                "the map"
            )
        if how is None:
            how = str(self._resumed or SLAM) if len(self.robot.scans) else ODOMETRY
        if how in (SLAM, ODOMETRY):
            if self._start is not None:
                raise StereovoxError(f"poses {how}: start says where in a map; give the map's .yaml, or no start")
            return how, None
        if Path(how).suffix.lower() not in FLOOR_READABLE:
            raise StereovoxError(f"poses {how}: give slam, odometry, or the .yaml of a map to localise in")
        floor = read_map_server(how)
        check_start(self._start, floor)
        return how, floor

    def _make_mapper(self) -> GridMapper:
        drifts = self._poses_from == ODOMETRY
        if drifts or (self._floor is not None and self._resumed is None):
            config, before = uncompared(self.config), self.config
            why = "poses of odometry drift" if drifts else "poses in a map are off by more than a cell at times"
            self._notify_unless_empty("" if config is before else f"note: {NOT_COMPARED.format(why=why)}")
            self.config = config
        if self._resumed is None:
            return GridMapper(self.config)
        before = self._floor
        if before is None or Path(self._poses_from) != self._resumed:
            before = read_map_server(self._resumed)
        size = self._overrides.get("voxel_size", before.resolution)
        return GridMapper(self.config, voxel_size=size, resume=before)

    def _slam(self, progress: Progress) -> Track:
        others = "others: poses (--poses) MAP.yaml to localise in a map, or odometry"
        self._notify(f"finding the robot's trajectory by SLAM; {others}")
        try:
            found = slam_robot(self.robot, self.config, progress)
        except MissingExtra as missing:
            raise StereovoxError(f"{missing}; or go on without SLAM: poses odometry (--poses odometry)") from None
        self._notify_unless_empty(refused_line(found.refused))
        for line in doubt_lines(found.doubts):
            self._notify(line)
        self._doubts = found.doubts
        return found.track

    def _localise(self, floor: OccupancyGrid, progress: Progress) -> Track:
        self._notify(f"localising the robot in {self._poses_from}")
        track = localise_robot(self.robot, floor, self.config, self._start, progress)
        self._notify_unless_empty(refused_line(track.refused, track.first_refusal))
        self._notify_unless_empty(fit_of(self.robot, floor, track)[1])
        return track

    def _notify_unless_empty(self, line: str) -> None:
        if line:
            self._notify(line)


def _pose_of(start: ArrayLike) -> NDArray[np.float64]:
    """Return x, y and yaw as an array. Raises StereovoxError for what is not numbers."""
    try:
        return np.asarray(start, float)
    except (TypeError, ValueError):
        raise StereovoxError(f"start {start!r}: give x, y in metres and the yaw, three finite numbers") from None
