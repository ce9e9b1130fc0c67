# SPDX-License-Identifier: Apache-2.0
"""Publish where the robot is: odometry, and the transform of REP 105."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stereovox.ros.library import optional_message
from stereovox.ros.outputs import header
from stereovox.ros.tracking import Moved

ODOMETRY = "tracked_odometry"
"""Topic of the odometry."""
ROS_ORDER = np.r_[3:6, 0:3]
"""Rows of our covariances in the order of `geometry_msgs/PoseWithCovariance`: x, y, z, rotation about X, Y, Z."""
UNKNOWN = 1e9
"""Variance of what is not known: the speed."""


def odometry_message(moved: Moved) -> Any:
    """Return a `nav_msgs/Odometry`; the covariance is along the axes of the frame in the header; no speed."""
    from nav_msgs.msg import Odometry

    message = Odometry(header=header(moved.stamp_ns, moved.world), child_frame_id=moved.body)
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    place.x, place.y, place.z = map(float, moved.T_world_body[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_matrix(moved.T_world_body[:3, :3]).as_quat())
    message.pose.covariance = moved.covariance[np.ix_(ROS_ORDER, ROS_ORDER)].ravel()
    message.twist.covariance = (UNKNOWN * np.eye(6)).ravel()
    return message


def transform_message(kind: Any, moved: Moved) -> Any:
    """Return a `tf2_msgs/TFMessage`, whose class is `kind`, with the pose of the body in the world."""
    from geometry_msgs.msg import TransformStamped

    one = TransformStamped(header=header(moved.stamp_ns, moved.world), child_frame_id=moved.body)
    place, turn = one.transform.translation, one.transform.rotation
    place.x, place.y, place.z = map(float, moved.T_world_body[:3, 3])
    turn.x, turn.y, turn.z, turn.w = map(float, Rotation.from_matrix(moved.T_world_body[:3, :3]).as_quat())
    return kind(transforms=[one])


class MotionPublisher:
    """Publishes tracked poses. node: rclpy's; with_tf: on /tf, too, unless another node does."""

    def __init__(self, node: Any, with_tf: bool):
        from nav_msgs.msg import Odometry

        self._node, self._tf = node, None
        self._odometry = node.create_publisher(Odometry, ODOMETRY, 10)
        self._kind = optional_message("tf2_msgs", "TFMessage") if with_tf else None
        if self._kind is not None:
            self._tf = node.create_publisher(self._kind, "/tf", 100)
        elif with_tf:
            node.get_logger().warning(f"tf2_msgs is not installed: poses are published on {ODOMETRY} alone, not on /tf")

    def publish(self, moved: Moved) -> None:
        """Publish a pose."""
        self._odometry.publish(odometry_message(moved))
        if self._tf is None:
            return
        if moved.rival:
            text = (
                f"another node publishes {moved.rival} -> {moved.body} on /tf: none is published from here, and "
                f"the map is in a frame {moved.world} of its own; use those poses (--poses given) or set ros.base_frame"
            )
            self._node.get_logger().warning(text, throttle_duration_sec=30.0)
        else:
            self._tf.publish(transform_message(self._kind, moved))
