# SPDX-License-Identifier: Apache-2.0
"""Topics of localisation, with the names of Nav2's AMCL: pose, particles and transform out, an initial pose in."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry import se2
from stereovox.ros.options import Options
from stereovox.ros.outputs import header, latched_qos
from stereovox.ros.poses.localization import LocalizedPoses, Localizer, Located, MapLocalization
from stereovox.ros.poses.motion import Late, TransformPublisher, never_late
from stereovox.sources.bags.robot_messages import frame_name

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
