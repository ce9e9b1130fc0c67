# SPDX-License-Identifier: Apache-2.0
"""Topics of localisation, with the names of Nav2's AMCL: pose, particles and transform out, an initial pose in.

Publish the robot's pose: odometry, and the transform of REP 105.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereovox.errors import StereovoxError
from stereovox.geometry import se2
from stereovox.geometry.se3 import Transform
from stereovox.ros.options import Options
from stereovox.ros.outputs import header, latched_qos
from stereovox.ros.poses.localization import LocalizedPoses, Localizer, Located, MapLocalization
from stereovox.ros.poses.tf_message import packed_transforms, tf_message
from stereovox.ros.poses.tracking import Moved
from stereovox.sources.bags.robot_messages import frame_name

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


POSE, PARTICLES, INITIAL, ANYWHERE = "amcl_pose", "particlecloud", "initialpose", "reinitialize_global_localization"
"""Topics, and the service."""
PLANE = np.ix_((0, 1, 5), (0, 1, 5))
"""Rows and columns of x, y and yaw in a covariance of ROS."""
LEAST_STD = np.array([0.05, 0.05, 0.02])
"""Least standard deviations of an initial pose, in metres, metres and radians."""


def pose_message(found: Located, frame_id: str) -> Any:
    """Return a `geometry_msgs/PoseWithCovarianceStamped`: on the floor, with covariance of x, y and yaw alone."""
    from geometry_msgs.msg import PoseWithCovarianceStamped

    message = PoseWithCovarianceStamped(header=header(found.stamp_ns, frame_id))
    _lay(message.pose.pose, found.pose_map_base)
    covariance = np.zeros((6, 6))
    covariance[PLANE] = found.covariance
    message.pose.covariance = covariance.ravel()
    return message


def particles_message(found: Located, frame_id: str) -> Any:
    """Return a `geometry_msgs/PoseArray` of the particles."""
    from geometry_msgs.msg import Pose, PoseArray

    poses = [Pose() for _ in range(len(found.particles))] if found.particles is not None else []
    for message, pose in zip(poses, found.particles if found.particles is not None else (), strict=True):
        _lay(message, pose)
    return PoseArray(header=header(found.stamp_ns, frame_id), poses=poses)


def pose_of_message(message: Any) -> tuple[se2.Pose, NDArray[np.float64]]:
    """Return the pose (3,) and the standard deviations (3,) in a `PoseWithCovarianceStamped`; raises StereovoxError."""
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    quaternion = np.array([turn.x, turn.y, turn.z, turn.w])
    yaw = np.arctan2(2 * (turn.w * turn.z + turn.x * turn.y), 1 - 2 * (turn.y**2 + turn.z**2))
    pose = np.array([place.x, place.y, yaw])
    variances = np.reshape(message.pose.covariance, (6, 6))[PLANE].diagonal()
    if not (np.isfinite(pose).all() and abs(np.linalg.norm(quaternion) - 1) < 0.01):
        raise StereovoxError(f"/{INITIAL}: its pose is invalid; send x, y in metres and a quaternion of length 1")
    if not (np.isfinite(variances).all() and (variances >= 0).all()):
        raise StereovoxError(f"/{INITIAL}: variances {variances.tolist()}; send finite ones of at least 0")
    return pose, np.maximum(np.sqrt(variances), LEAST_STD)


class LocationTopics:
    """Publishes the robot's pose.

    `/tf`: map -> odom, with each scan, dated `ros.tf_tolerance_s` ahead, as Nav2's AMCL does: users of the newest pose
    then need not extrapolate. It is silent while the pose is unknown, or while another node publishes the transform; no
    topic gets old data. late: returns why data with a stamp are too old, "" if they are not.
    """

    def __init__(self, node: Any, poses: LocalizedPoses, options: Options, late: Late = never_late):
        from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped

        self._late = late
        self._node, self._poses, self._ahead_ns = node, poses, round(1e9 * options.tf_tolerance_s)
        self._pose = node.create_publisher(PoseWithCovarianceStamped, POSE, latched_qos())
        self._particles = node.create_publisher(PoseArray, PARTICLES, 1)
        self._tf = TransformPublisher(node) if options.publish_tf else None
        if self._tf is not None and not self._tf.works:
            node.get_logger().warning(f"tf2_msgs is not installed: the pose is published on {POSE} alone, not on /tf")

    def publish(self, found: Located) -> None:
        """Publish the robot's pose after a scan."""
        world = self._poses.world
        if old := self._late(found.stamp_ns):
            self._node.get_logger().error(f"{POSE}: not published, {old}", throttle_duration_sec=10.0)
            return
        if found.moved and found.covariance is not None:
            self._pose.publish(pose_message(found, world))
        if found.moved and self._particles.get_subscription_count():
            self._particles.publish(particles_message(found, world))
        if self._tf is None or not found.settled:
            return
        if self._poses.rival:
            said = f"another node publishes {world} -> {self._poses.odom} on /tf, so this one does not; stop one"
            self._node.get_logger().warning(said, throttle_duration_sec=30.0)
            return
        stamp_ns = found.stamp_ns + self._ahead_ns
        self._poses.published(stamp_ns)
        self._tf.publish(stamp_ns, world, self._poses.odom, se2.lifted(found.pose_map_odom))


class InitialPose:
    """Listens to `/initialpose`, and serves `/reinitialize_global_localization`."""

    def __init__(self, node: Any, localizer: Localizer, localization: MapLocalization):
        from geometry_msgs.msg import PoseWithCovarianceStamped
        from std_srvs.srv import Empty

        self._localizer, self._localization, self._log = localizer, localization, node.get_logger()
        node.create_subscription(PoseWithCovarianceStamped, INITIAL, self._placed, 5)
        node.create_service(Empty, ANYWHERE, self._anywhere)

    def _placed(self, message: Any) -> None:
        world, frame_id = self._localizer.poses.world, frame_name(message.header.frame_id)
        try:
            if frame_id != world:
                raise StereovoxError(f"/{INITIAL}: in frame '{frame_id}'; send it in '{world}'")
            pose, std = pose_of_message(message)
            self._localization.place(pose, std)
        except StereovoxError as error:
            self._log.warning(f"pose ignored: {error}")
            return
        self._localizer.forget()
        self._log.info(f"the robot is assumed to be at x {pose[0]:.2f} m, y {pose[1]:.2f} m")

    def _anywhere(self, _: Any, response: Any) -> Any:
        self._localization.place(None)
        self._localizer.forget()
        self._log.info("the robot may be anywhere in the map")
        return response


def _lay(message: Any, pose: se2.Pose) -> None:
    """Fill a `geometry_msgs/Pose` with a pose (3,) on the floor."""
    x, y, yaw = map(float, pose)
    message.position.x, message.position.y = x, y
    message.orientation.z, message.orientation.w = float(np.sin(yaw / 2)), float(np.cos(yaw / 2))
