# SPDX-License-Identifier: Apache-2.0
"""Poses without tf: one depth camera is tracked by visual odometry, and all sensors get their poses from it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import Frame
from stereovox.geometry.se3 import Transform, inverse
from stereovox.ros.inputs import DepthInput, PoseLookup
from stereovox.ros.poses.clocks import Pace
from stereovox.ros.poses.poses import LiveEdge, Pose, PoseBuffer
from stereovox.runs.survey import level_pose, level_world
from stereovox.sources.bags.robot_messages import StampedTransform, frame_name
from stereovox.sources.bags.tf import WORLDS
from stereovox.track.stream import posed
from stereovox.track.tracker import Tracker

WORLD = WORLDS[1]
"""Frame of the map unless another is named: its poses may drift, by REP 105."""
ECHOES = 200
"""Most own transforms that are remembered, to recognise them on /tf."""


class Moved(NamedTuple):
    """The pose of the robot.

    world, body: names of frames. T_world_body: (4, 4). covariance: (6, 6) of that, rotation about the body in radians,
    then position in metres, along the world's axes. rival: the body's parent frame by another node, or "".
    """

    stamp_ns: int
    world: str
    body: str
    T_world_body: Transform
    covariance: NDArray[np.float64]
    rival: str


class TrackedPoses(PoseBuffer):
    """Poses from one tracked camera: transforms only give the mounts of sensors on the robot.

    world: frame of the map; "": `odom`. base: frame of the robot; "": `base_footprint` or `base_link`, if the camera is
    mounted on one of them, else the frame that carries the camera. extrapolate_s: as for `PoseBuffer`.
    base_needed: refuse frames of a camera that is not mounted on a robot's frame.

    Attributes:
        body: The frame whose poses are tracked; "" until the first frame decides it.
        on_robot: Whether that is a robot's frame, which is level at the start.
        rival: The parent of that frame by another node; "" without one.
        images: The pace of the camera's images, whose stamps the poses have.
    """

    def __init__(self, world: str, base: str, extrapolate_s: float, base_needed: bool = False):
        super().__init__(world or WORLD, base, extrapolate_s)
        self.body = self.rival = ""
        self.on_robot = False
        self._base_needed, self.images = base_needed, Pace()
        self._track = LiveEdge(self.world, "")
        self._own: deque[int] = deque(maxlen=ECHOES)

    def is_mounted(self, frame_id: str, stamp_ns: int) -> bool:
        """Return whether the mount of a camera on the robot is known and final."""
        body = self.body or self._robot(frame_id)
        if not body:
            return False
        try:
            return body == frame_id or self.tf.off_ns(body, frame_id, stamp_ns) == 0
        except FrameRefused:
            return False

    def mount(self, frame_id: str, stamp_ns: int) -> Transform:
        """Return T_body_sensor (4, 4); the first call decides which frame is the body.

        Raises FrameRefused `no_pose` if the camera is not mounted on it.
        """
        robot = self._robot(frame_id)
        if not (self.body or robot) and self._base_needed:
            cure = f"give --fixed 'base_link {frame_id} x y z yaw pitch roll'"
            raise FrameRefused("no_pose", f"a floor map needs the height of {frame_id} on the robot; {cure}")
        body = self.body or robot or self._carrier(frame_id)
        T_body_sensor = np.eye(4) if body == frame_id else self.tf.lookup(body, frame_id, stamp_ns)
        if not self.body:
            self.body, self.on_robot, self._track = body, bool(robot), LiveEdge(self.world, body)
            self.rival = self.tf.parent(body)
        return T_body_sensor

    def move(self, stamp_ns: int, T_world_body: Transform) -> None:
        """Add a pose of the body."""
        numbers = (*T_world_body[:3, 3], *Rotation.from_matrix(T_world_body[:3, :3]).as_quat())
        self._track.add(stamp_ns, numbers)
        self._own.append(stamp_ns)

    def is_final(self, frame_id: str, stamp_ns: int) -> bool:
        """Return whether the pose of a sensor at a time is final."""
        return self._track.count > 0 and self._track.off_ns(stamp_ns) == 0 and self.is_mounted(frame_id, stamp_ns)

    def pose(self, frame_id: str, stamp_ns: int) -> Pose:
        """Return the pose of a sensor on the robot; raises FrameRefused `no_pose`."""
        if not self._track.count:
            raise FrameRefused("no_pose", f"no image has been tracked yet, so the pose of {frame_id} is unknown")
        T_body_sensor = self.mount(frame_id, stamp_ns)
        T_world_sensor = self._track.at(stamp_ns, self.tf.limits, "tracked") @ T_body_sensor
        return Pose(T_world_sensor, T_body_sensor, self._track.off_ns(stamp_ns))

    def mover(self, frame_id: str) -> LiveEdge | None:
        """Return the edge that holds the tracked poses."""
        return self._track

    def pace(self, frame_id: str) -> Pace | None:
        """Return the pace of the tracked images."""
        return self.images

    def _add(self, one: StampedTransform, fixed: bool = False) -> None:
        own = one.parent == self.world and one.stamp_ns in self._own
        if one.child == self.body and not own:
            self.rival = one.parent
        super()._add(one, fixed)

    def _robot(self, frame_id: str) -> str:
        """Return the robot's frame, "" if the camera is not mounted on one."""
        base = self._base_of(frame_id)
        return base if base != frame_id or frame_id == self._base else ""

    def _carrier(self, frame_id: str) -> str:
        """Return the frame that carries a camera: the highest one that is fixed to it."""
        frame = frame_id
        while (parent := self.tf.parent(frame)) and not self.tf.moving(parent, frame):
            frame = parent
        return frame


