# SPDX-License-Identifier: Apache-2.0
"""Poses of depth images through /tf, in bags of ROS 1 and ROS 2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_robot_bags import MS, START_NS, TF, RobotBagMaker, planar_motion, planar_numbers

from stereovox.errors import SourceError
from stereovox.sources.bags import open_bag
from stereovox.sources.bags.recording import Bag, tracker_poses
from stereovox.sources.bags.tf import read_tf, tf_topics
from stereovox.sources.poses.tracker import turned

ENDINGS = pytest.mark.parametrize("ending", [".bag", ".db3"])
OPTICAL = [0.1, 0.0, 0.3, -0.5, 0.5, -0.5, 0.5]
"""An optical frame that looks forward."""
T_BASE_OPTICAL = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.3], [0, 0, 0, 1]])


def driven(bag: RobotBagMaker, world: str = "odom", count: int = 4) -> None:
    """The robot drives 1 m and turns 0.2 rad in each tenth of a second; its transforms lie between the images."""
    for k in range(-1, count):
        stamp_ns = START_NS + k * 100 * MS + 50 * MS
        bag.tf(stamp_ns, world, "base_link", planar_numbers(k + 0.5, 0, 0.2 * (k + 0.5)))


def walk(path: Path, world: str = "odom", more=lambda bag: None, mount: bool = True) -> Path:
    with RobotBagMaker(path) as bag:
        more(bag)
        if mount:
            bag.tf(START_NS, "base_link", "optical", OPTICAL, "/tf_static")
        driven(bag, world)
        bag.depth(3, "/optical")
    return bag.path


@ENDINGS
def test_a_chain_of_transforms_is_the_pose(tmp_path, ending):
    source = Bag(walk(tmp_path / f"a{ending}"))
    assert len(source) == 3
    for k, frame in enumerate(source):
        assert (frame.fault, frame.stamp_ns) == (None, START_NS + k * 100 * MS)
        np.testing.assert_allclose(frame.T_world_sensor, planar_motion(k, 0, 0.2 * k) @ T_BASE_OPTICAL, atol=1e-9)
    used, misfit = source.notes  # every image shows the same, which no camera does that moves
    assert used == f"{source._file.path} /tf (odom -> optical): these poses are used"
    assert misfit.startswith("poses do not fit the images")


@ENDINGS
def test_the_map_comes_before_the_odometry_unless_another_world_is_named(tmp_path, ending):
    def localised(bag: RobotBagMaker) -> None:
        for k in range(-1, 5):
            bag.tf(START_NS + k * 100 * MS, "map", "odom", planar_numbers(10, 5, 0))

    path = walk(tmp_path / f"a{ending}", more=localised)
    np.testing.assert_allclose(
        Bag(path).frame(2).T_world_sensor[:3, 3], [12 + 0.1 * np.cos(0.4), 5 + 0.1 * np.sin(0.4), 0.3]
    )
    T = Bag(f"{path}?world_frame=odom").frame(2).T_world_sensor
    np.testing.assert_allclose(T, planar_motion(2, 0, 0.4) @ T_BASE_OPTICAL, atol=1e-9)
    with pytest.raises(SourceError, match=r"no frame 'odm' in it \(did you mean 'odom'\?\); correct \?world_frame=odm"):
        Bag(f"{path}?world_frame=odm")


def test_any_other_root_is_the_world_where_the_camera_moves_in_it(tmp_path):
    source = Bag(walk(tmp_path / "a.bag", world="arena"))
    np.testing.assert_allclose(source.frame(1).T_world_sensor, planar_motion(1, 0, 0.2) @ T_BASE_OPTICAL, atol=1e-9)


@ENDINGS
def test_transforms_that_only_tell_how_the_camera_is_mounted(tmp_path, ending):
    with RobotBagMaker(tmp_path / f"a{ending}") as bag:
        bag.tf(START_NS, "camera_link", "optical", OPTICAL, "/tf_static")
        bag.depth(2)
    frame = Bag(bag.path).frame(0)
    assert frame.fault == "no_pose"
    assert "has the mount of optical on camera_link, but not where that was; put poses" in frame.fault_detail


def test_frames_that_tf_does_not_know(tmp_path):
    path = walk(tmp_path / "a.bag", mount=False)
    frame = Bag(path).frame(0)
    assert frame.fault == "no_pose"
    assert "/tf: no frame 'optical' in it" in frame.fault_detail
    with pytest.raises(SourceError, match="world_frame=odom"):
        Bag(f"{path}?world_frame=odom")


def test_a_gap_refuses_the_images_in_it_by_name(tmp_path):
    with RobotBagMaker(tmp_path / "a.bag") as bag:
        bag.tf(START_NS, "base_link", "optical", OPTICAL, "/tf_static")
        for milliseconds in (-50, 50, 700):
            bag.tf(START_NS + milliseconds * MS, "odom", "base_link", planar_numbers(milliseconds, 0, 0))
        bag.depth(9)
    source = Bag(bag.path)
    assert [frame.fault for frame in source] == [None, *["no_pose"] * 6, None, None]
    assert [frame.pose_off_ns for frame in source] == [0] * 8 + [100 * MS]
    assert "/tf: odom -> base_link has no transform for 0.650 s after" in source.frame(3).fault_detail


def test_a_topic_that_is_named_comes_first_and_is_told_of(tmp_path):
    def tracked(bag: RobotBagMaker) -> None:
        for k in range(-1, 4):
            stamp_ns = START_NS + k * 90 * MS
            bag.add("/vicon", "nav_msgs/Odometry", stamp_ns, bag.odometry(stamp_ns, planar_numbers(0, 7, 0)))

    path = walk(tmp_path / "a.bag", more=tracked)
    source = Bag(path)
    assert "/tf (odom -> optical): these poses are used; ?poses=/vicon for others" in source.notes[0]
    np.testing.assert_allclose(source.frame(1).T_world_sensor, planar_motion(1, 0, 0.2) @ T_BASE_OPTICAL, atol=1e-9)
    T = Bag(f"{path}?poses=/vicon").frame(1).T_world_sensor  # of base_link, on which /tf_static mounts the camera
    np.testing.assert_allclose(T, planar_motion(0, 7, 0) @ T_BASE_OPTICAL, atol=1e-9)
    T = Bag(f"{path}?poses=/vicon&axes=optical").frame(1).T_world_sensor  # unless the user knows better
    np.testing.assert_allclose(T, planar_motion(0, 7, 0), atol=1e-9)
    np.testing.assert_array_equal(Bag(f"{path}?pose=fixed").frame(1).T_world_sensor, np.eye(4))
    np.testing.assert_allclose(tracker_poses(path, "optical", "file").at(START_NS)[1, 3], 7)  # of a pair: never /tf
    for query in ("poses=/vicon&world_frame=odom", "pose=fixed&world_frame=odom"):
        with pytest.raises(SourceError, match="contradict each other"):
            Bag(f"{path}?{query}")


def test_without_tf_a_topic_counts_as_before_and_no_world_can_be_named(tmp_path):
    with RobotBagMaker(tmp_path / "a.bag") as bag:
        for k in range(3):
            stamp_ns = START_NS + k * 90 * MS
            bag.add("/vicon", "nav_msgs/Odometry", stamp_ns, bag.odometry(stamp_ns, planar_numbers(0, 7, 0)))
        bag.depth(2)
    frame = Bag(bag.path).frame(0)
    assert frame.fault == "no_pose"  # of base_link, and nobody knows where the camera is on it
    assert (
        "poses of 'base_link', and nothing in /tf connects it with the sensor's frame 'optical'" in frame.fault_detail
    )
    assert "?axes=ros" in frame.fault_detail
    assert Bag(f"{bag.path}?axes=ros").frame(0).fault is None
    with pytest.raises(SourceError, match="has no /tf; leave"):
        Bag(f"{bag.path}?world_frame=odom")


def test_axes_and_world_turn_these_poses_too(tmp_path):
    path = walk(tmp_path / "a.bag")
    plain = Bag(path).frame(1).T_world_sensor
    found = Bag(f"{path}?axes=ros&world=optical").frame(1).T_world_sensor
    np.testing.assert_allclose(found, turned(plain, "ros", "optical"), atol=1e-12)


def test_topics_of_a_namespace_count_only_without_the_usual_ones(tmp_path):
    with RobotBagMaker(tmp_path / "a.bag") as bag:
        for topic in ("/r1/tf", "/r1/tf_static"):
            bag.tf(START_NS, "odom", "base_link", planar_numbers(1, 2, 0), topic)
        bag.add(
            "/r2/tf",
            "tf/tfMessage",
            START_NS,
            bag.transforms((0, "x", "y", planar_numbers(0, 0, 0)), kind="tf/tfMessage"),
        )
    file = open_bag(bag.path)
    assert tf_topics(file) == ["/r1/tf", "/r1/tf_static", "/r2/tf"]
    assert read_tf(file).frames == ("base_link", "odom", "x", "y")
    with RobotBagMaker(tmp_path / "b.bag") as bag:
        for topic in ("/r1/tf", "/tf"):
            bag.tf(START_NS, "odom", "base_link", planar_numbers(1, 2, 0), topic)
    assert tf_topics(open_bag(bag.path)) == ["/tf"]


def test_messages_that_cannot_be_read_are_counted(tmp_path):
    def broken(bag: RobotBagMaker) -> None:
        bag.add("/tf", TF, START_NS, b"\xff\xff\xff\x7f")

    tf = read_tf(open_bag(walk(tmp_path / "a.bag", more=broken)))
    assert tf.notes == (f"{tmp_path / 'a.bag'} /tf: 1 messages cannot be read and were left out",)
    assert tf.connected("odom", "optical")


@ENDINGS
@pytest.mark.parametrize("kind", ["nav_msgs/Odometry", "geometry_msgs/TransformStamped"])
def test_poses_of_the_base_lead_to_the_camera_through_tf_static(tmp_path, ending, kind):
    with RobotBagMaker(tmp_path / f"a{ending}") as bag:
        bag.tf(START_NS, "base_footprint", "base_link", [0, 0, 0.2, 0, 0, 0, 1], "/tf_static")
        bag.tf(START_NS, "base_link", "optical", OPTICAL, "/tf_static")
        for k in range(-1, 4):
            stamp_ns = START_NS + k * 100 * MS + 50 * MS
            numbers = planar_numbers(k + 0.5, 0, 0.2 * (k + 0.5))
            stamped = bag.transforms((stamp_ns, "odom", "base_link", numbers)).transforms[0]
            message = bag.odometry(stamp_ns, numbers) if kind.endswith("Odometry") else stamped
            bag.add("/odom", kind, stamp_ns, message)
        bag.depth(3)
    source = Bag(bag.path)
    for k, frame in enumerate(source):
        assert frame.fault is None
        np.testing.assert_allclose(frame.T_world_sensor, planar_motion(k, 0, 0.2 * k) @ T_BASE_OPTICAL, atol=1e-9)
    assert "poses of base_link are used, with the mount of optical on it from /tf" in source.notes[0]
