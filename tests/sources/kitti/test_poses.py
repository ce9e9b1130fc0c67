# SPDX-License-Identifier: Apache-2.0
"""Poses from oxts against cases that are known in closed form."""

from __future__ import annotations

import math

import made_kitti as made
import numpy as np
import pytest

from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry.se3 import inverse, rotation_matrix
from stereovox.sources.kitti.poses import UPRIGHT, FramePoses, StandingPoses, camera_poses, imu_pose, read_pose_file

DEGREE_NORTH = math.radians(1) * 6378137.0
"""Metres along a meridian of the sphere."""


def packet(north_deg=0.0, east_deg=0.0, up=0.0, roll=0.0, pitch=0.0, yaw=0.0, latitude=49.0):
    return np.array([latitude + north_deg, 8.4 + east_deg, 100 + up, roll, pitch, yaw])


def test_a_small_step_north_and_east_is_as_long_as_on_the_globe():
    first, step = (imu_pose(packet(d, 2 * d), math.cos(math.radians(49))) for d in (0, 1e-5))
    moved = step[:3, 3] - first[:3, 3]
    east = 2e-5 * DEGREE_NORTH * math.cos(math.radians(49))
    np.testing.assert_allclose(moved, [east, 1e-5 * DEGREE_NORTH, 0], rtol=1e-5)


def test_roll_pitch_and_yaw_turn_in_kittis_order():
    T = imu_pose(packet(roll=0.1, pitch=0.2, yaw=0.3), 1.0)
    nose = [math.cos(0.3) * math.cos(0.2), math.sin(0.3) * math.cos(0.2), -math.sin(0.2)]
    np.testing.assert_allclose(T[:3, 0], nose)  # pitch up is negative: z is up
    np.testing.assert_allclose(T[2, 1], math.sin(0.1) * math.cos(0.2))
    expected = rotation_matrix([0, 0, 0.3]) @ rotation_matrix([0, 0.2, 0]) @ rotation_matrix([0.1, 0, 0])
    np.testing.assert_allclose(T[:3, :3], expected, atol=1e-12)


def test_driving_north_with_a_camera_that_looks_ahead():
    T_cam0_imu = inverse(UPRIGHT)  # camera and inertial unit at one place
    steps = [packet(north_deg=d, up=up, yaw=math.pi / 2) for d, up in ((0, 0), (1e-5, 0.5), (2e-5, 1.0))]
    poses = FramePoses(camera_poses(steps, T_cam0_imu), "oxts")
    for n in range(3):
        T = poses.at(n)
        np.testing.assert_allclose(T[:3, :3], UPRIGHT[:3, :3], atol=1e-9)
        np.testing.assert_allclose(T[:3, 3], [n * 1e-5 * DEGREE_NORTH, 0, 0.5 * n], atol=1e-6)


def test_turning_on_the_spot_moves_a_camera_on_a_lever_round():
    T_imu_cam0 = UPRIGHT.copy()
    T_imu_cam0[:3, 3] = 2, 0, 0  # two metres ahead of the inertial unit
    poses = FramePoses(camera_poses([packet(yaw=0.4), packet(yaw=0.4 + math.pi / 2)], inverse(T_imu_cam0)), "oxts")
    T = poses.at(1)
    np.testing.assert_allclose(T[:3, 3], [-2, 2, 0], atol=1e-9)
    np.testing.assert_allclose(T[:3, 2], [0, 1, 0], atol=1e-12)  # it looks left


def test_the_first_packet_that_can_be_used_is_the_origin():
    poses = FramePoses(camera_poses(["0.txt: torn", packet(), packet(north_deg=1e-5)], np.eye(4)), "oxts")
    with pytest.raises(FrameRefused, match=r"0\.txt: torn"):
        poses.at(0)
    np.testing.assert_allclose(poses.at(1), UPRIGHT, atol=1e-12)


def test_pose_files_are_turned_upright(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text(made.pose_lines(3) + "\n\n")
    poses = read_pose_file(path, 4)
    for n in range(3):
        np.testing.assert_allclose(poses.at(n), made.cam0_pose(n), atol=1e-9)
    with pytest.raises(FrameRefused, match="no pose for frame 3") as refused:
        poses.at(3)
    assert refused.value.reason == "no_pose"


@pytest.mark.parametrize("line", ["1 2 3", "one " * 12, "nan " * 12, "2 0 0 0 0 2 0 0 0 0 2 0", ""])
def test_a_bad_line_spoils_its_own_pose_only(tmp_path, line):
    path = tmp_path / "poses.txt"
    good = made.pose_lines(3).splitlines()
    path.write_text("\n".join([good[0], line, good[2]]))
    poses = read_pose_file(path, 3)
    with pytest.raises(FrameRefused, match=r"poses\.txt:2: ") as refused:
        poses.at(1)
    assert refused.value.reason == "bad_pose_file"
    np.testing.assert_allclose(poses.at(2), made.cam0_pose(2), atol=1e-9)


def test_not_one_pose_is_an_error():
    with pytest.raises(SourceError, match="no usable pose"):
        FramePoses(["x.txt:1: torn"], "x.txt")


def test_what_at_returns_cannot_change_the_poses():
    for poses in (FramePoses([np.eye(4)], "x"), StandingPoses()):
        poses.at(0)[:] = 0
        np.testing.assert_array_equal(poses.at(0), UPRIGHT)
