# SPDX-License-Identifier: Apache-2.0
"""Bags of ground robots: scans, depth images, odometry and where all of it comes from."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from made_robot_bags import MS, START_NS, RobotBagMaker, planar_motion, planar_numbers

from stereovox.errors import SourceError
from stereovox.frame import Frame, Scan
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_robot, open_source
from stereovox.sources.robots.bag import RobotBag, mounted
from stereovox.sources.robots.robot import in_time_order

ENDINGS = pytest.mark.parametrize("ending", [".bag", ".db3"])
LASER = [0.2, 0.0, 0.225, 0, 0, 0, 1]
CAMERA = [0.1, 0.0, 0.28, -0.5, 0.5, -0.5, 0.5]
T_BASE_LASER = planar_motion(0.2, 0, 0, 0.225)
T_BASE_CAMERA = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0.28], [0, 0, 0, 1]])
BETWEEN = (-0.5, 0.5, 1.5, 2.5, 3.5)
DEMO = Path(__file__).resolve().parents[4] / "shared/data/ros1/scans_demo.bag"


def pose(k: float) -> tuple[float, float, float]:
    """Where the robot stands at scan `k`."""
    return 0.1 * k, 0.05 * k, 0.02 * k


def at(k: float) -> int:
    return START_NS + round(k * 100 * MS)


def mounts(bag: RobotBagMaker) -> None:
    edges = ((0, "base_link", "laser", LASER), (0, "base_link", "optical", CAMERA))
    bag.add("/tf_static", "tf2_msgs/TFMessage", START_NS, bag.transforms(*edges))


def drive(bag: RobotBagMaker, ks=BETWEEN, parent: str = "odom", child: str = "base_link") -> None:
    for k in ks:
        bag.tf(at(k), parent, child, planar_numbers(*pose(k)))


def wheels(bag: RobotBagMaker, topic: str = "/odom", shift: float = 0.0, child: str = "base_link", ks=BETWEEN) -> None:
    for k in ks:
        x, y, yaw = pose(k)
        bag.add(
            topic, "nav_msgs/Odometry", at(k), bag.odometry(at(k), planar_numbers(x, y + shift, yaw), "odom", child)
        )


def made(path: Path, *parts) -> Path:
    with RobotBagMaker(path) as bag:
        for part in parts:
            part(bag)
    return bag.path


def scans(bag: RobotBagMaker) -> None:
    bag.scans(4)


def images(bag: RobotBagMaker) -> None:
    bag.depth(3)


@ENDINGS
def test_a_robot_with_everything(tmp_path, ending):
    robot = open_robot(made(tmp_path / f"a{ending}", mounts, drive, scans, images))
    assert isinstance(robot, RobotBag)
    assert (robot.notes, robot.truth, robot.name) == ((), None, f"a{ending}")
    assert (len(robot.scans), len(robot.frames)) == (4, 3)
    for k, scan in enumerate(robot.scans):
        assert (scan.fault, scan.stamp_ns) == (None, at(k))
        np.testing.assert_array_equal(scan.ranges, np.array([1 + k, 2, 3], np.float32))
        np.testing.assert_allclose(scan.T_base_sensor, T_BASE_LASER, atol=1e-9)
        np.testing.assert_allclose(scan.T_world_sensor, planar_motion(*pose(k)) @ T_BASE_LASER, atol=1e-9)
        np.testing.assert_allclose(scan.pose_world_base, pose(k), atol=1e-9)
        assert (scan.angle_min, scan.angle_step, scan.range_max) == (-1, 0.5, np.float32(5.6))
    for k, frame in enumerate(robot.frames):
        assert (frame.fault, frame.stamp_ns, frame.depth_scale, frame.camera.fx) == (None, at(k), 0.001, 10)
        assert frame.depth[0, 0] == 1000 + 100 * k
        np.testing.assert_allclose(frame.T_world_sensor, planar_motion(*pose(k)) @ T_BASE_CAMERA, atol=1e-9)
    together = list(in_time_order(robot.scans, robot.frames))
    assert [type(seen) for seen in together] == [Scan, Frame, Scan, Frame, Scan, Frame, Scan]
    assert [scan.stamp_ns for scan in robot.scans[1::2]] == [at(1), at(3)]
    assert robot.scans[-1].stamp_ns == at(3)
    with pytest.raises(IndexError):
        robot.scans[4]


@ENDINGS
def test_without_odometry_in_tf_its_topic_counts(tmp_path, ending):
    robot = RobotBag(made(tmp_path / f"a{ending}", mounts, wheels, scans, images))
    assert robot.notes == ()
    np.testing.assert_allclose(robot.scans[2].T_world_sensor, planar_motion(*pose(2)) @ T_BASE_LASER, atol=1e-9)
    np.testing.assert_allclose(robot.frames[2].T_world_sensor, planar_motion(*pose(2)) @ T_BASE_CAMERA, atol=1e-9)


def test_an_odometry_topic_that_is_named_counts_before_tf(tmp_path):
    path = made(tmp_path / "a.bag", mounts, drive, lambda bag: wheels(bag, "/icp", 3.0), scans)
    np.testing.assert_allclose(RobotBag(path).scans[2].pose_world_base, pose(2), atol=1e-9)
    x, y, yaw = pose(2)
    np.testing.assert_allclose(RobotBag(f"{path}?odom=/icp").scans[2].pose_world_base, (x, y + 3, yaw), atol=1e-9)


def test_of_several_odometry_topics_the_longest_counts_but_never_the_truth(tmp_path):
    def two(bag: RobotBagMaker) -> None:
        wheels(bag, "/best", 3.0)
        wheels(bag, "/a_short_one", 0.0, ks=BETWEEN[:-1])

    path = made(tmp_path / "a.bag", mounts, two, scans)
    robot = RobotBag(path)
    assert "odometry of /best, which has the most; there is /a_short_one too" in robot.notes[0]
    assert robot.scans[1].pose_world_base[1] == pytest.approx(3.05)
    robot = RobotBag(f"{path}?truth=/best")
    assert robot.notes == ()
    assert robot.scans[1].pose_world_base[1] == pytest.approx(0.05)
    assert robot.truth is not None
    np.testing.assert_allclose(robot.truth.at(at(1))[:3, 3], [0.1, 3.05, 0], atol=1e-9)


@ENDINGS
def test_nothing_but_depth_and_odometry(tmp_path, ending):
    robot = RobotBag(made(tmp_path / f"a{ending}", wheels, images))
    assert len(robot.scans) == 0
    assert len(robot.frames) == 3
    assert (
        "the mount of the camera (optical) on the robot is unknown: assumed to be base_link itself; give ?camera_mount="
        in robot.notes[0]
    )
    T_optical = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # it looks forward all the same
    np.testing.assert_allclose(robot.frames[1].T_world_sensor, planar_motion(*pose(1)) @ T_optical, atol=1e-9)


def test_mounts_that_are_given_count_before_tf(tmp_path):
    path = made(tmp_path / "a.bag", mounts, drive, scans, images)
    robot = RobotBag(f"{path}?mount=1,2,3,0.5&camera_mount=0.04,0,0.28")
    np.testing.assert_allclose(robot.scans[1].T_base_sensor, planar_motion(1, 2, 0.5, 3), atol=1e-9)
    np.testing.assert_allclose(robot.scans[1].pose_world_base, pose(1), atol=1e-9)
    T = inverse(planar_motion(*pose(1))) @ robot.frames[1].T_world_sensor
    np.testing.assert_allclose(T[:3, 3], [0.04, 0, 0.28], atol=1e-9)
    np.testing.assert_allclose(T[:3, 2], [1, 0, 0], atol=1e-9)
    down = RobotBag(f"{path}?camera_mount=0,0,1,0,{np.pi / 2}").frames[0].T_world_sensor  # pitch: nose down
    np.testing.assert_allclose(down[:3, 2], [0, 0, -1], atol=1e-9)
    over = RobotBag(f"{path}?mount=0,0,1,0,0,{np.pi}").scans[0].T_base_sensor  # roll: upside down
    np.testing.assert_allclose(over[:3, 1], [0, -1, 0], atol=1e-9)


def test_a_camera_whose_images_name_its_body(tmp_path):
    path = made(tmp_path / "a.bag", mounts, drive, lambda bag: bag.depth(2, "laser"))
    found = RobotBag(f"{path}?axes=ros").frames[1].T_world_sensor
    np.testing.assert_allclose(found, planar_motion(*pose(1)) @ T_BASE_LASER @ (inverse(CAMERA_AT_REST)), atol=1e-9)


CAMERA_AT_REST = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Turns coordinates of a body into those of its optical frame."""


