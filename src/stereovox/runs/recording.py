# SPDX-License-Identifier: Apache-2.0
"""Map a whole recording, simulation or live camera to disk, with checkpoints, resume and clean interrupts.

The Python side of `stereovox map`: `map_recording` does it in one call, `MapRun` gives access to the mapper before the
first frame. After `kill -9`, a full disk, Ctrl-C or SIGTERM the map on disk still opens, at most the frames since the
last checkpoint are lost, and `resume` continues as if nothing had happened.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from math import inf, isfinite
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from stereovox.config import Config, load_config
from stereovox.correct.close_loops import LoopClosure, close, refuse_without_frames
from stereovox.errors import MapFileError, SourceError, StereovoxError, one_line
from stereovox.evaluate.summary import mostly_lost, summarise
from stereovox.files.safe_io import check_in_space
from stereovox.frame import UpdateReport
from stereovox.geometry.pose_graph import need_gtsam
from stereovox.kernels.device import on_usable_device
from stereovox.kernels.threads import expecting
from stereovox.localize.robot_track import Progress, no_progress
from stereovox.localize.track import Track
from stereovox.mapper import AnyMapper, Mapper
from stereovox.mapping.rebuild import CORRECTED
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.files.lock import only_writer_in
from stereovox.maps.files.store import check_target, is_boxed, is_map, read_manifest, remove_map, sweep
from stereovox.maps.grid_map import GridMap
from stereovox.maps.record.history import MAX_NAME_LENGTH
from stereovox.opening import Stream
from stereovox.products.floor.floor_axes import upright_axes
from stereovox.products.moved import level_transform
from stereovox.runs.pose_choice import BOTH, GIVEN, HOW, TRACK, choose_poses, poses_of
from stereovox.runs.survey import LEVELLED, TILTED, level_start, survey
from stereovox.sources.calibration.camera_file import with_camera
from stereovox.sources.turned import Turned
from stereovox.track.gaps import LostSpans, TrackingGap
from stereovox.track.guided import GuidedTracker
from stereovox.track.inertial import imu_and_note
from stereovox.track.stream import AnyTracker, TrackedStream
from stereovox.track.tracker import Tracker

if TYPE_CHECKING:
    from stereovox.localize.slam.doubts import MapDoubt

SeenT = TypeVar("SeenT")
MapT = TypeVar("MapT", VoxelMap, GridMap)

CHECKPOINT_S = 10.0
NOTHING_CAME = "the source is empty"
REST = 25
"""Minimum pause between two saves, in durations of a save: saves take at most 4 % of a run."""
SURVEYED = 10
"""Frames of a recording that are read before it is mapped, for the settings that it suggests."""
MAX_UNUSABLE = 100
"""Frames of a live camera that may be refused in a row at the start before the run gives up."""


class Observer(Protocol):
    """Observer of a run, called for each frame: a progress bar, a live page, a recorder."""

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Process a frame right after the mapper returned its report, whether it was mapped or refused.

        Args:
            frame: The `Frame`, `StereoFrame` or `Scan` that was offered.
            report: What `add` of the mapper returned for it.
        """
        ...


@dataclass(frozen=True)
class MapResult(Generic[MapT]):
    """Result of a run: the saved map and the report of each frame.

    Attributes:
        map: The map, as saved: a `VoxelMap` or, from `map_floor`, a `GridMap`.
        out: Where it was saved.
        reports: One report for each frame of this run, in order.
        dropped: Number of frames that a live camera delivered while the mapper was busy.
        track: The robot's trajectory in the map, from `map_floor`; None if the odometry's poses were used.
        doubts: Why the map may be wrong, from `map_floor` with SLAM; empty if its self-check found nothing.
        poses: Which were used: `given`, `track` or `both`.
        lost: Where the camera was lost, if its poses were tracked: these frames are not in the map.
        believed: Of poses `both`, the number of frames in which nothing known was in view, so that the recording's own
            motion was taken as it is.
        imu: What was made of the IMU of a camera that was tracked, in words; "" without one.
        loops: Which loops were closed; None if none were sought.
    """

    map: MapT
    out: Path
    reports: list[UpdateReport]
    dropped: int = 0
    track: Track | None = None
    doubts: Sequence[MapDoubt] = ()
    poses: str = GIVEN
    lost: Sequence[TrackingGap] = ()
    believed: int = 0
    imu: str = ""
    loops: LoopClosure | None = None

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the map's picture and facts."""
        return self.map._repr_html_(f"MapResult, saved in {self.out}")

    def summary(self) -> dict[str, Any]:
        """Summarise the run.

        Returns:
            The numbers of `stereovox map --json`: frames, refusals by reason, milliseconds, cells, memory.
        """
        summary = summarise(self.map, self.reports)
        doubts = [doubt.as_dict() for doubt in self.doubts]
        if doubts := doubts + mostly_lost(summary["frames"], len(self.reports), "frames"):
            summary["doubts"] = doubts
        if self.poses != GIVEN:
            summary["lost"] = [span.as_dict() for span in self.lost]
            summary["believed"] = self.believed
        if self.imu:
            summary["imu"] = self.imu
        if self.loops is not None:
            summary |= self.loops.summary()
        return {**summary, "poses": self.poses}


