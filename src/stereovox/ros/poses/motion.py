# SPDX-License-Identifier: Apache-2.0
"""Publish the robot's pose: odometry, and the transform of REP 105."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stereovox.geometry.se3 import Transform
from stereovox.ros.outputs import header
from stereovox.ros.poses.tf_message import packed_transforms, tf_message
from stereovox.ros.poses.tracking import Moved

ODOMETRY = "tracked_odometry"
"""Topic of the odometry."""
ROS_ORDER = np.r_[3:6, 0:3]
"""Rows of our covariances in the order of `geometry_msgs/PoseWithCovariance`: x, y, z, rotation about X, Y, Z."""
Late = Callable[[int], str]
UNKNOWN = 1e9
"""Variance of the speed, which is unknown."""


def never_late(stamp_ns: int) -> str:
    """Return "", since the age of stamps is unknown."""
    return ""


def odometry_message(moved: Moved) -> Any:
    """Return a `nav_msgs/Odometry` without speed; the covariance is along the axes of the frame in the header."""
    from nav_msgs.msg import Odometry

    message = Odometry(header=header(moved.stamp_ns, moved.world), child_frame_id=moved.body)
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    place.x, place.y, place.z = map(float, moved.T_world_body[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_matrix(moved.T_world_body[:3, :3]).as_quat())
    message.pose.covariance = moved.covariance[np.ix_(ROS_ORDER, ROS_ORDER)].ravel()
    message.twist.covariance = (UNKNOWN * np.eye(6)).ravel()
    return message


class TransformPublisher:
    """Publishes transforms on /tf, if `tf2_msgs` or its stand-in is there. node: rclpy's.

    Attributes:
        works: Whether it can.
    """

    def __init__(self, node: Any):
        kind = tf_message()
        self.works = kind is not None
        self._publisher = node.create_publisher(kind, "/tf", 100) if self.works else None

    def publish(self, stamp_ns: int, parent: str, child: str, T_parent_child: Transform) -> None:
        """Publish the pose of frame `child` in `parent`, (4, 4)."""
        if self._publisher is not None:
            self._publisher.publish(packed_transforms(stamp_ns, [(parent, child, T_parent_child)]))


class MotionPublisher:
    """Publishes tracked poses, unless they are old. node: rclpy's; with_tf: also on /tf, unless another node does.

    late: returns why data with a stamp are too old, "" if they are not.
    """

    def __init__(self, node: Any, with_tf: bool, late: Late = never_late):
        from nav_msgs.msg import Odometry

        self._node, self._late = node, late
        self._odometry = node.create_publisher(Odometry, ODOMETRY, 10)
        self._tf = TransformPublisher(node) if with_tf else None
        if self._tf is not None and not self._tf.works:
            node.get_logger().warning(f"tf2_msgs is not installed: poses are published on {ODOMETRY} alone, not on /tf")

    def publish(self, moved: Moved) -> None:
        """Publish a pose."""
        if old := self._late(moved.stamp_ns):
            self._node.get_logger().error(f"{ODOMETRY}: not published, {old}", throttle_duration_sec=10.0)
            return
        self._odometry.publish(odometry_message(moved))
        if self._tf is None:
            return
        if moved.rival:
            text = (
                f"another node publishes {moved.rival} -> {moved.body} on /tf, so this one does not, and the map is in "
                f"its own frame {moved.world}; use those poses (--poses given) or set ros.base_frame"
            )
            self._node.get_logger().warning(text, throttle_duration_sec=30.0)
        else:
            self._tf.publish(moved.stamp_ns, moved.world, moved.body, moved.T_world_body)