def test_a_robot_without_tf_and_odometry_stands_still_until_its_way_is_found(tmp_path):
    def two(bag: RobotBagMaker) -> None:
        bag.scans(2, "/a_rear_scan", "rear")
        bag.scans(3, "/front_scan", "front")

    path = made(tmp_path / "a.bag", two)
    robot = open_robot(path)
    assert len(robot.scans) == 3
    assert [scan.fault for scan in robot.scans] == [None] * 3
    np.testing.assert_array_equal(robot.scans[2].T_world_sensor, np.eye(4))
    which, still, mount = robot.notes
    assert "scans of /front_scan, which has the most; there are /a_rear_scan too: add ?scan=/topic" in which
    assert "has no odometry: the robot is assumed to stand still until its path is found" in still
    assert (
        "the mount of the lidar (front) on the robot is unknown: assumed to be base_link itself; give ?mount=x,y,z,yaw"
        in mount
    )
    rear = RobotBag(f"{path}?scan=/a_rear_scan&mount=-0.3,0,0.2,3.14")
    assert len(rear.scans) == 2
    np.testing.assert_allclose(rear.scans[0].T_world_sensor, planar_motion(-0.3, 0, 3.14, 0.2), atol=1e-9)
    np.testing.assert_allclose(rear.scans[0].pose_world_base, [0, 0, 0], atol=1e-9)
    assert len(rear.notes) == 1


