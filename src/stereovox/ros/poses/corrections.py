# SPDX-License-Identifier: Apache-2.0
"""Correct the growing map: by paths that a SLAM program publishes, or by jumps of odometry in the map."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Mapping as Table
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.correct.corrected_poses import SLIGHT, OdometryJumps, noticeable, poses_by_path
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Frame, Rays
from stereovox.geometry.se3 import Transform, inverse
from stereovox.mapping.rebuild import FrameKey
from stereovox.maps.record.kept_frames import KeptFrame
from stereovox.ros.inputs import Input, header
from stereovox.ros.mapping import Mapping
from stereovox.ros.options import PREFIX, Options, split_pair
from stereovox.ros.poses.poses import PoseBuffer
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import frame_name, read_path
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import transforms

AGAIN_S = 10.0
"""Seconds between warnings of one kind."""


class Corrector(Protocol):
    """Records the frames of the map, and requests corrections."""

    def seen(self, sensor: Input, frame_id: str, frame: Frame | Rays, in_map: bool) -> None:
        """Record a frame that has a pose. frame_id: the frame of its message."""
        ...

    def forget(self) -> None:
        """Discard the frames, for another map begins."""
        ...


def corrector_of(node: Any, mapping: Mapping, poses: PoseBuffer, options: Options) -> Corrector | None:
    """Return the corrector of the options, None for none."""
    if options.corrected_path:
        return PathCorrections(mapping, poses, options, node.get_logger())
    return JumpCorrections(mapping, poses, options.odom_frame, node.get_logger()) if options.correct_jumps else None


class PathCorrections:
    """Moves frames to their poses in published paths (`nav_msgs/Path`); see `poses_by_path`.

    Attributes:
        topic: The topic of the paths.
    """

    def __init__(self, mapping: Mapping, poses: PoseBuffer, options: Options, log: Any):
        self.topic, self._body = options.corrected_path, frame_name(options.path_frame)
        topics = *options.depth, *options.cloud, *options.scan, *options.range
        self._first = split_pair(topics[0])[0] if topics else ""
        self._mapping, self._poses, self._log = mapping, poses, log
        self._sensors: dict[str, str] = {}

    def seen(self, sensor: Input, frame_id: str, frame: Frame | Rays, in_map: bool) -> None:
        """Remember the frame of a topic's messages."""
        self._sensors[sensor.topic] = frame_id
        if sensor.topic == self._first and not self._body:
            self._body = frame_id

    def forget(self) -> None:
        """Keep everything: frame names do not change with the map."""

    def on_path(self, data: bytes) -> None:
        """Request a correction by a path; it replaces one that has not begun yet."""
        try:
            _check_stamps(read_path(Wire(data, cdr=True), 2)[0])  # at once: it must not replace a better one that waits
            mounts = self._mounts(header(data)[1])
        except ValueError as error:  # a damaged message too
            self._log.warning(f"the path on {self.topic} is not used: {error}", throttle_duration_sec=AGAIN_S)
            return
        if mounts:
            self._mapping.correct(partial(_by_path, data, self.topic, mounts, self._mapping.config), newest_only=True)

    def _mounts(self, frame_id: str) -> dict[str, Transform]:
        """Return T_body_sensor of the topics, empty before the first frame; raises StereovoxError if the path is not in
        the map's frame, or if no sensor is mounted on the body whose poses it holds.
        """
        if not (self._sensors and self._body):
            return {}
        world, body = self._poses.world, self._body
        if frame_id not in ("", world):
            raise StereovoxError(f"it is in frame {frame_id}, but the map in {world}; give --world-frame {frame_id}")
        mounts = {}
        for topic, sensor in self._sensors.items():
            T_body_sensor = self._fixed(body, sensor)
            if T_body_sensor is not None:
                mounts[topic] = T_body_sensor
        if not mounts:
            raise StereovoxError(
                f"no fixed transform from {body} to a sensor; publish it on /tf_static or give --fixed"
            )
        return mounts

    def _fixed(self, body: str, frame_id: str) -> Transform | None:
        """Return T_body_frame (4, 4), None if it is unknown or moves."""
        tf = self._poses.tf
        if body == frame_id:
            return np.eye(4)
        if not tf.connected(body, frame_id) or tf.moving(body, frame_id):
            return None
        return tf.lookup(body, frame_id, 0)


