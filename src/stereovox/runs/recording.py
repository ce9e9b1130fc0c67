# SPDX-License-Identifier: Apache-2.0
"""Map a whole recording, simulation or live camera to disk, with checkpoints, resume and clean interrupts.

The Python side of `stereovox map`: `map_recording` does it in one call, `MapRun` gives access to the mapper before the
first frame. After `kill -9`, a full disk, Ctrl-C or SIGTERM the map on disk still opens; at most the frames since the
last checkpoint are lost, and `resume` continues as if nothing had happened.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.config import load_config
from stereovox.correct.close_loops import LoopClosure, close, refuse_without_frames
from stereovox.errors import MapFileError, StereovoxError, one_line
from stereovox.files.safe_io import check_in_space
from stereovox.frame import AnyFrame, Progress, no_progress
from stereovox.geometry.pose_graph import need_gtsam
from stereovox.kernels.device import on_usable_device
from stereovox.kernels.threads import expecting
from stereovox.mapper import Mapper
from stereovox.mapping.rebuild import CORRECTED
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.files.lock import only_writer_in
from stereovox.maps.files.store import check_target, is_boxed, is_map, read_manifest, remove_map, sweep
from stereovox.maps.record.history import MAX_NAME_LENGTH
from stereovox.opening import Source, Stream
from stereovox.products.floor_axes import upright_axes
from stereovox.products.moved import level_transform
from stereovox.runs.engine import (
    SURVEYED,
    Checkpoints,
    MapOptions,
    MapperRun,
    MapT,
    Observer,
    RunResult,
    frames_offered,
    takes,
)
from stereovox.runs.pose_choice import BOTH, GIVEN, HOW, TRACK, choose_poses, poses_of
from stereovox.runs.survey import LEVELLED, TILTED, level_start, survey
from stereovox.sources.calibration.camera_file import with_camera
from stereovox.sources.paced import Turned
from stereovox.track.inertial import imu_and_note
from stereovox.track.stream import AnyTracker, GuidedTracker, LostSpans, TrackedStream, TrackingGap
from stereovox.track.tracker import Tracker

if TYPE_CHECKING:
    from stereovox.localize.slam.graph import MapDoubt
    from stereovox.localize.track import Track

MAX_UNUSABLE = 100
"""Frames of a live camera that may be refused in a row at the start before the run gives up."""


@dataclass(frozen=True, kw_only=True)
class RecordingOptions(MapOptions):
    """Options of `map_recording`, in addition to `MapOptions`.

    Attributes:
        resume: Continue the map at `out`; frames that it has already seen are skipped.
        frames: Python slice that selects frames: `"::4"`.
        camera: Camera file that replaces the recording's own.
        level: Turn the recording's world so that z points up; the map is then level, but no longer in the
            coordinates of the recording's poses.
        poses: `given`: the recording's own. `track`: the camera is tracked by visual odometry, in a world that begins
            at its first image; frames in which tracking is lost are refused (`tracking_lost`). `both`: the recording's
            motion from frame to frame, corrected by visual odometry. None: given if there are any, else tracked, with
            a line to `notify`; with `resume` as the map was begun.
        close_loops: Keep the frames, and at the end correct the camera's path so that revisited places coincide; see
            the function of that name.
    """

    resume: bool = False
    frames: str | None = None
    camera: str | Path | None = None
    level: bool = False
    poses: str | None = None
    close_loops: bool = False


@dataclass(frozen=True)
class MapResult(RunResult[MapT]):
    """Result of a run: the saved map and the report of each frame.

    Attributes:
        map: The map, as saved: a `VoxelMap` or, from `map_floor`, a `GridMap`.
        out: The path it was saved to.
        reports: One report for each frame of this run, in order.
        dropped: Number of frames that a live camera delivered while the mapper was busy.
        track: The robot's trajectory in the map, from `map_floor`; None if the odometry's poses were used.
        doubts: Why the map may be wrong, from `map_floor` with SLAM; empty if its self-check found nothing.
        poses: Which poses were used: `given`, `track` or `both`.
        lost: Gaps in tracking, if poses were tracked: these frames are not in the map.
        believed: With poses `both`, the number of frames in which nothing known was in view, so that the recording's
            own motion was used unchanged.
        imu: How the IMU of a tracked camera was used, in words; "" without one.
        loops: The loops that were closed; None if nobody asked for a search.
    """

    dropped: int = 0
    track: Track | None = None
    doubts: Sequence[MapDoubt] = ()
    poses: str = GIVEN
    lost: Sequence[TrackingGap] = ()
    believed: int = 0
    imu: str = ""
    loops: LoopClosure | None = None

    def summary(self) -> dict[str, Any]:
        """Summarise the run.

        Returns:
            The numbers of `stereovox map --json`: frames, refusals by reason, milliseconds, cells, memory.
        """
        summary = self._summary(len(self.reports), "frames", [doubt.as_dict() for doubt in self.doubts])
        if self.poses != GIVEN:
            summary["lost"] = [span.as_dict() for span in self.lost]
            summary["believed"] = self.believed
        if self.imu:
            summary["imu"] = self.imu
        if self.loops is not None:
            summary |= self.loops.summary()
        return {**summary, "poses": self.poses}


@takes(RecordingOptions)
def map_recording(
    source: str | Path | Stream, out: str | Path, *, observers: Sequence[Observer] = (), **options: Any
) -> MapResult[VoxelMap]:
    """Map a recording, a simulation or a live camera, and save the map at regular checkpoints.

    Without a profile, a quick survey of the recording suggests the up direction, the range and the cell size; these are
    used and passed to `notify` (see `survey`). Settings given here take precedence.

    Args:
        source: As for `open_source`, a live camera (`realsense:`), or a `Stream` of your own.
        out: Folder of the map to write. An older map there stays whole until the first save replaces it.
        observers: Called after each frame.
        **options: Fields of `RecordingOptions`, and settings by name, as for `Mapper`.

    Returns:
        The map and the report of each frame.

    Raises:
        StereovoxError: One line: invalid source, settings or output folder, another run writes there, the disk is full,
            or no frame could be used.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two frames after saving the map.
    """
    with MapRun(source, out, **options) as run:
        return run.finish(observers)


class MapRun(MapperRun[AnyFrame, MapResult[VoxelMap]]):
    """`map_recording` in two steps: `with MapRun(...) as run` opens and checks everything, `run.finish()` maps.

    While it is open, no other run can write to `out`.

    Args:
        source: As for `map_recording`, like all other arguments.

    Attributes:
        mapper: The mapper, once entered.
        source: The stream of frames, once entered.
        poses: Which poses are used: `given`, `track` or `both`, once entered.
        out: Folder of the map.

    Raises:
        StereovoxError: On entering: invalid source, settings or output folder, or another run writes there.
    """

    mapper: Mapper
    source: Stream
    poses: str

    @takes(RecordingOptions)
    def __init__(self, source: str | Path | Stream, out: str | Path, **options: Any):
        self._options = RecordingOptions.of(options)
        super().__init__(self._options.notify)
        self.out, self._source = Path(out), source
        self._settings = self._options.settings
        self._closing: Progress = no_progress
        self._tracker: Tracker | GuidedTracker | None = None
        if self._options.close_loops:
            refuse_without_frames(self._settings)
            self._settings = {"map.keep_frames": True, **self._settings}

    def _begin(self, stack: ExitStack) -> None:
        if self._options.close_loops:
            need_gtsam()
        saved = self._reserve(stack)
        suggested, lines = self._prepare(saved)
        dropped = len(saved.kept_frames or ()) if saved else 0  # counted now, since the mapper changes that map
        self.mapper = self._make_mapper(saved, suggested)
        stack.callback(self.mapper.map.close)
        self._recorded = self.source
        if self.poses == TRACK:
            self._imu, line = imu_and_note(self.source)
            lines = [*lines, *filter(None, [line])]
        if self.poses != GIVEN:
            self.source = TrackedStream(self.source, self._make_tracker, HOW[self.poses])
        self._checkpoints = Checkpoints(lambda: self.mapper.map.save(self.out), self.out, self._options.checkpoint_s)
        self._check_recording()
        if saved is None and is_map(self.out):
            self._notify(replaces(self.out))
        if dropped and self.mapper.map.kept_frames is None:
            lost = f"the {dropped} frames that the map kept are dropped (map.keep_frames=false)"
            lines = [*lines, f"{lost}; its poses can no longer be corrected"]
        for note in (*self.source.notes, *lines):
            self._notify(f"note: {note}")

    def _reserve(self, stack: ExitStack) -> VoxelMap | None:
        """Keep others from writing to `out`; return the map there if the run continues it."""
        resume = self._options.resume
        check_in_space(self.out)
        if resume and is_boxed(self.out):
            raise StereovoxError(
                f"{self.out}: is a map in boxes; continue it with: stereovox fleet RECORDING ... "
                f"--out {self.out} --resume (name the recordings in it too)"
            )
        check_target(self.out)
        if resume and not is_map(self.out):
            raise StereovoxError(f"{self.out}: no map to continue; start without resume")
        stack.enter_context(only_writer_in(self.out))
        sweep(self.out)
        saved = load_map(self.out) if resume else None
        if saved is not None and saved.recording.endswith(CORRECTED):
            raise StereovoxError(
                f"{self.out}: its poses were corrected, so the next frames do not fit; begin a new map"
            )
        return saved

    def finish(self, observers: Sequence[Observer] = (), closing: Progress = no_progress) -> MapResult[VoxelMap]:
        """Map all remaining frames and save the map, as `Run.finish`.

        Args:
            observers: Called after each frame.
            closing: Called during the search for loops with the number done, the total, and the current step.
        """
        self._closing, self._lost = closing, LostSpans(frames_offered(self.mapper))
        return super().finish(observers)

    def _around(self) -> AbstractContextManager[None]:
        return _saved_from_start(self.mapper.map, self.out)

    def _end(self) -> MapResult[VoxelMap]:
        if not self.mapper.map.frames:
            why = self._first_refusal() or self.source.why_none
            raise StereovoxError(f"{self.source.name}: not one frame could be used, so no map is written ({why})")
        self._checkpoints.save(self._kept)
        closure = self._closure()
        made = MapResult(self.mapper.map, self.out, self.reports, self.source.dropped, poses=self.poses, loops=closure)
        if self.poses == GIVEN:
            return made
        tracker = self._tracker
        if use := tracker.picture_use() if tracker else "":
            self._notify(f"note: {use}")
        believed = tracker.prior_only_frames if isinstance(tracker, GuidedTracker) else 0
        imu = tracker.imu_use if isinstance(tracker, Tracker) else ""
        return replace(made, lost=self._lost.spans, believed=believed, imu=imu)

    @property
    def remaining(self) -> int | None:
        """Number of frames that are not in the map yet; None for a live camera."""
        length = self.source.length
        return None if length is None else max(length - frames_offered(self.mapper), 0)

    def _prepare(self, saved: VoxelMap | None) -> tuple[dict[str, Any], list[str]]:
        """Open the source; return settings that it suggests, and lines about them. `level` turns the world here."""
        options = self._options
        source, self.poses, why = choose_poses(self._source, options.frames, self._poses_of(saved))
        self._check_tracked(source)
        self.source = source if options.camera is None else with_camera(source, str(options.camera))
        if saved and options.level and saved.config.levelled_from is None:
            raise StereovoxError(f"level: {self.out} was begun without it; leave it out, or begin a new map")
        settings, lines = ({}, []) if saved else self._suggested(source)
        if why:
            lines = [f"the camera is tracked by visual odometry, since poses are missing ({why})", *lines]
        direction = saved.config.levelled_from if saved else self._level_direction(settings)
        if direction is not None:
            self.source = Turned(self.source, level_transform(direction))
            settings = {**settings, "up": "z", "up_direction": None, "levelled_from": direction}
        return settings if saved is None else {}, lines

    def _poses_of(self, saved: VoxelMap | None) -> str | None:
        """Return which poses to use: those asked for, else those with which the map was begun."""
        if self._options.poses is not None or saved is None or not saved.recording:
            return self._options.poses
        return poses_of(saved.recording)

    def _check_tracked(self, source: Stream) -> None:
        """Raise StereovoxError for options that tracked poses do not allow."""
        if self.poses == TRACK and self._options.level:
            raise StereovoxError("level: a map with tracked poses is level already; leave it out")
        if self.poses != GIVEN and self._options.resume and source.length is None:
            raise StereovoxError(f"{self.out}: a live camera cannot be located in a saved map; begin a new one")

    def _suggested(self, source: Stream) -> tuple[dict[str, Any], list[str]]:
        """Return settings that a recording suggests if no profile chose them, and lines about them."""
        profile, level = self._options.profile, self._options.level
        named = isinstance(self._source, str | Path) and isinstance(source, Source)  # a live camera cannot be surveyed
        if not named or (profile is not None and not level):
            return {}, []
        found = survey(source, SURVEYED)
        if self.poses == TRACK:
            found = replace(found, up=None)  # it would be up by the recording's own poses
        settings = found.settings if profile is None else found.up_settings
        chosen, lines = settings(self._settings, LEVELLED if level else TILTED)
        if level and found.up is not None and found.up.sure:
            chosen.setdefault("up", found.up.axis)  # if it is z, nothing had to be chosen
        return chosen, lines

    def _level_direction(self, settings: Mapping[str, Any]) -> tuple[float, float, float] | None:
        """Return the up direction of the recording's world, None if it is not to be levelled.

        Raises StereovoxError if it is unknown.
        """
        if not self._options.level:
            return None
        chosen: dict[str, Any] = {**settings, **self._profile_up(), **self._settings}
        if "up" not in chosen:
            raise StereovoxError("level: the up direction of this recording is uncertain; give it: --set up=AXIS")
        if chosen.get("up_direction") is None:
            return tuple(upright_axes(chosen["up"])[2].tolist())
        return load_config(up=chosen["up"], up_direction=chosen["up_direction"]).up_direction

    def _profile_up(self) -> dict[str, Any]:
        """Return the profile's up direction, unless it is the usual z."""
        config = load_config("default" if self._options.profile is None else self._options.profile)
        return {} if config.up == "z" else {"up": config.up, "up_direction": config.up_direction}

    def _make_mapper(self, saved: VoxelMap | None, suggested: Mapping[str, Any]) -> Mapper:
        settings = self._options.profile
        if settings is None:
            settings = saved.config if saved else "default"
        tiles = self.out.parent / f".{self.out.name}-tiles"  # next to the map, not in a temporary folder in memory
        config = load_config(settings, **{**self._settings, **suggested})
        return Mapper(on_usable_device(config, self._notify), resume=saved, tiles=tiles)

    def _closure(self) -> LoopClosure | None:
        """Close the loops of the map, if the options ask for it, and save it again."""
        if not self._options.close_loops:
            return None

        def progress(done: int, total: int, doing: str) -> None:
            self._check()
            self._closing(done, total, doing)

        closure = close(self.mapper, progress)
        self._checkpoints.save(self._kept)  # with the places that were refused
        return closure

    def _make_tracker(self) -> AnyTracker:
        """Return a new tracker, always of the same kind; `_end` later reads what it did."""
        config = self.mapper.config
        if self.poses == BOTH:
            self._tracker = GuidedTracker(config)
        else:
            self._tracker = Tracker(config, start=level_start(self._recorded, config), imu=self._imu)
        return self._tracker

    def _check_recording(self) -> None:
        """Check that the map is of this recording: otherwise its first frames would be skipped wrongly."""
        recorded_from = self.mapper.map.recording
        if recorded_from and recorded_from != self.source.name:
            raise StereovoxError(
                f"{self.out}: was made of '{recorded_from}', not of '{self.source.name}'; continue with that, or "
                "start anew without resume"
            )
        self.mapper.map.recording = self.source.name

    def _steps(self) -> Iterable[AnyFrame]:
        done, length = frames_offered(self.mapper), self.source.length
        if done:
            if length is not None and done > length:
                raise StereovoxError(
                    f"{self.out}: holds {done} frames, more than the {length} of {self.source.name}; choose "
                    "the same frames as before"
                )
            self._check_last(done)
            if done == length:  # a user who restarts a killed run need not know that it was complete
                self._notify(f"{self.out} already holds all {done} frames of {self.source.name}")
                return ()
            self._notify(f"continuing after frame {done}")
        frames = self.source.after(done) if done else self.source
        if self.mapper.config.threads > 1 and isinstance(self._recorded, Source):  # frames can be read ahead
            frames = expecting(self.mapper.expect, frames)
        return frames

    def _take(self, step: AnyFrame) -> None:
        super()._take(step)
        self._lost.after(step, self.reports[-1])
        endless = self.source.length is None and len(self.reports) == MAX_UNUSABLE
        if endless and all(report.refused for report in self.reports):
            left = f"{self.out} stays as it is" if self.mapper.map.frames else "no map is written"
            why = f"not one of {MAX_UNUSABLE} frames could be used; {left} ({self._first_refusal()})"
            raise StereovoxError(f"{self.source.name}: {why}")

    def _stopped_line(self) -> str:
        where = f"{self.out}, continue with resume (--resume)"
        return f"stopped after {len(self.reports)} frames; they are saved in {where}"

    def _check_last(self, done: int) -> None:
        """Check the last frame in the map: with other `frames`, skipping by number would miss or repeat some."""
        last = self.mapper.map.history.last_frame
        if self.source.length is None or last is None:  # a live camera, or a map that does not record it
            return
        found = next(iter(self._recorded.after(done - 1)))
        if (one_line(found.name[:MAX_NAME_LENGTH]), found.stamp_ns) != last:
            raise StereovoxError(
                f"{self.out}: its frame {done} was '{last[0]}', but here it is '{found.name}'; choose frames as "
                "before, or start anew without resume"
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
    """Return a note about the map at `out` that the first save of a new one will replace."""
    try:
        manifest = read_manifest(out)
        made_of = f" made of '{one_line(str(manifest['recording']))}'" if manifest.get("recording") else ""
        return f"note: {out} replaces an older map of {manifest['frames']:,} frames{made_of}"
    except (MapFileError, KeyError, ValueError):
        return f"note: {out} replaces a damaged map"