def test_a_gap_in_tf_is_a_fault_of_the_scans_in_it(tmp_path):
    path = made(tmp_path / "a.bag", mounts, lambda bag: drive(bag, [-0.5, 0.5, 8.5, 9.5]), lambda bag: bag.scans(12))
    robot = RobotBag(path)
    faults = [scan.fault for scan in robot.scans]
    assert faults == [None, *["no_pose"] * 8, None, None, "no_pose"]
    assert "odom -> base_link has no transform for 0.800 s" in robot.scans[4].fault_detail
    assert "odom -> base_link ends before" in robot.scans[11].fault_detail
    assert robot.scans[4].stamp_ns == at(4)
    assert np.isnan(robot.scans[4].T_world_sensor).all()
    wide = RobotBag(f"{path}?max_gap=1&extrapolate=0.2")
    assert [scan.fault for scan in wide.scans] == [None] * 12
    np.testing.assert_allclose(wide.scans[4].pose_world_base, pose(4), atol=1e-9)
    assert [scan.pose_off_ns for scan in wide.scans] == [0] * 10 + [50_000_000, 150_000_000]


def test_a_scan_of_another_frame_has_that_frame_s_place(tmp_path):
    def other(bag: RobotBagMaker) -> None:
        bag.scans(1)
        bag.add("/scan", "sensor_msgs/LaserScan", at(1), bag.scan(at(1), [1.0], "/optical"))
        bag.add("/scan", "sensor_msgs/LaserScan", at(2), bag.scan(at(2), [1.0], "nowhere"))

    found = RobotBag(made(tmp_path / "a.bag", mounts, drive, other)).scans
    np.testing.assert_allclose(found[1].T_base_sensor, T_BASE_CAMERA, atol=1e-9)
    assert (found[2].fault, "no frame 'nowhere'" in found[2].fault_detail) == ("no_pose", True)


