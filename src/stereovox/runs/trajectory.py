# SPDX-License-Identifier: Apache-2.0
"""Track a recording's or live camera's own motion into a trajectory: the Python side of `stereovox track`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.evaluate.summary import percentiles
from stereovox.evaluate.trajectory.trajectory_motions import travelled_m
from stereovox.evaluate.trajectory.trajectory_score import TrajectoryScore, score_trajectory
from stereovox.files.safe_io import check_file
from stereovox.frame import AnyFrame
from stereovox.geometry.se3 import Transform
from stereovox.kernels.threads import expecting
from stereovox.localize.robot_track import Progress, no_progress
from stereovox.opening import open_stream
from stereovox.runs.pose_choice import TRACK, choose_poses
from stereovox.runs.recording import SURVEYED, interrupt_between_steps
from stereovox.runs.survey import level_start, survey
from stereovox.sources.base import Stream, pose_reader
from stereovox.sources.calibration.camera_file import with_camera
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import TRAJECTORY_ENDINGS, write_trajectory
from stereovox.track.gaps import LostSpans, TrackingGap
from stereovox.track.inertial import imu_and_note
from stereovox.track.stream import LOST, follow
from stereovox.track.tracker import Tracked, Tracker

DOING = "tracking"


@dataclass(frozen=True, eq=False)
class CameraTrack:
    """The trajectory of a camera, found from its own images.

    Attributes:
        name: Name of the recording.
        stamps_ns: (N,) int64, time of each frame in nanoseconds.
        T_world_sensor: (N, 4, 4) float64, maps the optical frame into a world that begins at the first image, z up;
            NaN where the camera was lost.
        covariances: (N, 6, 6) float64 of each pose on what was seen before, as `Tracked.covariance`; infinite where
            the camera was lost.
        lost: Where the camera was lost, and why.
        frame_ms: (N,) milliseconds that each frame took.
        score: How far off it is from the poses that the recording has; None without.
        imu: What was made of the IMU, in words; "" without one.
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
        """Metres along the poses; straight where the camera was lost between two."""
        poses = self.T_world_sensor[self.tracked]
        return float(travelled_m(poses)[-1]) if len(poses) else 0.0

    def poses(self) -> Poses:
        """Return the poses that were found, over time.

        Raises:
            SourceError: There is none.
        """
        return Poses(self.stamps_ns[self.tracked], self.T_world_sensor[self.tracked], where=f"{self.name}, tracked")

    def save(self, path: str | Path) -> None:
        """Write the poses that were found as lines `stamp tx ty tz qx qy qz qw` (TUM), all or nothing.

        Args:
            path: The file.

        Raises:
            MapFileError: It cannot be written; an older one is then still there.
        """
        found = self.tracked
        whose = "camera (x right, y down, z forward), tracked"
        write_trajectory(path, self.stamps_ns[found].tolist(), self.T_world_sensor[found], whose)

    def picture(self, file: str | Path) -> None:
        """Draw the way: from above, its height, where the camera was lost, and errors where there is a score.

        Args:
            file: The picture to write: .png, .pdf or .svg.

        Raises:
            StereovoxError: Another suffix, a file that cannot be written, or there is no pose.
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


def track_recording(
    source: str | Path | Stream,
    out: str | Path | None = None,
    *,
    profile: str | Path | Config | None = None,
    frames: str | None = None,
    camera: str | Path | None = None,
    progress: Progress = no_progress,
    notify: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> CameraTrack:
    """Find the poses of a camera from its own depth images or stereo pairs.

    They are the poses that `map_recording` with `poses="track"` uses with the same settings.

    Args:
        source: As for `open_source`, a live camera (`realsense:`), or a `Stream` of your own. Its own poses are only
            compared with.
        out: File to write the poses to (`.tum` or `.txt`), all or nothing; None: none.
        profile: Profile name, TOML file or Config; None: `default` with the range that a quick look at the recording
            suggests.
        frames: Python slice that selects frames: `"::4"`.
        camera: Camera file that replaces the recording's own.
        progress: Called with frames done, their number (0 for a live camera), and the current step.
        notify: Called with each line that a user should see.
        **overrides: Settings by name, as for `Mapper`.

    Returns:
        The pose of each frame, and where the camera was lost.

    Raises:
        StereovoxError: One line: invalid source, settings or file, or not one frame could be tracked.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two frames after writing what was tracked so far.
    """
    target = None if out is None else check_file(str(out), TRAJECTORY_ENDINGS)
    stream = choose_poses(source, frames, TRACK).source
    stream = stream if camera is None else with_camera(stream, str(camera))
    config, lines = _settings(stream, profile, overrides)
    imu, line = imu_and_note(stream)
    for note in (*getattr(stream, "notes", ()), *lines, *filter(None, [line])):
        notify(f"note: {note}")
    run = _Run(stream.name)
    tracker = Tracker(config, start=level_start(stream, config), imu=imu)
    try:
        with interrupt_between_steps() as check:
            noted = run.noting(stream)
            images = noted if stream.length is None else expecting(tracker.expect, noted)
            for frame, tracked in follow(images, tracker):
                run.add(frame, tracked)
                progress(run.spans.frames, stream.length or 0, DOING)
                check()
    except (KeyboardInterrupt, SourceError):
        if _save(run.track(), target):
            notify(f"stopped after {run.spans.frames} frames; their poses are saved in {target}")
        raise
    if tracker.picture_use():
        notify(f"note: {tracker.picture_use()}")
    if tracker.imu_use:
        notify(f"note: {tracker.imu_use}")
    found = replace(run.track(), imu=tracker.imu_use)
    if not found.tracked.any():
        why = found.lost[0].why if found.lost else "it is empty"
        raise StereovoxError(f"{stream.name}: not one frame could be tracked, nothing is written ({why})")
    _save(found, target)
    return replace(found, score=_score(found, run.given(stream, source, frames)))


def _save(found: CameraTrack, target: Path | None) -> bool:
    """Write the poses, if there are any and a file is wanted; return whether they were written."""
    if target is None or not found.tracked.any():
        return False
    found.save(target)
    return True


def _settings(stream: Stream, profile: Any, overrides: dict[str, Any]) -> tuple[Config, list[str]]:
    """Return the settings, those that a recording suggests among them, and lines about these."""
    if profile is not None or stream.length is None or not hasattr(stream, "frame"):
        return load_config("default" if profile is None else profile, **overrides), []
    found = replace(survey(stream, SURVEYED), up=None)  # pyright: ignore[reportArgumentType] - it has frame(i)
    chosen, lines = found.settings(overrides)
    return load_config("default", **{**overrides, **chosen}), lines


class _Run:
    """Collects what is found, frame by frame."""

    def __init__(self, name: str):
        self.spans, self._name = LostSpans(), name
        self._stamps: list[int] = []
        self._tracked: list[Tracked] = []
        self._given: list[NDArray[np.float64]] = []
        self._ends = [perf_counter()]

    def noting(self, frames: Iterable[AnyFrame]) -> Iterator[AnyFrame]:
        """Yield frames, and take note of their own poses."""
        for frame in frames:
            self._given.append(_own_pose(frame))
            yield frame

    def add(self, frame: AnyFrame, tracked: Tracked) -> None:
        """Take note of a frame that was tracked or lost."""
        self.spans.add(frame.stamp_ns, tracked.lost)
        self._stamps.append(frame.stamp_ns)
        self._tracked.append(tracked)
        self._ends.append(perf_counter())

    def track(self) -> CameraTrack:
        """Return what was found so far."""
        nowhere = np.full((4, 4), np.nan)
        poses = [nowhere if tracked.lost else tracked.T_world_sensor for tracked in self._tracked]
        return CameraTrack(
            self._name,
            np.array(self._stamps, np.int64),
            np.array(poses).reshape(-1, 4, 4),
            np.array([tracked.covariance for tracked in self._tracked]).reshape(-1, 6, 6),
            tuple(self.spans.spans),
            1e3 * np.diff(self._ends),
        )

    def given(self, stream: Stream, source: Any, frames: str | None) -> NDArray[np.float64]:
        """Return the recording's own poses (N, 4, 4), NaN if there are none."""
        given = np.array(self._given).reshape(-1, 4, 4)
        if getattr(stream, "posed", True) and np.isfinite(given).any():
            return given
        nothing = np.full_like(given, np.nan)
        if not isinstance(source, str | Path) or stream.length is None:
            return nothing
        try:
            found = open_stream(source, frames)
        except StereovoxError:
            return nothing
        own = _own_poses(found)
        return own if len(own) == len(given) else nothing


def _own_poses(source: Stream) -> NDArray[np.float64]:
    """Return the poses (N, 4, 4) of a recording, NaN if there is none; without its images where it can do so."""
    read = pose_reader(source)
    if read is None:
        poses = [_own_pose(frame) for frame in source]
    else:
        poses = [_pose_or_none(read, i) for i in range(source.length or 0)]
    return np.array(poses).reshape(-1, 4, 4)


def _pose_or_none(read: Callable[[int], Transform], i: int) -> Transform:
    try:
        return np.asarray(read(i), float)
    except FrameRefused:
        return np.full((4, 4), np.nan)


def _own_pose(frame: AnyFrame) -> NDArray[np.float64]:
    return np.full((4, 4), np.nan) if frame.fault else np.asarray(frame.T_world_sensor, float)


def _score(found: CameraTrack, given: NDArray[np.float64]) -> TrajectoryScore | None:
    """Compare with the recording's own poses; None if there are too few, or the camera stands still."""
    known = np.isfinite(given).all(axis=(1, 2))
    if not known.any():
        return None
    try:
        return score_trajectory(found.poses(), Poses(found.stamps_ns[known], given[known], where=found.name))
    except StereovoxError:
        return None
