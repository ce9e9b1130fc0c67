# SPDX-License-Identifier: Apache-2.0
"""Poses of a running robot: waited for, interpolated, never made up."""

import numpy as np
import pytest
import wire

from stereovox.errors import FrameRefused, StereovoxError
from stereovox.geometry.se3 import from_quaternion
from stereovox.ros.poses import poses
from stereovox.ros.poses.poses import LiveTf, PoseBuffer, fixed_transform

MS = 1_000_000
START = 10**12


def at(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def tf(stamp_ns: int, *edges) -> bytes:
    return wire.packed(wire.messages().transforms(stamp_ns, edges))


@pytest.fixture
def robot():
    """odom -> base_link at 0 m and, 100 ms later, at 1 m; the camera is mounted 0.5 m ahead."""
    where = PoseBuffer("", "", 0.1)
    where.on_tf(tf(0, ("base_link", "camera", at(0.5))), fixed=True)
    for k in range(2):
        where.on_tf(tf(START + 100 * k * MS, ("odom", "base_link", at(k))), fixed=False)
    return where


def test_a_pose_between_two_transforms_is_settled(robot):
    assert robot.is_final("camera", START + 50 * MS)
    pose = robot.pose("camera", START + 50 * MS)
    assert pose.T_world_sensor[0, 3] == pytest.approx(1.0)
    assert pose.T_base_sensor[0, 3] == pytest.approx(0.5)
    assert (pose.off_ns, robot.world) == (0, "odom")


def test_a_pose_after_the_last_transform_is_not_settled_and_held_for_a_while_only(robot):
    assert not robot.is_final("camera", START + 101 * MS)
    assert robot.pose("camera", START + 150 * MS).off_ns == 50 * MS
    with pytest.raises(FrameRefused, match=r"0\.101 s away"):
        robot.pose("camera", START + 201 * MS)


def test_a_robot_that_stood_still_is_not_taken_for_one_that_cannot_move():
    where = PoseBuffer("", "", 0.1)
    for k in range(5):
        where.on_tf(tf(START + 100 * k * MS, ("odom", "camera", at(2.0))), fixed=False)
    assert not where.is_final("camera", START + 450 * MS)
    with pytest.raises(FrameRefused):
        where.pose("camera", START + 600 * MS)


def test_a_gap_is_not_bridged(robot):
    robot.on_tf(tf(START + 700 * MS, ("odom", "base_link", at(9))), fixed=False)
    assert robot.is_final("camera", START + 300 * MS)
    with pytest.raises(FrameRefused, match=r"no transform for 0\.600 s"):
        robot.pose("camera", START + 300 * MS)


def test_unknown_frames_are_refused_with_a_cure(robot):
    assert not robot.is_final("kamera", START)
    with pytest.raises(FrameRefused, match="kamera"):
        robot.pose("kamera", START)
    with pytest.raises(FrameRefused, match="world_frame"):
        PoseBuffer("", "", 0.1).pose("camera", START)


def test_the_map_frame_counts_before_odom_and_a_named_one_before_both(robot):
    robot.on_tf(tf(START, ("map", "odom", at(10))), fixed=True)
    assert robot.pose("camera", START).T_world_sensor[0, 3] == pytest.approx(10.5)
    assert robot.world == "map"
    named = PoseBuffer("odom", "", 0.1)
    named.tf = robot.tf
    assert named.pose("camera", START).T_world_sensor[0, 3] == pytest.approx(0.5)


def test_odometry_and_poses_count_like_transforms():
    where = PoseBuffer("", "base_link", 0.1)
    where.tf.add("base_link", "camera", 0, fixed_transform("base_link camera 0 0 1 0 0 0")[2], fixed=True)
    for k in range(2):
        told = wire.messages().odometry(np.array([k, 2.0, 0.0]), START + 100 * k * MS, "odom", "base_link")
        where.on_odometry(wire.packed(told))
    assert where.pose("camera", START + 25 * MS).T_world_sensor[:3, 3] == pytest.approx([0.25, 2, 1])
    posed = PoseBuffer("", "", 0.1)
    stamped = wire.made(
        "geometry_msgs/msg/PoseStamped", header=wire.header(START, "odom"), pose=wire.messages()._pose(at(3.0))
    )
    posed.on_pose(wire.packed(stamped), "camera")
    assert posed.pose("camera", START).T_world_sensor[0, 3] == 3


def test_damaged_messages_are_counted_and_change_nothing(robot):
    whole = tf(START, ("odom", "base_link", at(7)))
    for data in (b"", whole[:3], whole[:-1], b"\xff" * 40):
        robot.on_tf(data, fixed=False)
        robot.on_odometry(data)
        robot.on_pose(data, "camera")
    assert robot.tf.unreadable >= 9
    assert robot.pose("camera", START).T_world_sensor[0, 3] == pytest.approx(0.5)


def test_old_transforms_go_and_a_clock_that_is_set_back_starts_anew(monkeypatch):
    monkeypatch.setattr(poses, "MAX_TRANSFORMS", 300)
    tree = LiveTf()
    for k in range(5 * 300):
        tree.add("odom", "base", START + k * MS, (k, 0, 0, 0, 0, 0, 1))
    edge = tree._up("base")
    assert edge.count <= 300
    last = START + (5 * 300 - 1) * MS
    assert tree.lookup("odom", "base", last - 100 * MS)[0, 3] == pytest.approx(5 * 300 - 101)
    tree.add("odom", "base", START, (-5, 0, 0, 0, 0, 0, 1))
    assert tree.lookup("odom", "base", START)[0, 3] == -5
    with pytest.raises(FrameRefused):
        tree.lookup("odom", "base", last)


def test_a_late_transform_is_put_where_it_belongs(robot):
    robot.on_tf(tf(START + 50 * MS, ("odom", "base_link", at(0))), fixed=False)
    assert robot.pose("camera", START + 75 * MS).T_world_sensor[0, 3] == pytest.approx(1.0)


def test_fixed_transforms_are_read_as_static_transform_publisher_does():
    parent, child, numbers = fixed_transform("base_link eye 1 2 3 0.3 -0.2 0.1")
    assert (parent, child, numbers[:3]) == ("base_link", "eye", (1, 2, 3))

    def about(axis: int, angle: float) -> np.ndarray:
        a, b = [k for k in range(3) if k != axis]
        R = np.eye(3)
        R[a, a] = R[b, b] = np.cos(angle)
        R[a, b], R[b, a] = (-np.sin(angle), np.sin(angle)) if axis != 1 else (np.sin(angle), -np.sin(angle))
        return R

    expected = about(2, 0.3) @ about(1, -0.2) @ about(0, 0.1)
    np.testing.assert_allclose(from_quaternion(numbers[:3], numbers[3:])[:3, :3], expected, atol=1e-12)
    for bad in ("", "a b 1 2 3", "a b 1 2 3 4 5 x", "a b 1 2 3 4 5 6 7", "a b 1 2 nan 4 5 6", "a a 1 2 3 4 5 6"):
        with pytest.raises(StereovoxError, match=r"ros\.fixed"):
            fixed_transform(bad)