def test_odometry_without_a_time_has_that_of_recording(tmp_path):
    def stampless(bag: RobotBagMaker) -> None:
        for k in BETWEEN:
            bag.add("/odom", "nav_msgs/Odometry", at(k), bag.odometry(0, planar_numbers(*pose(k))))

    scan = RobotBag(made(tmp_path / "a.bag", mounts, stampless, scans)).scans[2]
    np.testing.assert_allclose(scan.pose_world_base, pose(2), atol=1e-9)


def test_scans_without_a_time_have_that_of_recording(tmp_path):
    def stampless(bag: RobotBagMaker) -> None:
        bag.add("/scan", "sensor_msgs/LaserScan", at(1), bag.scan(0, [1.0]))

    scan = RobotBag(made(tmp_path / "a.bag", mounts, drive, stampless)).scans[0]
    assert (scan.fault, scan.stamp_ns) == (None, at(1))
    np.testing.assert_allclose(scan.pose_world_base, pose(1), atol=1e-9)


@ENDINGS
def test_messages_that_cannot_be_read_are_faults(tmp_path, ending):
    def damaged(bag: RobotBagMaker) -> None:
        bag.scans(1)
        bag.add("/scan", "sensor_msgs/LaserScan", at(1), bag.raw("sensor_msgs/LaserScan", bag.scan(at(1), [1.0]))[:40])
        bag.add("/scan", "sensor_msgs/LaserScan", at(2), bag.scan(at(2), [1.0], range_max=np.inf))

    path = made(tmp_path / f"a{ending}", mounts, drive, damaged)
    found = RobotBag(path).scans
    assert [scan.fault for scan in found] == [None, "unreadable", "unreadable"]
    assert found[1].fault_detail.startswith(f"{path} /scan message 1: ")
    assert len(found[1].ranges) == 0
    assert "give ?range_max=" in found[2].fault_detail
    assert RobotBag(f"{path}?range_max=4").scans[2].range_max == 4


def test_base_footprint_is_the_robot_s_frame_where_there_is_one(tmp_path):
    def footprint(bag: RobotBagMaker) -> None:
        drive(bag, child="base_footprint")
        bag.tf(START_NS, "base_footprint", "base_link", [0, 0, 0.1, 0, 0, 0, 1], "/tf_static")

    path = made(tmp_path / "a.bag", mounts, footprint, scans)
    assert RobotBag(path).scans[0].T_base_sensor[2, 3] == pytest.approx(0.325)
    assert RobotBag(f"{path}?base_frame=base_link").scans[0].T_base_sensor[2, 3] == pytest.approx(0.225)
    np.testing.assert_allclose(RobotBag(path).scans[0].T_world_sensor[2, 3], 0.325)


def test_odometry_of_a_body_above_the_robot_s_frame(tmp_path):
    """The topic tells where base_link is; base_footprint is 0.1 m below."""

    def footprint(bag: RobotBagMaker) -> None:
        bag.tf(START_NS, "base_footprint", "base_link", [0, 0, 0.1, 0, 0, 0, 1], "/tf_static")

    robot = RobotBag(made(tmp_path / "a.bag", mounts, footprint, wheels, scans))
    scan = robot.scans[1]
    np.testing.assert_allclose(scan.T_world_sensor, planar_motion(*pose(1)) @ T_BASE_LASER, atol=1e-9)
    assert scan.T_base_sensor[2, 3] == pytest.approx(0.325)


def test_odometry_of_a_body_that_nothing_connects_with_the_robot(tmp_path):
    path = made(tmp_path / "a.bag", mounts, lambda bag: wheels(bag, child="chassis"), scans)
    robot = RobotBag(path)
    assert robot.notes == (f"{path}: /odom has poses of chassis: assumed to be base_link",)
    np.testing.assert_allclose(robot.scans[1].pose_world_base, pose(1), atol=1e-9)
    nameless = RobotBag(made(tmp_path / "b.bag", mounts, lambda bag: wheels(bag, child=""), scans))
    assert nameless.notes == ()
    np.testing.assert_allclose(nameless.scans[1].pose_world_base, pose(1), atol=1e-9)


