# SPDX-License-Identifier: Apache-2.0
"""The node's poses without tf: the tracked camera, the robot and other sensors, and refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import wire
from made_walks import T_BASE_CAMERA

from stereovox.errors import FrameRefused
from stereovox.frame import Frame
from stereovox.geometry.se3 import Transform, inverse, look_at, rotation_matrix, rotation_vector
from stereovox.ros.poses.tracking import TrackedDepthInput, TrackedPoses, Tracking, moved_covariance
from stereovox.simulate.simulation import Simulation
from stereovox.track.tracker import Tracked, Tracker

TOPIC, OPTICAL, LINK = "/camera/depth/image_raw", "camera_depth_optical_frame", "camera_link"
T_LINK_OPTICAL = look_at([0, 0, 0], [1, 0, 0])
MS = 1_000_000


@pytest.fixture(scope="module")
def room() -> list[Frame]:
    """Frames of a Kinect with exact poses."""
    source = Simulation("sim:room?camera=kinect&image_width=160")
    return [source.frame(i) for i in range(0, 24, 2)]


def tf(*edges: tuple[str, str, Transform], stamp_ns: int = 0) -> bytes:
    return wire.packed(wire.messages().transforms(stamp_ns, edges))


def tracked(room: list[Frame], poses: TrackedPoses, config) -> tuple[list[Frame], list, Tracking]:
    """What a node makes of the images as messages."""
    moved = []
    tracking = Tracking(config, poses, moved.append)
    camera = TrackedDepthInput(TOPIC, "", tracking)
    frames = []
    for frame in room:
        camera.on_camera_info(wire.packed(wire.messages().camera_info(frame.camera, frame.stamp_ns, OPTICAL)))
        frames.append(camera.frame(wire.image(frame.depth, frame.stamp_ns, OPTICAL), camera.look_up(poses)))
    return frames, moved, tracking


@pytest.fixture
def config():
    return Tracker(voxel_size=0.1).config


def off(found: Transform, true: Transform) -> tuple[float, float]:
    between = inverse(true) @ found
    return float(np.linalg.norm(between[:3, 3])), float(np.degrees(np.linalg.norm(rotation_vector(between[:3, :3]))))


def test_the_robot_begins_level_at_the_origin_and_goes_as_its_camera_does(room, config):
    poses = TrackedPoses("", "", 0.1)
    poses.on_tf(tf(("base_link", OPTICAL, T_BASE_CAMERA)), fixed=True)
    frames, moved, tracking = tracked(room, poses, config)
    assert [frame.fault for frame in frames] == ["tracking_lost", *[None] * (len(room) - 1)]
    assert (tracking.tracked, tracking.lost, tracking.state) == (len(room) - 1, 1, "tracked")
    assert {(one.world, one.body, one.rival) for one in moved} == {("odom", "base_link", "")}
    for frame, one, true in zip(frames[1:], moved, room[1:], strict=True):
        travelled = inverse(room[0].T_world_sensor) @ true.T_world_sensor
        expected = T_BASE_CAMERA @ travelled @ inverse(T_BASE_CAMERA)
        distance, angle = off(one.T_world_body, expected)
        assert (distance, angle) <= (0.03, 1.0)
        np.testing.assert_allclose(one.T_world_body @ T_BASE_CAMERA, frame.T_world_sensor, atol=1e-9)


def test_other_sensors_have_their_poses_by_the_tracked_camera_and_none_before(room, config):
    poses = TrackedPoses("", "", 0.1)
    poses.on_tf(tf(("base_link", OPTICAL, T_BASE_CAMERA)), fixed=True)
    T_base_lidar = np.eye(4)
    T_base_lidar[2, 3] = 0.7
    poses.on_tf(tf(("base_link", "lidar", T_base_lidar)), fixed=True)
    with pytest.raises(FrameRefused, match="no image has been tracked"):
        poses.pose("lidar", room[1].stamp_ns)
    _, moved, _ = tracked(room, poses, config)
    first, second = moved[2:4]
    middle = (first.stamp_ns + second.stamp_ns) // 2
    assert poses.is_final("lidar", middle)
    np.testing.assert_allclose(poses.pose("lidar", first.stamp_ns).T_world_sensor, first.T_world_body @ T_base_lidar)
    T = poses.pose("lidar", middle).T_world_sensor
    between = (first.T_world_body[:3, 3] + second.T_world_body[:3, 3]) / 2
    np.testing.assert_allclose(T[:3, 3], between + T[:3, 2] * 0.7, atol=1e-6)
    late = moved[-1].stamp_ns + 50 * MS
    assert not poses.is_final("lidar", late)
    assert poses.pose("lidar", late).off_ns == 50 * MS
    with pytest.raises(FrameRefused, match="ends before"):
        poses.pose("lidar", moved[-1].stamp_ns + 200 * MS)


def test_without_a_robot_the_frame_that_carries_the_camera_moves_and_the_floor_is_level(room, config):
    poses = TrackedPoses("", "", 0.1)
    poses.on_tf(tf((LINK, OPTICAL, T_LINK_OPTICAL)), fixed=True)
    assert not poses.is_mounted(OPTICAL, 0)
    _, moved, _ = tracked(room, poses, config)
    assert poses.is_mounted(OPTICAL, 0)
    assert {one.body for one in moved} == {LINK}
    camera = moved[0].T_world_body @ T_LINK_OPTICAL
    tilt = np.degrees(np.arccos(np.clip(camera[2, :3] @ room[1].T_world_sensor[2, :3], -1, 1)))
    assert tilt < 2.0


def test_a_camera_alone_is_its_own_body(room, config):
    _, moved, _ = tracked(room[:3], TrackedPoses("world", "", 0.1), config)
    assert {(one.world, one.body) for one in moved} == {("world", OPTICAL)}


def test_what_does_not_fit_is_refused_and_gives_no_pose(room, config):
    covered = [replace(frame, depth=np.zeros_like(frame.depth)) for frame in room[4:7]]
    poses = TrackedPoses("", "", 0.1)
    frames, moved, tracking = tracked([*room[:4], *covered], poses, config)
    assert [frame.fault for frame in frames[-3:]] == ["tracking_lost"] * 3
    assert all(np.isnan(frame.T_world_sensor).all() for frame in frames[-3:])
    assert [one.stamp_ns for one in moved] == [frame.stamp_ns for frame in room[1:4]]
    assert tracking.state.startswith("lost: ")
    assert tracking.counts()["frames_lost"] == 4


def test_another_parent_of_the_body_is_noticed_before_and_after_the_start_and_its_own_is_not(room, config):
    wheels = tf(("wheels", "base_link", np.eye(4)), stamp_ns=room[0].stamp_ns)
    for when in ("before", "after"):
        poses = TrackedPoses("", "", 0.1)
        poses.on_tf(tf(("base_link", OPTICAL, T_BASE_CAMERA)), fixed=True)
        if when == "before":
            poses.on_tf(wheels, fixed=False)
        _, moved, _ = tracked(room[:3], poses, config)
        poses.on_tf(tf(("odom", "base_link", moved[-1].T_world_body), stamp_ns=moved[-1].stamp_ns), fixed=False)
        assert poses.rival == ("wheels" if when == "before" else "")
        poses.on_tf(wheels, fixed=False)
        assert poses.rival == "wheels"
        np.testing.assert_allclose(poses.pose("base_link", moved[-1].stamp_ns).T_world_sensor, moved[-1].T_world_body)


def test_a_named_base_that_the_camera_is_not_mounted_on_is_waited_for_and_then_refused(room, config):
    poses = TrackedPoses("", "base_link", 0.1)
    assert not poses.is_mounted(OPTICAL, 0)
    frames, moved, _ = tracked(room[:2], poses, config)
    assert [frame.fault for frame in frames] == ["no_pose"] * 2
    assert moved == []
    poses.on_tf(tf(("base_link", OPTICAL, T_BASE_CAMERA)), fixed=True)
    assert poses.is_mounted(OPTICAL, 0)


def test_a_floor_map_needs_a_robot_for_its_height(room, config):
    frames, _, _ = tracked(room[:1], TrackedPoses("", "", 0.1, base_needed=True), config)
    assert (frames[0].fault, "--fixed 'base_link" in frames[0].fault_detail) == ("no_pose", True)


def test_the_covariance_of_the_body_is_that_of_many_tries():
    random = np.random.default_rng(5)
    root = random.normal(size=(6, 6)) * np.repeat([0.002, 0.01], 3)[:, None]
    covariance, offset = root @ root.T, np.array([0.5, -0.3, 0.8])
    tries = random.normal(size=(40_000, 6)) @ root.T
    moved = [np.r_[one[:3], one[3:] + rotation_matrix(one[:3]) @ offset - offset] for one in tries]
    expected = np.cov(np.array(moved).T)
    np.testing.assert_allclose(moved_covariance(covariance, offset), expected, atol=0.03 * np.abs(expected).max())


def test_the_covariance_of_each_pose_is_that_of_the_tracker_carried_to_the_body(room, config, monkeypatch):
    given = np.diag([1e-6, 2e-6, 3e-6, 1e-4, 2e-4, 3e-4])
    T = np.eye(4)
    monkeypatch.setattr(Tracker, "add", lambda self, frame: Tracked(T, given))
    poses = TrackedPoses("", "", 0.1)
    poses.on_tf(tf(("base_link", OPTICAL, inverse(look_at([0, 0, 0], [0, 0, 1], up=(0, 1, 0))))), fixed=True)
    _, moved, _ = tracked(room[:1], poses, config)
    np.testing.assert_allclose(moved[0].covariance, given, atol=1e-12)  # no lever: turned about itself
