# SPDX-License-Identifier: Apache-2.0
"""A depth camera and a tracking camera that move together (Chien 2020: D435 and T265), each with its own clock."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import Frame
from stereovox.geometry.se3 import Transform
from stereovox.sources.bags import suffix_of
from stereovox.sources.base import DepthSource
from stereovox.sources.poses.poses import Poses, seconds_from_ns
from stereovox.sources.poses.tracker import jumps, on_clock, read_tracker
from stereovox.sources.rgbd.folder import UNIT_NOTE
from stereovox.sources.rigs.pair_file import FILE, PairSettings, read_pair

NEAR_JUMP_NS = 100_000_000
"""Frames this near (0.1 s) to a jump, on either side, are refused: a tracker is rarely right just before one."""
MAX_ATTEMPTS = 5
"""Images tried at each end of the recording for a valid stamp."""
CALIBRATE = "stereovox calibrate pair"
OpenDepth = Callable[[Path, PairSettings], DepthSource]
"""Opens the depth images named in a pair's settings; see `opening.open_depth`."""


class CameraPair(DepthSource):
    """A folder with `pair.toml` (see `PairSettings`): depth images, and the poses of a tracker next to them.

    The depth images can be any other recording, so the class receives the function that opens them.

    Pose of an image: the tracker's, interpolated at the image's time on the depth camera's clock, times
    T_tracker_camera. World: set by `world`; gravity is left to the tracker.
    Faults in addition to the depth source's: `no_pose` and `bad_pose_file` (see `Poses.at`), `low_confidence` (a pose
    next to the image's time is below `min_confidence`), `pose_jump` (the image was taken within 0.1 s of a jump).
    After a jump the tracker's new poses are used unchanged: a T265 jumps when it recognises a place, and is then closer
    to its first visit there. The map of the time just before the jump is not corrected.

    Args:
        where: The folder.
        open_depth: Opens the depth images named in the settings; usually `opening.open_depth`.

    Raises:
        SourceError: A bad `pair.toml`, no T_tracker_camera, depth images or poses that cannot be opened, or clocks
            without a common time.
    """

    layout = f"a camera pair ({FILE} that names depth images and a tracker's poses)"

    composite = True

    def __init__(self, where: str | os.PathLike[str], open_depth: OpenDepth):
        self.folder = Path(where)
        self.name = self.folder.resolve().name
        file = self.folder / FILE
        settings = read_pair(file)
        if settings.T_tracker_camera is None:
            raise SourceError(f"{file}: T_tracker_camera is missing; find it with: {CALIBRATE} {self.folder}")
        self._T_tracker_camera = settings.T_tracker_camera
        self._min_confidence = settings.min_confidence
        self._depth = open_depth(self.folder, settings)
        self.camera = self._depth.camera
        self._poses = open_poses(self.folder, settings)
        check_clocks(image_times(self._depth), self._poses, file)
        self._jumps = jumps(self._poses, settings.max_speed_mps, settings.max_turn_dps)
        self.notes = (*self._depth.notes, *self._jump_note())

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with a `pair.toml`."""
        return os.path.isfile(os.path.join(where, FILE))

    def __len__(self) -> int:
        return len(self._depth)

    def frame(self, i: int) -> Frame:
        """Return frame `i` of the depth camera with the tracker's pose, or with a `fault`."""
        frame = self._depth.frame(i)
        if frame.fault:
            return frame
        try:
            return replace(frame, T_world_sensor=self.pose_at(frame.stamp_ns))
        except FrameRefused as refused:
            no_pose = np.full((4, 4), np.nan)
            return replace(frame, T_world_sensor=no_pose, fault=refused.reason, fault_detail=f"{frame.name}: {refused}")

    def pose_at(self, stamp_ns: int) -> Transform:
        """Return T_world_camera (4, 4) at a time of the depth camera's clock; raises FrameRefused (see the class)."""
        poses = self._poses
        T_world_tracker = poses.at(stamp_ns)
        around = list(poses.neighbours(stamp_ns))
        if poses.confidence is not None and not poses.confidence[around].min() >= self._min_confidence:  # also NaN
            found = f"confidence is {poses.confidence[around].min():g} at {seconds_from_ns(stamp_ns)} s"
            raise FrameRefused(
                "low_confidence", f"{poses.where}: {found}, below min_confidence {self._min_confidence:g}"
            )
        self._check_jumps(stamp_ns)
        return T_world_tracker @ self._T_tracker_camera

    def _check_jumps(self, stamp_ns: int) -> None:
        """Raise FrameRefused for an image taken near a jump."""
        before, after = self._poses.stamps_ns[self._jumps].T
        near = (before - NEAR_JUMP_NS < stamp_ns) & (stamp_ns < after + NEAR_JUMP_NS)
        if near.any():
            k = int(np.argmax(near))
            when = f"{self._jump_steps()[k]:.2f} m at {seconds_from_ns(int(before[k]))} s"
            raise FrameRefused(
                "pose_jump", f"{self._poses.where}: the pose jumps by {when}; see max_speed_mps in {FILE}"
            )

    def _jump_steps(self) -> NDArray[np.float64]:
        """Return the distance (K,) in metres that the pose moves in each jump."""
        before, after = np.moveaxis(self._poses.T_world_body[self._jumps, :3, 3], 1, 0)
        return np.linalg.norm(after - before, axis=1)

    def _jump_note(self) -> tuple[str, ...]:
        if not len(self._jumps):
            return ()
        largest = self._jump_steps().max()
        count = f"{len(self._jumps)} jumps" if len(self._jumps) > 1 else "one jump"
        consequence = "images near jumps are left out, later ones are used unchanged"
        return (f"{self._poses.where}: {count} of up to {largest:.2f} m; {consequence}",)