def test_a_camera_in_a_tree_of_its_own_sits_where_the_robot_does(tmp_path):
    def apart(bag: RobotBagMaker) -> None:
        bag.tf(START_NS, "camera_link", "optical", CAMERA, "/tf_static")

    robot = RobotBag(made(tmp_path / "a.bag", apart, drive, images))
    assert (
        "the mount of the camera (camera_link) on the robot is unknown: assumed to be base_link itself"
        in robot.notes[0]
    )
    assert len(robot.notes) == 1
    np.testing.assert_allclose(robot.frames[1].T_world_sensor, planar_motion(*pose(1)) @ T_BASE_CAMERA, atol=1e-9)


def test_frames_of_a_namespace_and_of_several_robots(tmp_path):
    def robots(*names: str):
        def part(bag: RobotBagMaker) -> None:
            for name in names:
                bag.tf(START_NS, f"{name}/base_link", "laser", LASER, "/tf_static")
                drive(bag, parent=f"{name}/odom", child=f"{name}/base_link")

        return part

    path = made(tmp_path / "a.bag", robots("r1"), lambda bag: bag.scans(2, frame_id="laser"))
    assert RobotBag(path).notes == ()
    np.testing.assert_allclose(RobotBag(path).scans[1].pose_world_base, pose(1), atol=1e-9)

    def second(bag: RobotBagMaker) -> None:
        bag.tf(START_NS, "r1/odom", "r2/base_link", LASER, "/tf_static")

    def plain(bag: RobotBagMaker) -> None:
        bag.tf(START_NS, "r1/base_link", "base_link", LASER, "/tf_static")

    path = made(tmp_path / "c.bag", robots("r1"), plain, lambda bag: bag.scans(2, frame_id="laser"))
    assert RobotBag(path).where.base == "base_link"  # the plain name comes first

    path = made(tmp_path / "b.bag", robots("r1"), second, lambda bag: bag.scans(2, frame_id="laser"))
    with pytest.raises(SourceError, match=r"several robots, .*\?base_frame=r1/base_link or \?base_frame=r2/base"):
        RobotBag(path)
    np.testing.assert_allclose(RobotBag(f"{path}?base_frame=r1/base_link").scans[1].pose_world_base, pose(1), atol=1e-9)


def test_other_worlds_and_robots_than_the_usual_ones_are_told(tmp_path):
    def slam(bag: RobotBagMaker) -> None:
        drive(bag, parent="arena", child="laser")

    robot = RobotBag(made(tmp_path / "a.bag", slam, scans))
    assert "no base_footprint or base_link in /tf: laser is used as the robot" in robot.notes[0]
    assert "using poses of laser in arena" in robot.notes[1]
    np.testing.assert_allclose(robot.scans[1].T_world_sensor, planar_motion(*pose(1)), atol=1e-9)
    np.testing.assert_array_equal(robot.scans[1].T_base_sensor, np.eye(4))


def test_a_loop_of_frames_is_a_fault_and_no_crash(tmp_path):
    def loop(bag: RobotBagMaker) -> None:
        for parent, child in (("a", "laser"), ("b", "a"), ("laser", "b")):
            bag.tf(START_NS, parent, child, LASER)

    robot = RobotBag(made(tmp_path / "a.bag", loop, scans))
    assert [scan.fault for scan in robot.scans] == ["no_pose"] * 4


CLOUD = [[3.0, 0, 0.1], [2.0, 0, 5.0], [2.5, 0, -0.2], [0, 1.0, 0.5], [np.nan, 0, 0]]
"""As seen from `laser`, 0.225 m high: ahead at 3 m, above the band at 2 m, below it at 2.5 m, to the left at 1 m."""