def map_recording(
    source: str | Path | Stream,
    out: str | Path,
    *,
    profile: str | Path | Config | None = None,
    resume: bool = False,
    frames: str | None = None,
    camera: str | Path | None = None,
    level: bool = False,
    poses: str | None = None,
    close_loops: bool = False,
    checkpoint_s: float = CHECKPOINT_S,
    observers: Sequence[Observer] = (),
    notify: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> MapResult[VoxelMap]:
    """Map a recording, a simulation or a live camera, and save the map at regular checkpoints.

    Without a profile, what a quick look at a recording suggests is used and passed to `notify`: which way is up, the
    range and the cell size (see `survey`). Settings given here come first.

    Args:
        source: As for `open_source`, a live camera (`realsense:`), or a `Stream` of your own.
        out: Folder of the map to write. An older map there stays whole until the first save replaces it.
        profile: Profile name, TOML file or Config; None: `default`, or with `resume` the map's own settings.
        resume: Continue the map at `out`; the frames it has already seen are skipped.
        frames: Python slice that selects frames: `"::4"`.
        camera: Camera file that replaces the recording's own.
        level: Turn the recording's world so that z points up; the map is then level, but no longer in the
            coordinates of the recording's poses.
        poses: `given`: those of the recording. `track`: the camera is tracked by its own images, in a world that
            begins at its first one; frames in which it is lost are refused (`tracking_lost`). `both`: the camera
            moves from frame to frame as the recording says, corrected by what the images show. None: given where there
            are any, else tracked, which is passed to `notify`; with `resume` as the map was begun.
        close_loops: Keep the frames, and at the end bend the camera's way so that what it saw again is one; see the
            function of that name.
        checkpoint_s: Seconds between two saves; 0: save only at the end.
        observers: Called after each frame.
        notify: Called with each line that a user should see: assumptions about the source, where a run resumes.
        **overrides: Settings by name, as for `Mapper`.

    Returns:
        The map and the report of each frame.

    Raises:
        StereovoxError: One line: invalid source, settings or output folder, another run writes there, the disk is full,
            or no frame could be used.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two frames after saving the map.
    """
    settings = {"profile": profile, "resume": resume, "frames": frames, "camera": camera, "level": level}
    settings |= {"poses": poses, "close_loops": close_loops, "checkpoint_s": checkpoint_s}
    with MapRun(source, out, **settings, notify=notify, **overrides) as run:
        return run.finish(observers)


class MapRun:
    """`map_recording` in two steps: `with MapRun(...) as run` opens and checks everything, `run.finish()` maps.

    While it is open, no other run can write to `out`.

    Args:
        source: As for `map_recording`, like all other arguments.

    Attributes:
        mapper: The mapper, once entered.
        source: The stream of frames, once entered.
        poses: Which are used: `given`, `track` or `both`, once entered.
        out: Folder of the map.

    Raises:
        StereovoxError: On entering: invalid source, settings or output folder, or another run writes there.
    """

    mapper: Mapper
    source: Stream
    poses: str

    def __init__(
        self,
        source: str | Path | Stream,
        out: str | Path,
        *,
        profile: str | Path | Config | None = None,
        resume: bool = False,
        frames: str | None = None,
        camera: str | Path | None = None,
        level: bool = False,
        poses: str | None = None,
        close_loops: bool = False,
        checkpoint_s: float = CHECKPOINT_S,
        notify: Callable[[str], None] = lambda line: None,
        **overrides: Any,
    ):
        self.out = Path(out)
        self._source, self._frames, self._camera = source, frames, camera
        self._profile, self._resume, self._overrides = profile, resume, overrides
        self._notify, self._open = notify, ExitStack()
        self._checkpoint_s, self._level, self._poses = checkpoint_s, level, poses
        self._close_loops = close_loops
        if close_loops:
            refuse_without_frames(overrides)
            self._overrides = {"map.keep_frames": True, **overrides}

    def __enter__(self) -> MapRun:
        with ExitStack() as stack:
            if self._close_loops:
                need_gtsam()
            check_in_space(self.out)
            if self._resume and is_boxed(self.out):
                raise StereovoxError(
                    f"{self.out}: is a map in boxes; a fleet's is gone on with by: stereovox fleet RECORDING ... "
                    f"--out {self.out} --resume (name those that are in it, too)"
                )
            check_target(self.out)
            if self._resume and not is_map(self.out):
                raise StereovoxError(f"{self.out}: no map to go on with; start it without resume")
            stack.enter_context(only_writer_in(self.out))
            sweep(self.out)
            saved = load_map(self.out) if self._resume else None
            if saved is not None and saved.recording.endswith(CORRECTED):
                raise StereovoxError(
                    f"{self.out}: its poses were corrected, so the next frames do not fit; begin a new map"
                )
            suggested, lines = self._prepare(saved)
            given_up = len(saved.kept_frames or ()) if saved else 0  # asked now, since the mapper goes on with that map
            self.mapper = self._make_mapper(saved, suggested)
            stack.callback(self.mapper.map.close)
            self._recorded = self.source
            self._trackers: list[Tracker | GuidedTracker] = []
            if self.poses != GIVEN:
                make, line = self._make_tracker()
                self.source = TrackedStream(self.source, make, HOW[self.poses])
                lines = [*lines, *filter(None, [line])]
            self._checkpoints = Checkpoints(lambda: self.mapper.map.save(self.out), self.out, self._checkpoint_s)
            self._check_recording()
            if not self._resume and is_map(self.out):
                self._notify(replaces(self.out))
            if given_up and self.mapper.map.kept_frames is None:
                lost = f"the {given_up} frames that the map kept are given up (map.keep_frames=false)"
                lines = [*lines, f"{lost}; its poses can then not be corrected any more"]
            for note in (*self.source.notes, *lines):
                self._notify(f"note: {note}")
            self._open = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.close()

    def finish(self, observers: Sequence[Observer] = (), closing: Progress = no_progress) -> MapResult[VoxelMap]:
        """Map all remaining frames and save the map.

        Args:
            observers: Called after each frame.
            closing: Called while loops are sought: with how many are done, how many there are, and the current step.

        Returns:
            The map and the report of each frame of this run.

        Raises:
            StereovoxError: The source failed, the disk is full, or no frame could be used.
            KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two frames after saving the map.
        """
        with interrupt_between_steps() as check, _saved_from_start(self.mapper.map, self.out):
            self._lost = LostSpans(frames_offered(self.mapper))
            reports = self._add_all(check, (*observers, *([self._lost] if self.poses != GIVEN else [])))
            if not self.mapper.map.frames:
                why = first_refusal(reports, getattr(self.source, "why_none", NOTHING_CAME))
                raise StereovoxError(f"{self.source.name}: not one frame could be used, no map is written ({why})")
            self._checkpoints.save(frames_offered(self.mapper))
            closure = self._closure(check, closing)
        for tracker in self._trackers[-1:]:
            if tracker.picture_use():
                self._notify(f"note: {tracker.picture_use()}")
        return MapResult(
            self.mapper.map, self.out, reports, self.source.dropped,
            poses=self.poses, lost=self._lost.spans, believed=self._believed(), imu=self._imu_use(), loops=closure,
        )  # fmt: skip

    @property
    def remaining(self) -> int | None:
        """Number of frames that are not in the map yet; None for a live camera."""
        length = self.source.length
        return None if length is None else max(length - frames_offered(self.mapper), 0)

    def _prepare(self, saved: VoxelMap | None) -> tuple[dict[str, Any], list[str]]:
        """Open the source; return settings that it suggests, and lines about them. A levelled world is turned here."""
        source, self.poses, why = choose_poses(self._source, self._frames, self._poses_of(saved))
        self._check_tracked(source)
        self.source = source if self._camera is None else with_camera(source, str(self._camera))
        if saved and self._level and saved.config.levelled_from is None:
            raise StereovoxError(f"level: {self.out} was begun without; go on without it, or begin a new map")
        settings, lines = ({}, []) if saved else self._suggested(source)
        if why:
            lines = [f"the camera is tracked by its own images, without poses ({why})", *lines]
        direction = saved.config.levelled_from if saved else self._level_direction(settings)
        if direction is not None:
            self.source = Turned(self.source, level_transform(direction))
            settings = {**settings, "up": "z", "up_direction": None, "levelled_from": direction}
        return settings if saved is None else {}, lines

    def _poses_of(self, saved: VoxelMap | None) -> str | None:
        """Return which poses to use: those that were asked for, else those that the map was begun with."""
        if self._poses is not None or saved is None or not saved.recording:
            return self._poses
        return poses_of(saved.recording)

    def _check_tracked(self, source: Stream) -> None:
        """Raise StereovoxError for what cannot be had with tracked poses."""
        if self.poses == TRACK and self._level:
            raise StereovoxError("level: a map with tracked poses has its own world, which is level; leave it out")
        if self.poses != GIVEN and self._resume and source.length is None:
            raise StereovoxError(f"{self.out}: a live camera does not know where in it it is; begin a new map")

    def _suggested(self, source: Stream) -> tuple[dict[str, Any], list[str]]:
        """Return settings that a recording suggests where no profile chose them, and lines about them."""
        named = isinstance(self._source, str | Path) and hasattr(source, "frame")  # a live camera cannot be looked at
        if not named or (self._profile is not None and not self._level):
            return {}, []
        found = survey(source, SURVEYED)  # pyright: ignore[reportArgumentType]
        if self.poses == TRACK:
            found = replace(found, up=None)  # which is that of the recording's own poses
        settings = found.settings if self._profile is None else found.up_settings
        chosen, lines = settings(self._overrides, LEVELLED if self._level else TILTED)
        if self._level and found.up is not None and found.up.sure:
            chosen.setdefault("up", found.up.axis)  # where it is z, nothing had to be chosen
        return chosen, lines

    def _level_direction(self, settings: Mapping[str, Any]) -> tuple[float, float, float] | None:
        """Return what is up in the recording's world, None if it is not to be levelled.

        Raises StereovoxError if nobody says it.
        """
        if not self._level:
            return None
        chosen = {**settings, **self._profile_up(), **self._overrides}
        if "up" not in chosen:
            raise StereovoxError("level: which way is up in this recording is not certain; say it: --set up=AXIS")
        if chosen.get("up_direction") is None:
            return tuple(upright_axes(chosen["up"])[2].tolist())
        return load_config(up=chosen["up"], up_direction=chosen["up_direction"]).up_direction

    def _profile_up(self) -> dict[str, Any]:
        """Return which way is up by the profile, where it says anything but the usual z."""
        config = load_config("default" if self._profile is None else self._profile)
        return {} if config.up == "z" else {"up": config.up, "up_direction": config.up_direction}

    def _make_mapper(self, saved: VoxelMap | None, suggested: Mapping[str, Any]) -> Mapper:
        settings = self._profile
        if settings is None:
            settings = saved.config if saved else "default"
        tiles = self.out.parent / f".{self.out.name}-tiles"  # next to the map, not in a temporary folder in memory
        config = load_config(settings, **{**self._overrides, **suggested})
        return Mapper(on_usable_device(config, self._notify), resume=saved, tiles=tiles)

    def _closure(self, check: Callable[[], None], progress: Progress) -> LoopClosure | None:
        """Close the loops of the map, if that is wanted, and save it again."""
        if not self._close_loops:
            return None

        def tell(done: int, total: int, doing: str) -> None:
            check()
            progress(done, total, doing)

        closure = close(self.mapper, tell)
        self._checkpoints.save(frames_offered(self.mapper))  # also which places were refused
        return closure

    def _believed(self) -> int:
        return sum(tracker.prior_only_frames for tracker in self._trackers[-1:] if isinstance(tracker, GuidedTracker))

    def _imu_use(self) -> str:
        return "".join(tracker.imu_use for tracker in self._trackers[-1:] if isinstance(tracker, Tracker))

    def _make_tracker(self) -> tuple[Callable[[], AnyTracker], str]:
        """Return what makes the tracker of this run, the same each time, and a line about the IMU, if there is one."""
        config = self.mapper.config
        if self.poses == BOTH:
            return partial(_kept, self._trackers, partial(GuidedTracker, config)), ""
        imu, line = imu_and_note(self.source)
        make = partial(Tracker, config, start=level_start(self.source, config), imu=imu)
        return partial(_kept, self._trackers, make), line

    def _check_recording(self) -> None:
        """Check that the map is of this recording: of another one, the first frames would be skipped."""
        recorded_from = self.mapper.map.recording
        if recorded_from and recorded_from != self.source.name:
            raise StereovoxError(
                f"{self.out}: was made of '{recorded_from}', not of '{self.source.name}'; go on with that, or start "
                "anew without resume"
            )
        self.mapper.map.recording = self.source.name

    def _add_all(self, check: Callable[[], None], observers: Sequence[Observer]) -> list[UpdateReport]:
        done, length = frames_offered(self.mapper), self.source.length
        if done:
            if length is not None and done > length:
                raise StereovoxError(
                    f"{self.out}: holds {done} frames, more than the {length} of {self.source.name}; choose "
                    "the same frames as before"
                )
            self._check_last(done)
            if done == length:  # whoever starts a run again after a kill need not know that it was complete
                self._notify(f"{self.out} already holds all {done} frames of {self.source.name}")
                return []
            self._notify(f"going on after frame {done}")
        all_observers = (*observers, *([] if length is not None else [_Patience(self, done)]))
        stopped = "stopped after {} frames; they are saved in " + f"{self.out}, go on there with resume (--resume)"
        frames = self.source.after(done) if done else self.source
        if self.mapper.config.threads > 1 and hasattr(self._recorded, "frame"):  # any frame can be had at any time
            frames = expecting(self.mapper.expect, frames)
        return add_all(
            self.mapper, frames, self._checkpoints, check, all_observers, lambda n: self._notify(stopped.format(n))
        )

    def _check_last(self, done: int) -> None:
        """Check the last frame in the map: with other `frames`, skipping by number would miss or repeat some."""
        last = self.mapper.map.history.last_frame
        if self.source.length is None or last is None:  # a live camera; a map from before this was saved
            return
        found = next(iter(self._recorded.after(done - 1)))
        if (one_line(found.name[:MAX_NAME_LENGTH]), found.stamp_ns) != last:
            raise StereovoxError(
                f"{self.out}: its frame {done} was '{last[0]}', here it is '{found.name}'; choose frames as "
                "before, or start anew without resume"
            )


def add_all(
    mapper: AnyMapper[SeenT],
    frames: Iterable[SeenT],
    checkpoints: Checkpoints,
    check: Callable[[], None],
    observers: Sequence[Observer],
    stopped: Callable[[int], None],
) -> list[UpdateReport]:
    """Add all frames to a 3-D map or a floor map, with checkpoints; return the report of each.

    check: raises KeyboardInterrupt once the run shall stop (`interrupt_between_steps`). stopped: called with the number
    of frames after an interrupt or a failure of the source, once the map is saved; the error is then raised again.
    """
    reports: list[UpdateReport] = []
    try:
        for frame in frames:
            reports.append(_add(mapper, frame, checkpoints))
            for one in observers:
                one.after(frame, reports[-1])
            check()
            if mapper.map.frames:  # an empty map must not take the place of an older one
                checkpoints.after(frames_offered(mapper))
    except (KeyboardInterrupt, SourceError):
        if mapper.map.frames:
            checkpoints.save(frames_offered(mapper))
            stopped(len(reports))
        raise
    return reports


def frames_offered(mapper: AnyMapper[Any]) -> int:
    """Return the number of frames offered to a mapper's map, refused ones included."""
    return mapper.map.frames + mapper.map.frames_refused


def _add(mapper: AnyMapper[SeenT], frame: SeenT, checkpoints: Checkpoints) -> UpdateReport:
    try:
        return mapper.add(frame)
    except MapFileError as error:  # no room for a tile; up to this frame the map is whole in memory
        checkpoints.save(frames_offered(mapper))
        raise MapFileError(f"{error}; {checkpoints.saved_so_far()}") from None


class _Patience:
    """Ends a run whose live camera delivers no usable frame, which would otherwise go on for ever."""

    def __init__(self, run: MapRun, done: int):
        self._run, self._done, self._first, self._refused = run, done, "", 0

    def after(self, frame: Any, report: UpdateReport) -> None:
        if self._refused < 0 or not report.refused:
            self._refused = -1  # one could be used
            return
        self._first, self._refused = self._first or report.detail, self._refused + 1
        if self._refused == MAX_UNUSABLE:
            left = f"{self._run.out} stays as it is" if self._done else "no map is written"
            raise StereovoxError(
                f"{self._run.source.name}: not one of {MAX_UNUSABLE} frames could be used, {left} ({self._first})"
            )


@contextmanager
def _saved_from_start(voxel_map: VoxelMap, out: Path) -> Iterator[None]:
    """Save a new map before its first frame, so that a killed run leaves one; remove it if it stays empty."""
    new = not is_map(out)
    if new:
        voxel_map.save(out)
    try:
        yield
    finally:
        if new and is_map(out) and not read_manifest(out)["frames"]:
            remove_map(out)


def replaces(out: Path) -> str:
    """Return a line about the map at `out` that the first save of a new one will replace."""
    try:
        manifest = read_manifest(out)
        made_of = f" made of '{one_line(str(manifest['recording']))}'" if manifest.get("recording") else ""
        return f"note: {out} replaces the map of {manifest['frames']:,} frames{made_of} that is there"
    except (MapFileError, KeyError, ValueError):
        return f"note: {out} replaces a damaged map that is there"


def first_refusal(reports: list[UpdateReport], none: str = NOTHING_CAME) -> str:
    """Return why the first of the refused frames was refused, or `none`, for the error that none could be used."""
    return next((report.detail for report in reports if report.refused), none)


class Checkpoints:
    """Saves a map between frames when a checkpoint is due.

    save: writes the map atomically. out: its path, for messages. seconds: between two saves; 0: none before the end.
    clock: returns seconds. Raises StereovoxError for negative or infinite seconds.
    """

    def __init__(self, save: Callable[[], None], out: object, seconds: float, clock: Callable[[], float] = monotonic):
        if not (isfinite(seconds) and seconds >= 0):
            raise StereovoxError(f"checkpoint_s {seconds:g}: give seconds, or 0 for none")
        self._save, self._out, self._clock = save, out, clock
        self._seconds = seconds or inf
        self._due = clock() + self._seconds
        self._saved = 0

    def after(self, frames: int) -> None:
        """Save if a checkpoint is due. frames: number of frames in the map."""
        start = self._clock()
        if start >= self._due:
            self.save(frames)
            done = self._clock()
            self._due = done + max(self._seconds, REST * (done - start))

    def save(self, frames: int) -> None:
        """Save now. Raises MapFileError if that fails: one line that also says what was saved before."""
        try:
            self._save()
        except MapFileError as error:
            raise MapFileError(f"{error}; {self.saved_so_far()}") from None
        self._saved = frames

    def saved_so_far(self) -> str:
        """Describe how much of the run is saved."""
        if not self._saved:
            return "nothing of this run is saved"
        return f"{self._out} holds this run up to frame {self._saved}"


@contextmanager
def interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """Defer signals: yield a function that raises KeyboardInterrupt if one has arrived, so that no step is cut in half.

    Handles Ctrl-C (a second one acts at once), SIGTERM (`kill`, systemd, docker stop) and SIGHUP (the terminal is
    gone), which may arrive several times: `timeout` sends two. The exception holds the signal's number.
    """
    received: list[int] = []

    def remember(number: int, _: object) -> None:
        received.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def check() -> None:
        if received:
            raise KeyboardInterrupt(received[0])

    with ExitStack() as stack:
        for number in _default_signals():
            stack.callback(signal.signal, number, signal.signal(number, remember))
        yield check


@contextmanager
def ended_in_order() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end what runs as Ctrl-C does: the first raises KeyboardInterrupt, which holds its number.

    What cleans up after that is not disturbed by those that follow, nor by another Ctrl-C.
    """
    before = {number: signal.getsignal(number) for number in _default_signals()}

    def end(number: int, _: object) -> None:
        for one in before:
            signal.signal(one, signal.SIG_IGN)
        raise KeyboardInterrupt(number)

    try:
        for one in before:
            signal.signal(one, end)
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _default_signals() -> list[int]:
    """Return the signals with default handling: notebooks, servers, nohup and background jobs set their own.

    None in a thread other than the main one, which alone may handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        return []
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    return [number for number, handler in usual.items() if signal.getsignal(number) == handler]


def _kept(trackers: list[Tracker | GuidedTracker], make: Callable[[], Tracker | GuidedTracker]) -> AnyTracker:
    """Return a new tracker, and keep it in a list to be asked later what it did."""
    trackers.append(make())
    return trackers[-1]
