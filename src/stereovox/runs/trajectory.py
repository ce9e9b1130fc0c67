# SPDX-License-Identifier: Apache-2.0
"""Track the motion of a recorded or live camera: the Python side of `stereovox track`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.evaluate.metrics import percentiles
from stereovox.evaluate.trajectory_score import TrajectoryScore, score_trajectory, travelled_m
from stereovox.files.safe_io import check_file
from stereovox.frame import AnyFrame, Progress, no_progress
from stereovox.geometry.se3 import Transform
from stereovox.kernels.threads import expecting
from stereovox.opening import open_source
from stereovox.runs.engine import SURVEYED, Checkpoints, Run, RunOptions, takes
from stereovox.runs.pose_choice import TRACK, choose_poses
from stereovox.runs.survey import level_start, survey
from stereovox.sources.base import Source, Stream, prefetch
from stereovox.sources.calibration.camera_file import with_camera
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import TRAJECTORY_ENDINGS, write_trajectory
from stereovox.track.inertial import imu_and_note
from stereovox.track.stream import LOST, LostSpans, TrackingGap, follow
from stereovox.track.tracker import Tracked, Tracker

DOING = "tracking"


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """The trajectory of a camera, found from its own images.

    Attributes:
        name: Name of the recording.
        stamps_ns: (N,) int64, time of each frame in nanoseconds.
        T_world_sensor: (N, 4, 4) float64, maps the optical frame into a world that begins at the first image, z up;
            NaN while tracking was lost.
        covariances: (N, 6, 6) float64 of each pose relative to the earlier views, as `Tracked.covariance`; infinite
            while tracking was lost.
        lost: Gaps in tracking, and their causes.
        frame_ms: (N,) milliseconds that each frame took.
        score: Its error against the recording's own poses; None without them.
        imu: How the IMU was used, in words; "" without one.
    """

    name: str
    stamps_ns: NDArray[np.int64]
    T_world_sensor: NDArray[np.float64]
    covariances: NDArray[np.float64]
    lost: tuple[TrackingGap, ...]
    frame_ms: NDArray[np.float64]
    score: TrajectoryScore | None = None
    imu: str = ""

    @property
    def tracked(self) -> NDArray[np.bool_]:
        """Return which frames (N,) have a pose."""
        return np.asarray(np.isfinite(self.T_world_sensor).all(axis=(1, 2)))

    @property
    def length_m(self) -> float:
        """Metres along the poses; straight across gaps in tracking."""
        poses = self.T_world_sensor[self.tracked]
        return float(travelled_m(poses)[-1]) if len(poses) else 0.0

    def poses(self) -> Poses:
        """Return the tracked poses, over time.

        Raises:
            SourceError: No frame has a pose.
        """
        return Poses(self.stamps_ns[self.tracked], self.T_world_sensor[self.tracked], where=f"{self.name}, tracked")

    def save(self, path: str | Path) -> None:
        """Write the tracked poses as lines `stamp tx ty tz qx qy qz qw` (TUM), all or nothing.

        Args:
            path: The file.

        Raises:
            MapFileError: It cannot be written; an older file then stays.
        """
        found = self.tracked
        whose = "camera (x right, y down, z forward), tracked"
        write_trajectory(path, self.stamps_ns[found].tolist(), self.T_world_sensor[found], whose)

    def picture(self, file: str | Path) -> None:
        """Draw the trajectory: from above, its height, gaps in tracking, and errors if there is a score.

        Args:
            file: The picture to write: .png, .pdf or .svg.

        Raises:
            StereovoxError: Unknown suffix, a file that cannot be written, or no frame has a pose.
        """
        from stereovox.view.figures import save
        from stereovox.view.trajectory import score_figure, way_figure

        known = self.poses()
        if self.score is not None:
            save(score_figure(self.score), file)
        else:
            positions = np.where(self.tracked[:, None], self.T_world_sensor[:, :3, 3], np.nan)
            heading = (
                f"{known.where}: {int(self.tracked.sum()):,} of {len(self.tracked):,} frames, {self.length_m:.2f} m"
            )
            save(way_figure(positions, self.tracked, heading), file)

    def summary(self) -> dict[str, Any]:
        """Summarise the run.

        Returns:
            The numbers of `stereovox track --json`.
        """
        stamps, tracked = self.stamps_ns, int(self.tracked.sum())
        score = self.score
        return {
            "frames": len(stamps),
            "tracked": tracked,
            "frames_lost": len(stamps) - tracked,
            "seconds": float(np.ptp(stamps)) / 1e9 if len(stamps) else 0.0,
            "length_m": self.length_m,
            "frame_ms": percentiles(self.frame_ms.tolist()),
            "lost": [span.as_dict() for span in self.lost],
            "doubts": [{"kind": LOST, **span.as_dict()} for span in self.lost],
            **({"imu": self.imu} if self.imu else {}),
            **({} if score is None else {"score": score.as_dict()}),
        }


@dataclass(frozen=True, kw_only=True)
class TrackOptions(RunOptions):
    """Options of `track_recording`, in addition to `RunOptions`; without a profile, a survey suggests the range.

    Attributes:
        frames: Python slice that selects frames: `"::4"`.
        camera: Camera file that replaces the recording's own.
    """

    frames: str | None = None
    camera: str | Path | None = None


@takes(TrackOptions)
def track_recording(
    source: str | Path | Stream, out: str | Path | None = None, *, progress: Progress = no_progress, **options: Any
) -> CameraTrack:
    """Find the poses of a camera from its own depth images or stereo pairs.

    They are the poses that `map_recording` with `poses="track"` uses with the same settings.

    Args:
        source: As for `open_source`, a live camera (`realsense:`), or a `Stream` of your own. Its own poses serve only
            for comparison.
        out: File to write the poses to (`.tum` or `.txt`), all or nothing; None: no file.
        progress: Called with frames done, their number (0 for a live camera), and the current step.
        **options: Fields of `TrackOptions`, and settings by name, as for `Mapper`.

    Returns:
        The pose of each frame, and the gaps in tracking.

    Raises:
        StereovoxError: One line: invalid source, settings or file, or not one frame could be tracked.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two frames after writing the poses so far.
    """
    with _TrackRun(source, out, progress, TrackOptions.of(options)) as run:
        found = run.finish()
        return replace(found, score=_score(found, run.own_poses()))


class _TrackRun(Run[tuple[AnyFrame, Tracked], CameraTrack]):
    """A run whose steps are frames with their tracked poses."""

    def __init__(self, source: str | Path | Stream, out: str | Path | None, progress: Progress, options: TrackOptions):
        super().__init__(options.notify)
        self._source, self._out, self._progress, self._options = source, out, progress, options
        self._spans, self._any = LostSpans(), False
        self._stamps: list[int] = []
        self._tracked: list[Tracked] = []
        self._given: list[NDArray[np.float64]] = []

    def _begin(self, stack: ExitStack) -> None:
        self._target = None if self._out is None else check_file(str(self._out), TRAJECTORY_ENDINGS)
        stream = choose_poses(self._source, self._options.frames, TRACK).source
        camera = self._options.camera
        self._stream = stream = stream if camera is None else with_camera(stream, str(camera))
        config, lines = self._suggested()
        imu, line = imu_and_note(stream)
        for note in (*stream.notes, *lines, *filter(None, [line])):
            self._notify(f"note: {note}")
        self._tracker = Tracker(config, start=level_start(stream, config), imu=imu)
        self._checkpoints = Checkpoints(self._save, self._target, 0)

    def _suggested(self) -> tuple[Config, list[str]]:
        """Return the settings, including those that the recording suggests, and lines about these."""
        profile, given, stream = self._options.profile, self._options.settings, self._stream
        if profile is not None or not isinstance(stream, Source):
            return load_config("default" if profile is None else profile, **given), []
        found = replace(survey(stream, SURVEYED), up=None)
        chosen, lines = found.settings(given)
        return load_config("default", **{**given, **chosen}), lines

    def _steps(self) -> Iterable[tuple[AnyFrame, Tracked]]:
        self._ends = [perf_counter()]
        noted = self._noting(self._stream)
        return follow(noted if self._stream.length is None else expecting(self._tracker.expect, noted), self._tracker)

    def _noting(self, frames: Iterable[AnyFrame]) -> Iterator[AnyFrame]:
        """Yield frames, and record their own poses."""
        for frame in frames:
            self._given.append(_own_pose(frame))
            yield frame

    def _take(self, step: tuple[AnyFrame, Tracked]) -> None:
        frame, tracked = step
        self._spans.add(frame.stamp_ns, tracked.lost)
        self._stamps.append(frame.stamp_ns)
        self._tracked.append(tracked)
        self._any |= not tracked.lost
        self._ends.append(perf_counter())
        self._progress(self._spans.frames, self._stream.length or 0, DOING)

    @property
    def _kept(self) -> int:
        """Number of frames whose poses would be saved."""
        return self._spans.frames if self._any and self._target is not None else 0

    def _stopped_line(self) -> str:
        return f"stopped after {self._spans.frames} frames; their poses are saved in {self._target}"

    def _save(self) -> None:
        if self._target is not None:
            self._found().save(self._target)

    def _found(self) -> CameraTrack:
        """Return the trajectory so far."""
        nowhere = np.full((4, 4), np.nan)
        poses = [nowhere if tracked.lost else tracked.T_world_sensor for tracked in self._tracked]
        return CameraTrack(
            self._stream.name,
            np.array(self._stamps, np.int64),
            np.array(poses).reshape(-1, 4, 4),
            np.array([tracked.covariance for tracked in self._tracked]).reshape(-1, 6, 6),
            tuple(self._spans.spans),
            1e3 * np.diff(self._ends),
            imu=self._tracker.imu_use,
        )

    def _end(self) -> CameraTrack:
        for line in filter(None, (self._tracker.picture_use(), self._tracker.imu_use)):
            self._notify(f"note: {line}")
        found = self._found()
        if not found.tracked.any():
            why = found.lost[0].why if found.lost else "it is empty"
            raise StereovoxError(f"{self._stream.name}: not one frame could be tracked; nothing is written ({why})")
        self._save()
        return found

    def own_poses(self) -> NDArray[np.float64]:
        """Return the recording's own poses (N, 4, 4), NaN for missing ones."""
        given = np.array(self._given).reshape(-1, 4, 4)
        if self._stream.posed and np.isfinite(given).any():
            return given
        nothing = np.full_like(given, np.nan)
        if not isinstance(self._source, str | Path) or self._stream.length is None:
            return nothing
        try:
            own = _own_poses(open_source(self._source, self._options.frames))
        except StereovoxError:
            return nothing
        return own if len(own) == len(given) else nothing


def _own_poses(source: Source) -> NDArray[np.float64]:
    """Return the poses (N, 4, 4) of a recording, NaN for missing ones; if possible without reading its images."""

    def pose(i: int) -> Transform:
        try:
            return np.asarray(source.pose(i), float)
        except FrameRefused:
            return np.full((4, 4), np.nan)

    return np.array(list(prefetch(pose, len(source)))).reshape(-1, 4, 4)


def _own_pose(frame: AnyFrame) -> NDArray[np.float64]:
    return np.full((4, 4), np.nan) if frame.fault else np.asarray(frame.T_world_sensor, float)


def _score(found: CameraTrack, given: NDArray[np.float64]) -> TrajectoryScore | None:
    """Compare with the recording's own poses; None if there are too few, or the camera does not move."""
    known = np.isfinite(given).all(axis=(1, 2))
    if not known.any():
        return None
    try:
        return score_trajectory(found.poses(), Poses(found.stamps_ns[known], given[known], where=found.name))
    except StereovoxError:
        return None