def test_ranges_beyond_range_max_are_discarded_with_a_note_unless_they_are_said_to_be_far(tmp_path):
    def scans(bag: RobotBagMaker) -> None:
        for k in range(3):
            bag.add("/scan", "sensor_msgs/LaserScan", at(k), bag.scan(at(k), [1.0, 65.533, 5.6, 65.533]))

    path = made(tmp_path / "a.bag", mounts, drive, scans)
    robot = RobotBag(path)
    np.testing.assert_array_equal(robot.scans[1].ranges, np.array([1, np.nan, np.inf, np.nan], np.float32))
    [note] = [note for note in robot.notes if "beyond" in note]
    assert note.endswith("50 % of the ranges of /scan are beyond its range_max and are discarded; if they mean that "
                         "nothing is there, give ?range_max=5.6")  # fmt: skip
    far = RobotBag(f"{path}?range_max=5.6")
    np.testing.assert_array_equal(far.scans[1].ranges, np.array([1, np.inf, np.inf, np.inf], np.float32))
    assert not [note for note in far.notes if "beyond" in note]


@ENDINGS
def test_point_clouds_stand_in_for_a_lidar(tmp_path, ending):
    def clouds(bag: RobotBagMaker) -> None:
        for k in range(3):
            bag.add("/points", "sensor_msgs/PointCloud2", at(k), bag.cloud(at(k), CLOUD, "laser"))

    path = made(tmp_path / f"a{ending}", mounts, drive, clouds)
    robot = RobotBag(path)
    assert len(robot.scans) == 3
    scan = robot.scans[2]
    seen = {round(float(np.degrees(a))): r for a, r in zip(scan.angles, scan.ranges, strict=True) if np.isfinite(r)}
    assert seen == {0: 3.0, 90: 1.0}
    np.testing.assert_allclose(scan.pose_world_base, pose(2), atol=1e-9)
    np.testing.assert_allclose(scan.T_base_sensor, T_BASE_LASER, atol=1e-9)
    low = RobotBag(f"{path}?lowest=0.01&highest=0.2").scans[0]
    assert np.nanmin(low.ranges) == 2.5
    near = RobotBag(f"{path}?range_max=2").scans[0]
    assert (near.range_max, np.isposinf(near.ranges).sum(), np.isfinite(near.ranges).sum()) == (2, 1, 1)


def test_the_scan_of_a_turned_cloud_is_upright(tmp_path):
    """In optical axes: 2 m ahead and 0.1 m below the camera, which is 0.28 m high."""

    def clouds(bag: RobotBagMaker) -> None:
        bag.add("/points", "sensor_msgs/PointCloud2", at(1), bag.cloud(at(1), [[0, 0.1, 2.0]], "optical"))

    scan = RobotBag(made(tmp_path / "a.bag", mounts, drive, clouds)).scans[0]
    np.testing.assert_allclose(scan.pose_world_base, pose(1), atol=1e-9)
    beam = int(np.flatnonzero(np.isfinite(scan.ranges))[0])
    angle, range_m = scan.angles[beam], scan.ranges[beam]
    point = scan.T_world_sensor @ [range_m * np.cos(angle), range_m * np.sin(angle), 0, 1]
    wanted = planar_motion(*pose(1)) @ [2.1, 0, 0.28, 1]  # at the height of the scan
    np.testing.assert_allclose(point, wanted, atol=0.01)


def test_a_lidar_comes_before_clouds_and_depth_before_its_own_cloud(tmp_path):
    def clouds(bag: RobotBagMaker) -> None:
        bag.add("/points", "sensor_msgs/PointCloud2", at(0), bag.cloud(at(0), CLOUD, "optical"))

    both = made(tmp_path / "a.bag", mounts, drive, clouds, scans)
    assert len(RobotBag(both).scans) == 4
    assert len(RobotBag(f"{both}?scan=/points").scans) == 1
    assert len(RobotBag(made(tmp_path / "b.bag", mounts, drive, clouds, images)).scans) == 0
    assert len(RobotBag(made(tmp_path / "c.bag", mounts, drive, clouds, lambda bag: bag.depth(1, "other"))).scans) == 1