class Tracking:
    """Tracks one camera, frame by frame.

    config: settings of the map. moved: called with each tracked pose.

    Attributes:
        tracked: Number of frames that were tracked.
        lost: Number of frames in which tracking was lost.
        state: `waiting`, `tracked`, or `lost: ` and the cause.
    """

    def __init__(self, config: Config, poses: TrackedPoses, moved: Callable[[Moved], None] = lambda moved: None):
        self.tracked, self.lost, self.state = 0, 0, "waiting"
        self.poses, self._config, self._moved = poses, config, moved
        self._tracker: Tracker | None = None
        self._T_body_sensor = np.eye(4)

    def mounted(self, frame_id: str, stamp_ns: int) -> Pose:
        """Return the camera's mount, with an unknown pose in the world. Raises FrameRefused `no_pose`."""
        self._T_body_sensor = self.poses.mount(frame_id, stamp_ns)
        return Pose(np.eye(4), self._T_body_sensor, 0)

    def track(self, frame: Frame) -> Frame:
        """Return a frame that was converted with `mounted`, now with its tracked pose or the fault `tracking_lost`."""
        if frame.fault:
            self.lost, self.state = self.lost + 1, f"lost: {frame.fault_detail}"
            return frame
        if self._tracker is None:
            self._tracker = Tracker(self._config, start=self._start(frame))
        tracked = self._tracker.add(frame)
        self.tracked, self.lost = self.tracked + (not tracked.lost), self.lost + bool(tracked.lost)
        self.state = f"lost: {tracked.lost}" if tracked.lost else "tracked"
        if not tracked.lost:
            self._move(frame.stamp_ns, tracked.T_world_sensor, tracked.covariance)
        return posed(frame, tracked)

    def counts(self) -> Mapping[str, object]:
        """Return values for diagnostics."""
        return {"tracking": self.state, "frames_tracked": self.tracked, "frames_lost": self.lost}

    def _start(self, frame: Frame) -> Transform:
        """Return the camera's first pose: the robot is level at the origin, or the floor in view is level."""
        if self.poses.on_robot:
            return level_world(self._config) @ self._T_body_sensor
        return level_pose(frame, self._config)

    def _move(self, stamp_ns: int, T_world_sensor: Transform, covariance: NDArray[np.float64]) -> None:
        poses, T_world_body = self.poses, T_world_sensor @ inverse(self._T_body_sensor)
        covariance = moved_covariance(covariance, T_world_body[:3, 3] - T_world_sensor[:3, 3])
        poses.move(stamp_ns, T_world_body)
        self._moved(Moved(stamp_ns, poses.world, poses.body, T_world_body, covariance, poses.rival))


class TrackedDepthInput(DepthInput):
    """Depth images of the camera that is tracked."""

    def __init__(self, topic: str, info: str, tracking: Tracking):
        super().__init__(topic, info)
        self._tracking = tracking

    def frame(self, data: bytes, where: PoseLookup) -> Frame:
        """Convert a depth image; its pose is tracked."""
        return self._tracking.track(super().frame(data, where))

    def look_up(self, poses: PoseBuffer) -> PoseLookup:
        """Return the function that gives the camera's mount."""
        return self._tracking.mounted

    def is_final(self, poses: PoseBuffer, frame_id: str, stamp_ns: int) -> bool:
        """Return whether the camera's mount is known."""
        return self._tracking.poses.is_mounted(frame_name(frame_id), stamp_ns)


def moved_covariance(covariance: NDArray[np.float64], offset: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of a rigidly attached point, `offset` (3,) metres away along the world's axes.

    Rotation in radians, then position in metres, along the world's axes.
    """
    x, y, z = offset
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    J = np.block([[np.eye(3), np.zeros((3, 3))], [-across, np.eye(3)]])
    return J @ covariance @ J.T