def open_poses(folder: Path, settings: PairSettings) -> Poses:
    """Return the poses of a pair's tracker on the depth camera's clock, in the world and axes of the map."""
    where = os.path.join(folder, settings.poses)
    if suffix_of(where.partition("?")[0]):  # a recorded file, perhaps with a topic behind its name
        from stereovox.sources.bags.recording import tracker_poses

        poses = tracker_poses(where, settings.axes, settings.world)
    else:
        poses = read_tracker(Path(where), settings.axes, settings.world)
    return on_clock(poses, settings.clock_offset_s, settings.clock_rate)


def image_times(depth: DepthSource) -> tuple[int, int]:
    """Return the times in nanoseconds of the first and of the last image.

    A damaged message of a recording has only its recording time, perhaps of another clock: the stamp of an intact one
    among the first or last few is preferred.
    """
    few = range(min(MAX_ATTEMPTS, len(depth)))
    return _stamp(depth, few), _stamp(depth, [-1 - i for i in few])


def _stamp(depth: DepthSource, numbers: Sequence[int]) -> int:
    for i in numbers:
        frame = depth.frame(i)
        if frame.depth.size:
            return frame.stamp_ns
    return depth.frame(numbers[0]).stamp_ns


def check_clocks(image_ns: tuple[int, int], poses: Poses, file: Path) -> None:
    """Raise SourceError if images and poses have no time in common."""
    pose_ns = int(poses.stamps_ns[0]), int(poses.stamps_ns[-1])
    if image_ns[0] > pose_ns[1] or pose_ns[0] > image_ns[1]:
        ours, theirs = (f"{seconds_from_ns(a)} to {seconds_from_ns(b)} s" for a, b in (image_ns, pose_ns))
        raise SourceError(
            f"{file}: the clocks do not overlap: images from {ours}, poses with clock_offset_s from {theirs}; "
            f"set clock_offset_s or find it with: {CALIBRATE} {file.parent}"
        )


class CorrectedDepth(DepthSource):
    """A depth source with the unit or baseline of `pair.toml` instead of its own."""

    def __init__(self, source: DepthSource, settings: PairSettings):
        self._source, self._scale = source, settings.depth_scale
        self.name = source.name
        told = () if self._scale is None else (UNIT_NOTE,)
        self.notes = tuple(note for note in source.notes if not note.startswith(told))
        self.camera: PinholeCamera = source.camera
        if settings.baseline is not None:
            self.camera = replace(source.camera, baseline=settings.baseline)

    def __len__(self) -> int:
        return len(self._source)

    def frame(self, i: int) -> Frame:
        """Return frame `i` with the unit and baseline of `pair.toml`."""
        frame = self._source.frame(i)
        scale = frame.depth_scale if self._scale is None else self._scale
        return replace(frame, camera=self.camera, depth_scale=scale)