def test_a_cloud_without_coordinates_is_a_fault(tmp_path):
    def clouds(bag: RobotBagMaker) -> None:
        flat = bag.cloud(at(0), CLOUD, "laser", fields=[bag.field("x", 0, 7), bag.field("y", 4, 7)])
        bag.add("/points", "sensor_msgs/PointCloud2", at(0), flat)

    scan = RobotBag(made(tmp_path / "a.bag", mounts, drive, clouds)).scans[0]
    assert (scan.fault, "without z" in scan.fault_detail) == ("unreadable", True)


def test_depth_without_camera_info_is_told_and_only_an_error_where_it_is_asked_for(tmp_path):
    path = made(tmp_path / "a.bag", mounts, drive, scans, lambda bag: bag.depth(2, info=False))
    robot = RobotBag(path)
    assert (len(robot.scans), len(robot.frames)) == (4, 0)
    assert "no /camera/depth/camera_info with the camera" in robot.notes[0]
    assert robot.notes[0].endswith("depth images are left out")
    with pytest.raises(SourceError, match="camera_info"):
        RobotBag(f"{path}?depth=/camera/depth/image")
    with pytest.raises(SourceError, match=r"camera_info.*; else no scans"):
        RobotBag(made(tmp_path / "b.bag", mounts, lambda bag: bag.depth(2, info=False)))


def test_of_several_depth_topics_the_longest_counts(tmp_path):
    def two(bag: RobotBagMaker) -> None:
        bag.depth(2, topic="/a")
        bag.depth(3, topic="/b")

    path = made(tmp_path / "a.bag", mounts, drive, two)
    robot = RobotBag(path)
    assert len(robot.frames) == 3
    assert "depth images of /b/image; there are /a/image too: add ?depth=/topic" in robot.notes[0]
    assert len(RobotBag(f"{path}?depth=/a/image").frames) == 2


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("scan=/scn", r"no topic /scn with messages \(did you mean '/scan'\?\)"),
        ("scan=/tf", r"/tf holds tf2_msgs/TFMessage; \?scan= needs sensor_msgs/LaserScan or"),
        ("odom=/scan", r"/scan holds sensor_msgs/LaserScan; \?odom= needs nav_msgs/Odometry"),
        ("truth=/nowhere", "no topic /nowhere"),
        ("truth=/scan", "not poses"),
        ("depth=/scan", "not images"),
        ("base_frame=base_lnk", r"base_frame=base_lnk is in no transform \(did you mean 'base_link'\?\)"),
        ("odom_frame=odm", r"no frame 'odm' in it \(did you mean 'odom'\?\); correct \?odom_frame=odm"),
        ("mount=1,2", "mount=1,2 must be x,y,z,yaw"),
        ("camera_mount=1,2,x,0", "must be x,y,z,yaw"),
        ("range_max=-1", "must be a positive number"),
        ("lowest=2&highest=1", "must be below"),
        ("axes=left", "must be optical or ros"),
        ("scans=/scan", "unknown parameter 'scans'"),
    ],
)
def test_bad_options(tmp_path, query, said):
    path = made(tmp_path / "a.bag", mounts, drive, scans)
    with pytest.raises(SourceError, match=said) as caught:
        RobotBag(f"{path}?{query}")
    assert "\n" not in str(caught.value)


def test_bags_with_nothing_for_a_robot(tmp_path):
    with pytest.raises(SourceError, match=r"a\.bag: no scans, point clouds or depth images in it; it holds /tf"):
        RobotBag(made(tmp_path / "a.bag", drive))
    (tmp_path / "empty.bag").write_bytes(b"")
    with pytest.raises(SourceError, match="the file is empty"):
        open_robot(tmp_path / "empty.bag")


@pytest.mark.skipif(not DEMO.is_file(), reason="needs ../shared/data/ros1/scans_demo.bag")
def test_a_real_bag_with_two_lidars_and_no_tf():
    robot = open_robot(DEMO)
    assert (len(robot.scans), len(robot.frames), len(robot.notes)) == (331, 0, 3)
    assert "/front_scan, which has the most; there are /rear_scan too" in robot.notes[0]
    found = list(robot.scans)
    assert {scan.fault for scan in found} == {None}
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(found))
    ranges = np.stack([scan.ranges for scan in found])
    assert ranges.shape == (331, 726)
    known = ranges[np.isfinite(ranges)]
    assert known.size > 331 * 726 / 2
    assert 0.02 <= known.min() < known.max() < 5.6