class JumpCorrections:
    """Spreads a jump of odometry's frame in the map over the path since the last one; see `OdometryJumps`.

    odom: odometry's frame.
    """

    def __init__(self, mapping: Mapping, poses: PoseBuffer, odom: str, log: Any):
        self._mapping, self._poses, self._odom, self._log = mapping, poses, frame_name(odom), log
        self._jumps = OdometryJumps(min(mapping.config.cell), mapping.config.max_range)

    def seen(self, sensor: Input, frame_id: str, frame: Frame | Rays, in_map: bool) -> None:
        """Request a correction when a frame shows that a jump has ended."""
        try:
            T_odom_sensor = self._place(frame_id, frame.stamp_ns)
        except FrameRefused as error:
            self._log.warning(f"jumps cannot be detected: {error}", throttle_duration_sec=AGAIN_S)
            return
        T_map_odom = frame.T_world_sensor @ inverse(T_odom_sensor)
        poses = self._jumps.add(sensor.topic, frame.stamp_ns, T_map_odom, T_odom_sensor, in_map=in_map)
        if poses:
            self._mapping.correct(lambda frames: poses)

    def forget(self) -> None:
        """Discard the frames, for another map begins."""
        self._jumps.forget()

    def _place(self, frame_id: str, stamp_ns: int) -> Transform:
        if self._poses.world == self._odom:
            raise FrameRefused("no_pose", f"the map is in {self._odom} itself; give --world-frame map")
        return self._poses.tf.lookup(self._odom, frame_id, stamp_ns)


def _by_path(
    data: bytes, topic: str, mounts: Table[str, Transform], config: Config, frames: Sequence[KeptFrame]
) -> dict[FrameKey, Transform]:
    """Return the poses of frames that a path moves noticeably. Raises StereovoxError if it cannot be used."""
    try:
        stamps, numbers = read_path(Wire(data, cdr=True))
        _check_stamps(stamps)
    except ValueError as error:  # a damaged message too
        raise StereovoxError(f"the path on {topic} is not used: {error}") from None
    if not len(stamps):
        return {}
    found = poses_by_path(frames, Poses(stamps, transforms(numbers), where=topic), mounts)
    if not found.poses:
        raise StereovoxError(
            f"{topic}: none of its poses, from {_span(stamps.tolist())} s, has the stamp of a frame of the map, from "
            f"{_span(frame.stamp_ns for frame in frames)} s; do its poses have the stamps of their images?"
        )
    return noticeable(frames, found.poses, SLIGHT * min(config.cell), config.max_range)


def _check_stamps(stamps: NDArray[np.int64]) -> None:
    """Raise StereovoxError if several poses have one stamp: it is unknown which of them belongs to the image."""
    if len(np.unique(stamps)) < len(stamps):
        raise StereovoxError("several of its poses have the same stamp; use the stamps of their images: docs/ros2.md")


def _span(stamps_ns: Iterable[int]) -> str:
    stamps = sorted(stamps_ns)
    return f"{stamps[0] / 1e9:.3f} to {stamps[-1] / 1e9:.3f}"


def check_corrections(options: Options, config: Config) -> None:
    """Raise StereovoxError, one line, if a map cannot be corrected as requested."""
    asked = _asked(options)
    if not asked:
        return
    if options.corrected_path and options.correct_jumps:
        raise StereovoxError("--corrected-path, --correct-jumps: a path makes jumps redundant; give the path alone")
    if options.poses != "given":
        raise StereovoxError(f"{asked}: is not used with --poses {options.poses}; leave one of them out")
    if not config.map.keep_frames:
        raise StereovoxError(f"{asked}: needs a 3-D map that keeps its frames; add --set map.keep_frames=true")
    if options.correct_jumps and frame_name(options.world_frame) == frame_name(options.odom_frame):
        odom = options.odom_frame
        raise StereovoxError(f"{asked}: the map is in {odom} itself; give --world-frame map, or {PREFIX}odom_frame")


def _asked(options: Options) -> str:
    if options.corrected_path:
        return f"--corrected-path {options.corrected_path}"
    return "--correct-jumps" if options.correct_jumps else ""
