# SPDX-License-Identifier: Apache-2.0
"""Map a ground robot's recording to a 2-D floor map on disk, as `recording.py` does for 3-D maps.

The Python side of `stereovox grid`: `map_floor` does it in one call, `FloorRun` in steps. However the run ends, the
files hold all readings up to the last checkpoint, but do not record which ones: `resume` continues with the saved
cells and adds the readings it is given.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import load_config
from stereovox.errors import MissingExtra, StereovoxError, did_you_mean
from stereovox.files.safe_io import FLOOR_ENDINGS, FLOOR_READABLE, check_file
from stereovox.formats.map_server import MODES, read_map_server
from stereovox.frame import Frame, Progress, Scan, no_progress
from stereovox.localize.robot_track import check_start, doubt_lines, fit_of, localise_robot, refused_line, slam_robot
from stereovox.localize.slam.graph import MapDoubt
from stereovox.localize.track import Track
from stereovox.mapper import GridMapper
from stereovox.maps.files.lock import only_writer_of_floor
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.opening import open_robot, parse_slice
from stereovox.runs.engine import Checkpoints, MapOptions, MapperRun, Observer, takes
from stereovox.runs.pose_choice import NOT_COMPARED, uncompared
from stereovox.runs.recording import MapResult
from stereovox.sources.robots.robot import Robot, in_time_order

SLAM, ODOMETRY = "slam", "odometry"


@dataclass(frozen=True, kw_only=True)
class FloorOptions(MapOptions):
    """Options of `map_floor`, in addition to `MapOptions`.

    Attributes:
        poses: Source of the robot's poses: `"slam"`, `"odometry"`, or the `.yaml` of a map to localise the robot in.
            None: with a lidar, the map to resume or SLAM; without one, odometry.
        use: What to map: `"depth"`, `"lidar"` or `"both"`; None: depth images if there are any, else lidar.
        frames: Python slice that selects readings: `"::4"`.
        start: The robot's first pose in the map of `poses`: x, y in metres and yaw in radians; None: unknown.
        mode: How the files store probabilities: `"trinary"`, `"scale"` or `"raw"` (see `write_map_server`).
        resume: Continue with the cells of the map at `out` (True), or of the map whose `.yaml` this is. All readings
            that `frames` selects are added: the files do not record which ones the map already holds.
    """

    poses: str | Path | None = None
    use: str | None = None
    frames: str | None = None
    start: ArrayLike | None = None
    mode: str = "trinary"
    resume: bool | str | Path = False


@takes(FloorOptions)
def map_floor(
    source: str | Path | Robot, out: str | Path, *, observers: Sequence[Observer] = (), **options: Any
) -> MapResult[GridMap]:
    """Map a ground robot's recording to a 2-D floor map, saved at regular checkpoints as map_server files.

    Args:
        source: As for `open_robot` (a bag, a CARMEN log, `sim:floor`), or a `Robot` of your own.
        out: The `.yaml`, `.pgm` or `.png` to write. An older map there stays whole until the first save.
        observers: Called after each reading.
        **options: Fields of `FloorOptions`, and settings by name, as for `GridMapper`.

    Returns:
        The map, the robot's trajectory in it, and the report of each reading.

    Raises:
        StereovoxError: One line: invalid recording, settings or output file, another run writes there, the disk is
            full, or no reading could be used.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two readings after saving the map.
    """
    with FloorRun(source, out, **options) as run:
        return run.finish(observers)


class FloorRun(MapperRun[Scan | Frame, MapResult[GridMap]]):
    """`map_floor` in steps: entering opens and checks everything, `find_track` finds the poses, `finish` maps.

    While it is open, no other run can write to `out`. `finish` finds the trajectory first if that was not done.

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

    @takes(FloorOptions)
    def __init__(self, source: str | Path | Robot, out: str | Path, **options: Any):
        self._options = chosen = FloorOptions.of(options)
        super().__init__(chosen.notify)
        self.out, self._source = Path(out), source
        self._start = None if chosen.start is None else _pose_of(chosen.start)
        self._resumed = (self.out if chosen.resume is True else Path(chosen.resume)) if chosen.resume else None
        self._track: Track | None = None
        self._doubts: list[MapDoubt] = []

    def _begin(self, stack: ExitStack) -> None:
        mode = self._options.mode
        check_file(self.out, FLOOR_ENDINGS)
        if mode not in MODES:
            raise StereovoxError(f"{self.out}: no mode '{mode}'{did_you_mean(mode, MODES)}")
        if mode == "scale" and self.out.suffix.lower() == ".pgm":
            raise StereovoxError(f"{self.out}: mode scale has no grey for unknown cells; name a .yaml or .png")
        if self._resumed == self.out and not self.out.exists():
            raise StereovoxError(f"{self.out}: no map to continue; start without resume")
        stack.enter_context(only_writer_of_floor(self.out))
        self.config = load_config(self._options.profile or "default", **self._options.settings)
        self.robot = self._open_robot()
        self._readings, self.remaining = self._select_readings()
        self._poses_from, self._floor = self._pose_source()
        self.mapper = self._make_mapper()
        self._checkpoints = Checkpoints(lambda: self.mapper.save(self.out, mode), self.out, self._options.checkpoint_s)

    def find_track(self, progress: Progress = no_progress) -> Track | None:
        """Find the robot's trajectory by SLAM or localisation, once; later calls return the same.

        Args:
            progress: Called with the number of scans done, their total, and the current step in words.

        Returns:
            The trajectory in the map; None if the poses are odometry's.

        Raises:
            StereovoxError: SLAM or localisation failed.
        """
        if self._track is None and self._poses_from != ODOMETRY:
            self._track = self._slam(progress) if self._floor is None else self._localise(self._floor, progress)
        return self._track

    def _prepare_steps(self) -> None:
        self.find_track()

    def _steps(self) -> Iterable[Scan | Frame]:
        track = self._track
        return (track.corrected(one) if track else one for one in self._readings)

    def _stopped_line(self) -> str:
        saved = f"saved in {self.out.with_suffix('.yaml')}"
        return f"stopped after {len(self.reports)} of {self.remaining} readings; {saved}"

    def _end(self) -> MapResult[GridMap]:
        if not self.mapper.map.frames:
            why = self._first_refusal() or "the source is empty"
            raise StereovoxError(f"not one reading could be used, so no map is written ({why})")
        self._checkpoints.save(self._kept)
        return MapResult(self.mapper.map, self.out, self.reports, track=self._track, doubts=self._doubts)

    def _open_robot(self) -> Robot:
        robot = open_robot(self._source) if isinstance(self._source, str | Path) else self._source
        for note in robot.notes:
            self._notify(f"note: {note}")
        return robot

    def _select_readings(self) -> tuple[Iterator[Scan | Frame], int]:
        """Return the readings to map, in time order, and their number."""
        robot = self.robot
        use = self._options.use or ("depth" if len(robot.frames) else "lidar")
        frames = self._options.frames
        kinds: dict[str, Sequence[Any]] = {"depth": robot.frames, "lidar": robot.scans}
        if use not in (*kinds, "both"):
            raise StereovoxError(f"use '{use}': give depth, lidar or both")
        selected = {name: kinds[name] for name in (kinds if use == "both" else (use,))}
        missing = [name for name, readings in selected.items() if not len(readings)]
        if missing:
            what, other = {"depth": ("depth images", "lidar"), "lidar": ("lidar scans", "depth")}[missing[0]]
            raise StereovoxError(f"{robot.name}: holds no {what}; use {other}")
        picked = {name: range(len(readings))[parse_slice(frames or ":")] for name, readings in selected.items()}
        if not all(picked.values()):
            raise StereovoxError(f"frames '{frames}' selects none of {robot.name}; widen it")
        streams = [map(selected[name].__getitem__, numbers) for name, numbers in picked.items()]
        return in_time_order(*streams), sum(map(len, picked.values()))

    def _pose_source(self) -> tuple[str, OccupancyGrid | None]:
        """Return the source of poses: `slam`, `odometry`, or the file of a map; and that map."""
        how = None if self._options.poses is None else str(self._options.poses)
        if how == SLAM and self._resumed:
            raise StereovoxError(
                f"{self._resumed}: SLAM starts a new frame; to continue the map, leave poses out: the robot is then "
                "localised in it"
            )
        if how is None:
            how = str(self._resumed or SLAM) if len(self.robot.scans) else ODOMETRY
        if how in (SLAM, ODOMETRY):
            if self._start is not None:
                raise StereovoxError(f"poses {how}: start is a pose in a map; give the map's .yaml, or no start")
            return how, None
        if Path(how).suffix.lower() not in FLOOR_READABLE:
            raise StereovoxError(f"poses {how}: give slam, odometry, or the .yaml of a map to localise in")
        floor = read_map_server(how)
        self._notify_unless_empty(f"note: {how}: {floor.note}" if floor.note else "")
        check_start(self._start, floor)
        return how, floor

    def _make_mapper(self) -> GridMapper:
        drifts = self._poses_from == ODOMETRY
        if drifts or (self._floor is not None and self._resumed is None):
            config, before = uncompared(self.config), self.config
            why = "odometry drifts" if drifts else "poses in a map may be off by more than a cell"
            self._notify_unless_empty("" if config is before else f"note: {NOT_COMPARED.format(why=why)}")
            self.config = config
        if self._resumed is None:
            return GridMapper(self.config)
        before = self._floor
        if before is None or Path(self._poses_from) != self._resumed:
            before = read_map_server(self._resumed)
        size = self._options.settings.get("voxel_size", before.resolution)
        return GridMapper(self.config, voxel_size=size, resume=before)

    def _slam(self, progress: Progress) -> Track:
        others = "alternatives: poses (--poses) MAP.yaml to localise in a map, or odometry"
        self._notify(f"finding the robot's trajectory by SLAM; {others}")
        try:
            found = slam_robot(self.robot, self.config, progress)
        except MissingExtra as missing:
            raise StereovoxError(f"{missing}; or continue without SLAM: poses odometry (--poses odometry)") from None
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
    """Return x, y and yaw as an array. Raises StereovoxError unless they are numbers."""
    try:
        return np.asarray(start, float)
    except (TypeError, ValueError):
        raise StereovoxError(f"start {start!r}: give x, y in metres and the yaw, three finite numbers") from None