def test_a_mount_turns_by_yaw_then_pitch_then_roll():
    from scipy.spatial.transform import Rotation

    T = mounted("mount", "1,2,3,0.5,-0.4,0.3")
    assert T is not None
    np.testing.assert_allclose(T[:3, :3], Rotation.from_euler("ZYX", [0.5, -0.4, 0.3]).as_matrix(), atol=1e-12)
    assert T[:3, 3].tolist() == [1, 2, 3]


def room_ranges(random, x: float, echoes: int) -> np.ndarray:
    """Return 100 ranges in a room of 8 m by 6 m from x, of which the last few met nothing and are 25 m."""
    angles = np.linspace(-np.pi, np.pi, 100, endpoint=False)
    with np.errstate(divide="ignore"):
        walls = np.minimum(
            np.where(np.cos(angles) > 0, 4 - x, 4 + x) / np.abs(np.cos(angles)), 3 / np.abs(np.sin(angles))
        )
    ranges = walls + random.normal(0, 0.01, 100)
    ranges[echoes:] = 25.0
    return ranges


@pytest.mark.parametrize(("echoes", "query", "known"), [(95, "", 95), (100, "", 100), (95, "?range_max=20", 95)])
def test_a_mark_of_no_echo_below_range_max_is_no_wall(tmp_path, echoes, query, known):
    random = np.random.default_rng(3)

    def scans(bag: RobotBagMaker) -> None:
        for k in range(8):
            ranges = room_ranges(random, 0.1 * k, echoes)
            message = bag.scan(at(k / 10), ranges, range_max=40.0, angle_increment=2 * np.pi / 100)
            bag.add("/scan", "sensor_msgs/LaserScan", at(k / 10), message)

    robot = RobotBag(f"{made(tmp_path / 'a.bag', mounts, drive, scans)}{query}")
    for scan in robot.scans:
        assert np.isfinite(scan.ranges[:echoes]).all()
        assert np.isfinite(scan.ranges).sum() == known
        assert np.isposinf(scan.ranges).sum() == (5 if query else 0)
    noted = [note for note in robot.notes if "mark of no echo" in note]
    assert len(noted) == (known < 100 and not query)


def test_the_wall_behind_a_door_is_no_mark(tmp_path):
    random = np.random.default_rng(4)

    def scans(bag: RobotBagMaker) -> None:
        for k in range(8):
            ranges = room_ranges(random, 0.0, 97)
            ranges[97:] = 12 + random.normal(0, 0.005, 3)
            message = bag.scan(at(k / 10), ranges, range_max=40.0, angle_increment=2 * np.pi / 100)
            bag.add("/scan", "sensor_msgs/LaserScan", at(k / 10), message)

    robot = RobotBag(made(tmp_path / "a.bag", mounts, drive, scans))
    assert all(np.isfinite(scan.ranges).all() for scan in robot.scans)


@ENDINGS
def test_an_image_of_another_camera_on_the_topic_is_refused(tmp_path, ending):
    def images(bag: RobotBagMaker) -> None:
        for k, frame_id in enumerate(("optical", "rear", "optical")):
            stamp = START_NS + k * 100 * MS
            pixels = 1000 + np.arange(48, dtype=np.uint16).reshape(6, 8)
            bag.add("/camera/depth/image", "sensor_msgs/Image", stamp, bag.image(stamp, pixels, frame_id))
            bag.add("/camera/depth/camera_info", "sensor_msgs/CameraInfo", stamp, bag.camera_info(stamp, 8, 6))

    path = made(tmp_path / f"a{ending}", mounts, drive, images)
    for frames in (RobotBag(path).frames, list(open_source(path))):
        assert [frame.fault for frame in frames] == [None, "no_camera", None]
        assert "it is in frame 'rear', the camera of its topic in 'optical'" in frames[1].fault_detail
