# SPDX-License-Identifier: Apache-2.0
"""What a live run sends to an autopilot: obstacle distances, and the body's pose if that is asked for."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.frame import AnyFrame, UpdateReport
from stereovox.frame.validate import matrix_of
from stereovox.geometry.se3 import Transform, covariance_at, inverse, orthonormalise, rotation_between
from stereovox.live.stream import LiveStream
from stereovox.mapper import Mapper
from stereovox.mavlink.link import MavlinkLink
from stereovox.mavlink.pose_sender import PoseMessage, PoseSender
from stereovox.mavlink.poses import MavlinkPoses
from stereovox.mavlink.sectors import SectorRules
from stereovox.mavlink.sending import ObstacleSender
from stereovox.products.floor_axes import up_of
from stereovox.sources.poses.live_poses import LivePoses, NewestPose
from stereovox.sources.poses.pose_stream import T_OPTICAL_BODY, PoseStream
from stereovox.track.tracker import POSE_FAULTS

SendPose = Literal["odometry", "vision"]
MESSAGES: dict[str, PoseMessage] = {"odometry": "odometry", "vision": "vision_position_estimate"}


class Autopilot:
    """An output of a live run: an `ObstacleSender`, and a `PoseSender` on the same connection.

    The pose sent is that of the body in the world of the map, turned so that z is up. It comes from the stream of
    poses, from tracking, or, if images bring their poses, from those of the first camera: before the map takes them in.

    Args:
        mapper: The mapper whose map is sent.
        stream: The images; its cameras have mounts.
        connection: A `MavlinkLink`, or the address of one.
        poses: Where poses come from; one from the same address shares the connection.
        send_pose: The pose's message; None: it is not sent.
        pose_rate_hz: As `rate_hz` of `PoseSender`.
        rules: As for `ObstacleSender`.
        notify: Called with each line that a user should see.

    Raises:
        StereovoxError: As for the two senders; `send_pose` is unknown, or the poses are an autopilot's own.
    """

    def __init__(
        self,
        mapper: Mapper,
        stream: LiveStream,
        connection: str | MavlinkLink,
        poses: str | PoseStream | LivePoses | None,
        *,
        send_pose: SendPose | None,
        pose_rate_hz: float,
        rules: SectorRules | None,
        notify: Callable[[str], None],
    ):
        if send_pose is not None and send_pose not in MESSAGES:
            raise StereovoxError(f"send_pose '{send_pose}': give {' or '.join(MESSAGES)}")
        self._stream, self._shared = stream, None
        if isinstance(poses, MavlinkPoses):
            if send_pose is not None:
                raise StereovoxError("send_pose: the poses are an autopilot's own; it would confirm itself")
            if poses.url == connection:
                self._shared, connection = poses, poses.link
        self._obstacles = ObstacleSender(mapper, connection, rules=rules, tell=notify)
        self._pose: PoseSender | None = None
        self._longest_ns = round(1e9 * mapper.config.trust.max_pose_off_s)
        self._R_level_world = rotation_between(up_of(mapper.config), [0, 0, 1])
        try:
            if send_pose is not None:
                message = MESSAGES[send_pose]
                self._pose = PoseSender(self._obstacles.link, message=message, rate_hz=pose_rate_hz, tell=notify)
                stream.on_given = self.given
        except StereovoxError:
            self.close()
            raise

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Take note of what the map took in, and of where the body was."""
        if report.refused:
            return
        T_world_body = frame.T_world_sensor @ inverse(T_OPTICAL_BODY @ self._stream.mount(frame))
        self._obstacles.at(orthonormalise(T_world_body), frame.sensor, stamp_ns=frame.stamp_ns)

    def came(self, newest: NewestPose) -> None:
        """Send a pose of the body that came without an image."""
        self._send(*newest)
        self._obstacles.pose(newest.stamp_ns, newest.T_world_body @ inverse(T_OPTICAL_BODY))

    def given(self, frame: AnyFrame) -> None:
        """Send the pose that an image of the first camera came with."""
        T_world_sensor, sigma = matrix_of(frame.T_world_sensor), frame.pose_sigma
        if T_world_sensor.shape != (4, 4) or frame.fault in POSE_FAULTS or abs(frame.pose_off_ns) > self._longest_ns:
            self._lost(frame.fault_detail or "the image has no pose")
            return
        T_world_body = T_world_sensor @ inverse(self._stream.mount(frame))
        covariance = None
        if any(sigma):
            lever = T_world_body[:3, 3] - T_world_sensor[:3, 3]
            covariance = covariance_at(np.diag(np.repeat(np.square(sigma), 3)), lever)
        self._send(frame.stamp_ns, T_world_body, covariance, 0)

    def finish(self) -> None:
        """Do nothing: sending stops when the map is stale, or with `close`."""

    def close(self) -> None:
        """Stop sending, and close the connection unless it was given."""
        self._stream.on_given = None
        self._obstacles.close()
        if self._shared is not None:
            self._shared.stop()

    def counts(self) -> dict[str, int]:
        """Return what was sent: `obstacle_distances`, `poses_sent` and `pose_resets`."""
        found = {"obstacle_distances": self._obstacles.sent}
        if self._pose is not None:
            found |= {"poses_sent": self._pose.sent, "pose_resets": self._pose.reset_counter}
        return found

    def _send(
        self, stamp_ns: int, T_world_body: Transform, covariance: NDArray[np.float64] | None, quality: int
    ) -> None:
        if self._pose is None:
            return
        R, T = self._R_level_world, np.array(T_world_body)
        T[:3] = R @ T[:3]
        if covariance is not None and covariance.shape == (6, 6):
            turned = np.kron(np.eye(2), R)
            covariance = turned @ covariance @ turned.T
        self._pose.pose(stamp_ns, T, covariance, quality)

    def _lost(self, why: str) -> None:
        if self._pose is not None:
            self._pose.lost(why)
