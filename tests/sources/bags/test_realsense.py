# SPDX-License-Identifier: Apache-2.0
"""ROS 1 bags as librealsense's ros_writer.cpp describes them, and what librealsense itself makes of them."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from made_bags import (
    PERIOD_NS,
    Bag,
    add_depth,
    add_t265,
    camera_info,
    depth,
    describe,
    image,
    realsense_bag,
    stamp,
)

from stereovox.errors import FrameRefused, MissingExtra, SourceError
from stereovox.opening import open_source
from stereovox.sources.bags.recording import Bag as BagSource
from stereovox.sources.bags.recording import tracker_poses

HALF_TURN_X = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)


def test_depth_camera_unit_and_time(tmp_path):
    source = open_source(realsense_bag(tmp_path / "walk.bag", 4, unit=0.0005))
    assert isinstance(source, BagSource)
    assert (source.name, len(source), source.notes) == ("walk.bag", 4, ())
    camera = source.camera
    assert (camera.width, camera.height, camera.baseline) == (8, 6, 0.05)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10, 10.5, 3.5, 2.5)
    for k in (2, 0, 3, -1, 1):
        frame = source.frame(k)
        k %= 4
        assert frame.depth.dtype == np.uint16
        np.testing.assert_array_equal(frame.depth, depth(k))
        assert frame.stamp_ns == stamp(k)
        assert frame.depth_scale == pytest.approx(0.0005)
    with pytest.raises(IndexError):
        source.frame(4)


def test_before_2_40_the_unit_is_an_option_only(tmp_path):
    with Bag(tmp_path / "old.bag") as bag:
        describe(bag, unit=0.0001)
        add_depth(bag, 0, unit=None)
    frame = BagSource(bag.path).frame(0)
    assert frame.depth_scale == pytest.approx(0.0001)
    np.testing.assert_array_equal(frame.depth, depth(0))


def test_without_poses_the_depth_is_there_and_the_map_refuses_it(tmp_path):
    source = BagSource(realsense_bag(tmp_path / "walk.bag", 1))
    frame = source.frame(0)
    assert frame.fault == "no_pose"
    assert "pair.toml" in frame.fault_detail
    assert "\n" not in frame.fault_detail
    assert np.isnan(frame.T_world_sensor).all()
    np.testing.assert_array_equal(frame.depth, depth(0))
    still = BagSource(f"{tmp_path}/walk.bag?pose=fixed").frame(0)
    np.testing.assert_array_equal(still.T_world_sensor, np.eye(4))
    assert still.fault is None
    assert BagSource.depth_only(f"{tmp_path}/walk.bag").frame(0).fault is None


@pytest.mark.parametrize("packed", ["lz4", "bz2"])
def test_packed_bags(tmp_path, packed):
    source = BagSource(realsense_bag(tmp_path / "walk.bag", 9, packed))
    for k in range(9):
        np.testing.assert_array_equal(source.frame(k).depth, depth(k))


def test_librealsense_itself_reads_the_made_bag_and_its_db3_gives_the_same_frames(tmp_path):
    rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 has no wheel for this Python", exc_type=ImportError)
    made = realsense_bag(tmp_path / "walk.bag", 5)
    rs.context().convert_bag_to_db3(str(made), str(tmp_path / "walk.db3"))
    ours, theirs = BagSource(made), BagSource(tmp_path / "walk.db3")
    assert len(ours) == len(theirs) == 5
    assert ours.camera == theirs.camera
    for mine, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(mine.depth, other.depth)
        assert abs(mine.stamp_ns - other.stamp_ns) < 1000  # librealsense keeps milliseconds as a double
        assert mine.depth_scale == pytest.approx(other.depth_scale)


def t265_bag(path, count=5):
    with Bag(path) as bag:
        for k in range(count):
            numbers = (0.1 * k, 0.2, -0.3, 0.0, 0.0, 0.0, 1.0)
            add_t265(bag, 1_000_000 + k * 5_000_000, stamp(0) + k * 5_000_000, numbers, confidence=k % 4)
    return path


def test_t265_poses_have_their_own_time_and_confidence(tmp_path):
    poses = tracker_poses(t265_bag(tmp_path / "t265.bag"), axes="opengl", world="optical")
    assert poses.stamps_ns.tolist() == [stamp(0) + k * 5_000_000 for k in range(5)]
    assert poses.confidence is not None
    assert poses.confidence.tolist() == [0, 1, 2, 3, 0]
    # OpenGL axes (x right, y up, z backward) to optical ones (x right, y down, z forward)
    np.testing.assert_allclose(poses.at(stamp(0) + 7_500_000)[:3, 3], [0.15, -0.2, 0.3])


def test_a_d435_bag_and_a_t265_bag_make_a_camera_pair(tmp_path):
    realsense_bag(tmp_path / "d435.bag", 3)
    with Bag(tmp_path / "t265.bag") as bag:
        for k in range(-2, 20):
            add_t265(bag, 10**9 + k * 5_000_000, stamp(0) + k * 5_000_000, (0.01 * k, 0, 0, 0, 0, 0, 1))
    (tmp_path / "pair.toml").write_text(
        'depth = "d435.bag"\nposes = "t265.bag"\nworld = "optical"\n'
        "T_tracker_camera = [[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    )
    frames = list(open_source(tmp_path))
    assert [frame.fault for frame in frames] == [None] * 3
    for k, frame in enumerate(frames):
        np.testing.assert_allclose(frame.T_world_sensor[0, 3], 0.5 + 2e-9 * k * PERIOD_NS, atol=1e-9)
        np.testing.assert_array_equal(frame.depth, depth(k))


def test_t265_poses_in_the_same_bag_carry_the_depth(tmp_path):
    with Bag(tmp_path / "both.bag") as bag:
        describe(bag)
        add_depth(bag, 0)
        for shift in (-10_000_000, 10_000_000):
            add_t265(bag, 20_000_000 + shift, stamp(0) + shift, (1.0 + shift * 1e-9, 0, -2.0, 0, 0, 0, 1))
    source = BagSource(f"{bag.path}?world=optical")
    assert source.frame(0).fault is None
    np.testing.assert_allclose(source.frame(0).T_world_sensor[:3, 3], [1.0, 0.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(source.frame(0).T_world_sensor[:3, :3], np.eye(3), atol=1e-12)
    assert "pair.toml" in source.notes[0]
    # by default z is up: what is forward for the camera is x in the world
    np.testing.assert_allclose(BagSource(bag.path).frame(0).T_world_sensor[:3, 3], [2.0, -1.0, 0.0], atol=1e-12)


def test_an_image_between_poses_too_far_apart_is_refused(tmp_path):
    with Bag(tmp_path / "both.bag") as bag:
        describe(bag)
        for k in range(2):
            add_depth(bag, k)
        add_t265(bag, 1, stamp(0) - 1_000_000, HALF_TURN_X)
        add_t265(bag, 2, stamp(0) + 1_000_000, HALF_TURN_X)
    faults = [frame.fault for frame in BagSource(bag.path)]
    assert faults == [None, "no_pose"]


def test_a_pose_that_is_none_is_refused_by_name(tmp_path):
    with Bag(tmp_path / "both.bag") as bag:
        describe(bag)
        add_depth(bag, 0)
        add_t265(bag, 1, stamp(0), (0, 0, 0, 0, 0, 0, 0))
        add_t265(bag, 2, stamp(0) + PERIOD_NS, HALF_TURN_X)
    frame = BagSource(bag.path).frame(0)
    assert frame.fault == "bad_pose_file"
    assert "message 0 holds no pose" in frame.fault_detail


def test_two_depth_cameras_need_a_choice(tmp_path):
    with Bag(tmp_path / "two.bag") as bag:
        describe(bag)
        add_depth(bag, 0)
        other = "/device_0/sensor_1/Depth_0"
        bag.add(f"{other}/info/camera_info", "sensor_msgs/CameraInfo", 1, camera_info())
        bag.add(f"{other}/image/data", "sensor_msgs/Image", 2, image(depth(7), "mono16", stamp(7)))
    with pytest.raises(SourceError, match=r"several topics with depth.*\?depth=/device_0/sensor_1/Depth_0/image/data"):
        BagSource(bag.path)
    source = BagSource(f"{bag.path}?depth={other}/image/data")
    np.testing.assert_array_equal(source.frame(0).depth, depth(7))


def test_without_rosbags_the_cure_is_one_line(tmp_path, monkeypatch):
    path = realsense_bag(tmp_path / "walk.bag", 1)
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(MissingExtra, match=r"pip install 'stereovox\[bags\]'"):
        BagSource(path)


def test_poses_of_nothing(tmp_path):
    with pytest.raises(SourceError, match="holds no poses"):
        tracker_poses(realsense_bag(tmp_path / "walk.bag", 1))
    poses = tracker_poses(t265_bag(tmp_path / "t265.bag"))
    with pytest.raises(FrameRefused, match="needs a pose"):
        poses.at(stamp(0) - 1)
