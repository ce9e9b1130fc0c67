# SPDX-License-Identifier: Apache-2.0
"""Recordings of lidars: folders of clouds, KITTI's, clouds and scans of bags; with poses, times and faults."""

import made_kitti
import numpy as np
import pytest
from made_clouds import pose as made_pose
from made_clouds import room_points
from made_robot_bags import MS, START_NS, Messages, RobotBagMaker, planar_motion, planar_numbers

import stereovox as sv
from stereovox.cli import main
from stereovox.depth.cloud import sweep_times
from stereovox.errors import NoPoses, SourceError
from stereovox.runs.survey import survey
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import read_point_cloud
from stereovox.sources.poses.trajectory import write_trajectory

POINTS = np.array([[1.0, 2.0, 0.5], [3.0, -1.0, 0.0], [np.nan, 0.0, 0.0]], np.float32)


def pose(n):
    T = np.eye(4)
    T[:3, 3] = 0.1 * n, 0.2 * n, 0.0
    return T


def write_pcd(path, points):
    lines = "\n".join(" ".join(map(str, point)) for point in points)
    head = f"VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    path.write_text(f"{head}VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA ascii\n{lines}\n")


def write_ply(path, points):
    head = (
        f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\n"
    )
    path.write_text(f"{head}end_header\n" + "\n".join(" ".join(map(str, point)) for point in points) + "\n")


def write_bin(path, points):
    np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(path)


def write_poses(folder, stamps_ns, name="poses.txt"):
    write_trajectory(folder / name, stamps_ns, np.array([pose(n) for n in range(len(stamps_ns))]), "lidar")


@pytest.fixture
def folder(tmp_path):
    """Return a folder with three clouds whose names are their times."""
    stamps = [10**9 + n * 10**8 for n in range(3)]
    for n, stamp in enumerate(stamps):
        write_pcd(tmp_path / f"{stamp / 1e9:.6f}.pcd", POINTS + 0.01 * n)
    write_poses(tmp_path, stamps)
    return tmp_path


def test_a_folder_of_clouds(folder):
    source = sv.open_source(folder)
    assert len(source) == 3
    assert source.notes == ()
    for n, cloud in enumerate(source):
        assert cloud.fault is None
        assert cloud.stamp_ns == 10**9 + n * 10**8
        np.testing.assert_allclose(cloud.T_world_sensor, pose(n), atol=1e-6)
        np.testing.assert_allclose(cloud.points, POINTS + 0.01 * n, atol=1e-6)
        assert cloud.lidar == sv.Lidar()


def test_numbered_bin_files_beside_the_poses_are_clouds_and_others_are_not(tmp_path):
    for name in ("000000", "000001", "points3D", "calibration"):
        write_bin(tmp_path / f"{name}.bin", POINTS[:2])
    with pytest.raises(SourceError, match=r"clouds \(.pcd, .ply, .bin\) \(2\) but no poses"):
        sv.open_source(tmp_path)
    write_poses(tmp_path, [0, 10**8])
    assert [sv.open_source(tmp_path).file(n).name for n in range(2)] == ["000000.bin", "000001.bin"]
    assert len(sv.open_source(tmp_path)) == 2


@pytest.mark.parametrize(("ending", "write"), [("pcd", write_pcd), ("ply", write_ply), ("bin", write_bin)])
def test_every_kind_of_file_in_a_subfolder_numbered_with_kitti_poses(tmp_path, ending, write):
    (tmp_path / "clouds").mkdir()
    for n in (0, 2, 10):  # in the order of their numbers
        write(tmp_path / f"clouds/scan{n}.{ending}", POINTS[:2] + n)
    rows = [" ".join(f"{x:.6f}" for x in pose(n)[:3].ravel()) for n in range(3)]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    source = sv.open_source(f"{tmp_path}?range_max=50&sigma=0.05&range_min=0")
    assert [frame.points[0, 0] for frame in source] == [1, 3, 11]
    assert [frame.stamp_ns for frame in source] == [0, 10**8, 2 * 10**8]
    assert "10 a second" in source.notes[0]
    np.testing.assert_allclose(source.frame(2).T_world_sensor, pose(2), atol=1e-5)
    assert source.lidar == sv.Lidar(0.05, 0.0, 50.0)
    quick = sv.open_source(f"{tmp_path}?fps=20")
    assert quick.frame(2).stamp_ns == 10**8
    assert not quick.notes


def test_times_in_a_file_and_poses_between_which_is_interpolated(tmp_path):
    for n in range(3):
        write_pcd(tmp_path / f"{n}.pcd", POINTS)
    (tmp_path / "times.txt").write_text("100.0\n100.05\n100.1\n")
    write_poses(tmp_path, [99_980_000_000, 100_060_000_000, 100_120_000_000], "way.tum")
    source = sv.open_source(f"{tmp_path}?poses=way.tum")
    assert [frame.stamp_ns for frame in source] == [100_000_000_000, 100_050_000_000, 100_100_000_000]
    np.testing.assert_allclose(source.frame(0).T_world_sensor[:2, 3], [0.025, 0.05], atol=1e-6)
    (tmp_path / "times.txt").write_text("100.0\n100.05\n")
    with pytest.raises(SourceError, match="has 2 times for 3 clouds"):
        sv.open_source(f"{tmp_path}?poses=way.tum")


def test_clouds_come_in_order_of_the_times_that_their_names_tell(tmp_path):
    for n, name in enumerate(["1.25", "1.5", "1.625"]):
        write_pcd(tmp_path / f"{name}.pcd", POINTS + n)
    write_poses(tmp_path, [1_250_000_000, 1_500_000_000, 1_625_000_000])
    frames = list(sv.open_source(tmp_path))
    assert [frame.stamp_ns for frame in frames] == [1_250_000_000, 1_500_000_000, 1_625_000_000]
    for n, frame in enumerate(frames):
        np.testing.assert_allclose(frame.T_world_sensor, pose(n))
        np.testing.assert_allclose(frame.points[0], POINTS[0] + n)


def test_numbers_that_are_no_times_are_none(tmp_path):
    write_pcd(tmp_path / f"{2**63}.pcd", POINTS)
    write_poses(tmp_path, [0])
    source = sv.open_source(tmp_path)
    assert source.frame(0).stamp_ns == 0
    assert "clouds have no times" in source.notes[0]


def test_points_that_were_seen_from_elsewhere_are_refused(folder):
    file = sorted(folder.glob("*.pcd"))[1]
    file.write_text(file.read_text().replace("VIEWPOINT 0 0 0", "VIEWPOINT 7 0 0"))
    frames = list(sv.open_source(folder))
    assert [frame.fault for frame in frames] == [None, "unreadable", None]
    assert "VIEWPOINT" in frames[1].fault_detail


def test_poses_of_a_camera_beside_the_lidar_have_other_axes(tmp_path):
    write_pcd(tmp_path / "1000000000000000000.pcd", np.array([[5.0, 0.0, 0.0]]))
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # a camera that looks along x of a world with z up
    write_trajectory(tmp_path / "poses.txt", [10**18], T[None], "camera")
    frame = sv.open_source(f"{tmp_path}?axes=optical").frame(0)
    np.testing.assert_allclose(frame.T_world_sensor, np.eye(4), atol=1e-6)


def test_a_damaged_cloud_is_a_frame_with_a_fault(folder):
    files = sorted(folder.glob("*.pcd"))
    files[1].write_text("nonsense")
    frames = list(sv.open_source(folder))
    assert [frame.fault for frame in frames] == [None, "unreadable", None]
    assert str(files[1]) in frames[1].fault_detail
    mapper = sv.Mapper(voxel_size=0.2)
    assert mapper.add(frames[1]).refused == "unreadable"


def test_a_folder_without_poses_says_so(folder):
    (folder / "poses.txt").unlink()
    with pytest.raises((NoPoses, SourceError), match="poses"):
        sv.open_source(folder)
    with pytest.raises(SourceError, match="range_mx"):
        sv.open_source(f"{folder}?poses=x&range_mx=3")


@pytest.mark.parametrize("options", ["sigma=-1", "range_max=0.1", "axes=west", "fps=-1"])
def test_bad_options_are_one_line(folder, options):
    with pytest.raises(SourceError) as refused:
        sv.open_source(f"{folder}?{options}")
    assert "\n" not in str(refused.value)


def test_a_folder_becomes_a_map_by_the_command(folder, tmp_path, capsys):
    out = tmp_path / "map"
    assert main(["map", str(folder), "--out", str(out), "--voxel-size", "0.2"]) == 0
    assert sv.load_map(out).frames == 3
    capsys.readouterr()
    assert main(["info", str(folder)]) == 0
    assert "3 clouds" in capsys.readouterr().err


def test_the_lidar_of_kitti_and_both_sensors_of_it(tmp_path):
    drive = made_kitti.raw(tmp_path, 3)
    images = sv.open_source(drive)
    clouds = sv.open_source(f"{drive}?sensor=velodyne&range_max=30")
    assert len(clouds) == 3
    for n, cloud in enumerate(clouds):
        scan = images.scan(n)
        np.testing.assert_array_equal(cloud.points, scan.points)
        np.testing.assert_array_equal(cloud.T_world_sensor, scan.T_world_lidar)
        assert (cloud.stamp_ns, cloud.lidar.range_max, cloud.sensor) == (scan.stamp_ns, 30, "velodyne")
    both = sv.open_source(f"{drive}?sensor=both&poses=oxts")
    assert [type(frame).__name__ for frame in both] == ["StereoFrame", "Cloud"] * 3
    assert [frame.stamp_ns for frame in both] == [images.stamp_ns(n) for n in (0, 0, 1, 1, 2, 2)]
    (drive / "velodyne_points/data/0000000001.bin").unlink()
    assert [frame.fault for frame in clouds] == [None, "missing_file", None]


def test_a_recording_without_lidar_has_no_velodyne(tmp_path):
    drive = made_kitti.raw(tmp_path, 2)
    (drive.parent / "calib_velo_to_cam.txt").unlink()
    with pytest.raises(SourceError, match="no lidar scans"):
        sv.open_source(f"{drive}?sensor=velodyne&poses={_poses_file(drive)}")


def _poses_file(drive):
    write_trajectory(drive / "way.tum", [0, 1], np.array([np.eye(4)] * 2), "camera")
    return "way.tum"


def write_bag(path, times=None, kind=7, count=3):
    """Write clouds of a lidar that drives along x at 1 m/s, with the times of their points as field `t`."""
    with RobotBagMaker(path) as bag:
        for k in range(10 * count + 20):
            stamp = START_NS + (10 * k - 100) * MS
            bag.tf(stamp, "odom", "lidar", planar_numbers((stamp - START_NS) / 1e9, 0, 0))
        for n in range(count):
            stamp = START_NS + 100 * n * MS
            bag.add("/points", "sensor_msgs/PointCloud2", stamp + 2 * MS, _cloud(bag, stamp, times, kind))
        bag.scans(3, frame_id="lidar")
    return path


def _cloud(bag, stamp, times, kind):
    points = np.array([[2.0, 1.0, 0.0], [4.0, 1.0, 0.0], [np.nan] * 3], np.float32)
    points[0, 2] = 1e-9 * (stamp - START_NS)  # no two clouds are alike
    if times is None:
        return bag.cloud(stamp, points)
    dtype = {7: "<f4", 6: "<u4", 8: "<f8"}[kind]
    data = np.zeros(3, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", dtype)])
    data["x"], data["y"], data["z"] = points.T
    data["t"] = times(stamp) if callable(times) else times
    fields = [bag.field(name, 4 * k, 7) for k, name in enumerate("xyz")] + [bag.field("t", 12, kind)]
    step = data.dtype.itemsize
    return bag.cloud(
        stamp, points, fields=fields, point_step=step, row_step=3 * step, data=np.frombuffer(data.tobytes(), np.uint8)
    )


@pytest.fixture(params=["drive.bag", "drive"])
def bag(request, tmp_path):
    return write_bag(tmp_path / request.param)


def test_clouds_of_a_bag(bag):
    source = sv.open_source(f"{bag}?cloud=/points")
    assert len(source) == 3
    assert any("have no times" in note for note in source.notes)
    for n, cloud in enumerate(source):
        assert cloud.fault is None
        assert cloud.stamp_ns == START_NS + 100 * n * MS
        np.testing.assert_allclose(cloud.T_world_sensor, planar_motion(0.1 * n, 0, 0), atol=1e-6)
        assert cloud.origins is None
    mapper = sv.Mapper(voxel_size=0.5)
    assert [mapper.add(cloud).refused for cloud in source] == [None] * 3


LIDARS = {"front": [1.0, 0, 0.5, 0, 0, 0, 1], "roof": [0.2, 0.1, 1.0, 1, 0, 0, 0]}
"""Mounts of two lidars, one of them upside down: tx ty tz qx qy qz qw."""


def write_based_bag(path, frames=("front", "roof"), static=True):
    """Write clouds of lidars on a base of which only the odometry is known: x = time, turning at 1 rad/s."""
    with RobotBagMaker(path) as bag:
        for name, numbers in LIDARS.items() if static else ():
            bag.tf(START_NS, "base_link", name, numbers, "/tf_static")
        for k in range(-5, 40):
            stamp = START_NS + 10 * k * MS
            numbers = planar_numbers(0.01 * k, 0, 0.01 * k)
            bag.add("/odom", "nav_msgs/Odometry", stamp, bag.odometry(stamp, numbers))
        for n, name in enumerate(frames):
            stamp = START_NS + 100 * n * MS
            bag.add("/points", "sensor_msgs/PointCloud2", stamp, bag.cloud(stamp, POINTS[:2], name))
    return path


@pytest.mark.parametrize("name", ["drive.bag", "drive"])
def test_odometry_of_the_base_and_several_lidars_on_one_topic(tmp_path, name):
    source = sv.open_source(f"{write_based_bag(tmp_path / name)}?cloud=/points")
    world = np.array([cloud.T_world_sensor @ [1, 2, 0.5, 1] for cloud in source])
    ahead = np.array([2.0, 2.0, 1.0])  # the first point, from the front
    turned = [0.2 + 1.0, 0.1 - 2.0, 1.0 - 0.5]  # and from the roof, where y and z point the other way
    c, s = np.cos(0.1), np.sin(0.1)
    turned = [0.1 + c * turned[0] - s * turned[1], s * turned[0] + c * turned[1], turned[2]]
    np.testing.assert_allclose(world[:, :3], [ahead, turned], atol=1e-6)


def test_a_lidar_that_nothing_mounts_is_refused_until_the_user_does(tmp_path):
    path = write_based_bag(tmp_path / "drive.bag", ("front", "front"), static=False)
    cloud = sv.open_source(f"{path}?cloud=/points").frame(0)
    assert cloud.fault == "no_pose"
    assert "nothing in /tf connects it with the sensor's frame 'front'" in cloud.fault_detail
    assert "?mount=x,y,z,yaw,pitch,roll" in cloud.fault_detail
    T = sv.open_source(f"{path}?cloud=/points&mount=0.2,0.1,1,0,0,{np.pi}").frame(0).T_world_sensor
    np.testing.assert_allclose(T @ [1, 2, 0.5, 1], [1.2, -1.9, 0.5, 1], atol=1e-6)
    two = write_based_bag(tmp_path / "two.bag", static=False)
    faults = [cloud.fault for cloud in sv.open_source(f"{two}?cloud=/points&mount=0,0,0")]
    assert faults == [None, "no_pose"]  # the second is of another sensor


def test_clouds_in_the_world_have_no_rays(tmp_path):
    with RobotBagMaker(tmp_path / "drive.bag") as bag:
        for k in range(40):
            bag.tf(START_NS + 10 * k * MS, "odom", "lidar", planar_numbers(0.01 * k, 0, 0))
        bag.add("/points", "sensor_msgs/PointCloud2", START_NS, bag.cloud(START_NS, POINTS[:2], "odom"))
    with pytest.raises(SourceError, match="in frame 'odom', in which lidar moves, so its rays have no origin"):
        sv.open_source(f"{bag.path}?cloud=/points")
    path = write_based_bag(tmp_path / "based.bag", ("odom",))
    assert "no origin" in sv.open_source(f"{path}?cloud=/points").frame(0).fault_detail


def test_poses_of_a_slam_program_for_its_own_bag(tmp_path):
    path, stamps = write_based_bag(tmp_path / "drive.bag", ("front",) * 3), [START_NS + 100 * n * MS for n in range(3)]
    write_poses(tmp_path, stamps, "fast_lio.tum")
    np.savetxt(tmp_path / "kiss.txt", np.array([pose(n) for n in range(3)])[:, :3].reshape(3, 12))
    for name in ("fast_lio.tum", "kiss.txt"):
        for n, cloud in enumerate(sv.open_source(f"{path}?cloud=/points&poses={name}")):
            np.testing.assert_allclose(cloud.T_world_sensor, pose(n), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "times"),
    [
        (7, [0.0, 0.05, 0.0]),
        (6, [0, 50_000_000, 0]),
        (8, lambda stamp: 1e-9 * stamp + np.array([0.0, 0.05, 0.0])),
        (8, lambda stamp: stamp + np.array([0.0, 5e7, 0.0])),
        (7, [0.0, 5e4, 0.0]),
        (6, [0, 50_000, 0]),
        (7, [0.0, 50.0, 0.0]),
        (8, lambda stamp: 1e-3 * stamp + np.array([0.0, 5e4, 0.0])),
        (8, lambda stamp: 1e-9 * stamp + np.array([0.0, 0.05, -1e-9 * stamp])),
        (6, [3_000_000_000, 3_050_000_000, 0]),
        (8, [777.0, 777.05, 0.0]),
        (7, [0.0, 0.5, 1.0]),
    ],
    ids=["seconds", "nanoseconds", "clock", "clock in nanoseconds", "float us", "whole us", "ms", "clock in us",
         "no time for no point", "another clock", "seconds of another clock", "share of the sweep"],
)  # fmt: skip
def test_points_with_times_are_straightened(tmp_path, kind, times):
    path = write_bag(tmp_path / "drive.bag", times, kind)
    cloud = sv.open_source(f"{path}?cloud=/points").frame(0)
    np.testing.assert_allclose(cloud.points[:2], [[2.0, 1, 0], [4.05, 1, 0]], atol=2e-3)
    np.testing.assert_allclose(cloud.origins[:2], [[0, 0, 0], [0.05, 0, 0]], atol=2e-3)
    raw = sv.open_source(f"{path}?cloud=/points&deskew=0").frame(0)
    np.testing.assert_array_equal(raw.points[1], [4, 1, 0])
    assert raw.origins is None


def test_scans_of_a_bag_in_three_dimensions(bag):
    source = sv.open_source(f"{bag}?scan=/scan")
    cloud = source.frame(0)
    np.testing.assert_allclose(np.linalg.norm(cloud.points, axis=1), [1, 2, 3], atol=1e-6)
    np.testing.assert_allclose(np.arctan2(cloud.points[:, 1], cloud.points[:, 0]), [-1, -0.5, 0], atol=1e-6)
    assert cloud.lidar.range_max == pytest.approx(5.6)
    mapper = sv.Mapper(voxel_size=0.2)
    assert mapper.add(cloud).refused is None


def test_beams_without_echo_are_free_up_to_where_the_lidar_measures(tmp_path):
    with RobotBagMaker(tmp_path / "a.bag") as bag:
        for k in range(20):
            bag.tf(START_NS + (k - 5) * 20 * MS, "odom", "laser", planar_numbers(0, 0, 0))
        message = bag.scan(START_NS, [1.0, np.inf, np.nan, 0.0])
        bag.add("/scan", "sensor_msgs/LaserScan", START_NS, message)
    cloud = sv.open_source(f"{tmp_path / 'a.bag'}?scan=/scan").frame(0)
    assert len(cloud.points) == len(cloud.clear) == 1
    np.testing.assert_allclose(cloud.clear[0], (5.6 - 4 * 0.02) * np.array([np.cos(-0.5), np.sin(-0.5), 0]), atol=1e-5)


RING = {"/left": ("left", 0.5), "/right": ("right", -0.5)}
"""Sonars of a robot: frame and yaw."""


def write_sonars(path, distances):
    """Write two sonars of a base that drives along x at 1 m/s; the right one is silent."""
    with RobotBagMaker(path) as bag:
        for frame, yaw in RING.values():
            bag.tf(START_NS, "base_link", frame, planar_numbers(0.2, 0, yaw), "/tf_static")
        for k in range(-5, 10 * len(distances)):
            stamp = START_NS + 10 * k * MS
            bag.tf(stamp, "odom", "base_link", planar_numbers(0.01 * k, 0, 0))
        for n, distance in enumerate(distances):
            for m, (topic, (frame, _)) in enumerate(RING.items()):
                stamp = START_NS + (100 * n + 30 * m) * MS
                message = bag.make(
                    "sensor_msgs/Range", header=bag.header(stamp, frame), radiation_type=0, field_of_view=0.4,
                    min_range=0.2, max_range=3.0, range=distance if m == 0 else 3.0,
                )  # fmt: skip
                bag.add(topic, "sensor_msgs/Range", stamp, message)
    return path


@pytest.mark.parametrize("name", ["sonars.bag", "sonars"])
def test_ranges_of_several_sonars_in_a_bag(tmp_path, name):
    heard = [1.0, 1.5, np.inf, -np.inf, np.nan, 3.5, 0.1, 3.0]
    source = sv.open_source(f"{write_sonars(tmp_path / name, heard)}?range=/left,/right")
    seen = list(source)
    assert [one.sensor for one in seen] == ["/left", "/right"] * len(heard)
    distances = [one.distance for one in seen if one.sensor == "/left"]
    np.testing.assert_equal(distances, [1.0, 1.5, np.inf, -np.inf, np.nan, np.nan, np.nan, np.inf])
    for one in seen:
        yaw = dict(RING.values())[one.sensor[1:]]
        np.testing.assert_allclose(
            one.T_world_sensor, planar_motion(0.2 + (one.stamp_ns - START_NS) / 1e9, 0, yaw), atol=1e-6
        )
        assert (one.beam.beam, one.beam.range_max) == (pytest.approx(0.4), 3.0)
    mapper = sv.Mapper(voxel_size=0.1)
    assert [mapper.add(one).refused for one in seen] == [None, "no_valid_range"] * 2 + ["no_valid_range"] * 12
    free = sv.open_source(f"{tmp_path / name}?range=/right&silence_clears=1&sigma=0.1")
    assert mapper.add(free.frame(0)).refused is None
    assert free.frame(0).beam.sigma == 0.1


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("range=/left,/right&mount=0.1,0,0", "have their mounts in /tf"),
        ("range=/left&range_max=2", "range_max= is not for"),
        ("range=/left&deskew=0", "deskew= is not for"),
    ],
)
def test_options_that_ranges_do_not_use_are_refused(tmp_path, options, why):
    bag = write_sonars(tmp_path / "sonars.bag", [1.0, 1.0])
    with pytest.raises(SourceError, match=why):
        sv.open_source(f"{bag}?{options}")


def test_ranges_without_poses_are_ranges_all_the_same(tmp_path):
    with RobotBagMaker(tmp_path / "a.bag") as bag:
        for n in range(3):
            stamp = START_NS + 100 * n * MS
            message = bag.make("sensor_msgs/Range", header=bag.header(stamp, "left"), radiation_type=0, range=1.0,
                               field_of_view=np.float32(np.pi), min_range=0.2, max_range=3.0)  # fmt: skip
            bag.add("/left", "sensor_msgs/Range", stamp, message)
    source = sv.open_source(f"{tmp_path / 'a.bag'}?range=/left")
    assert [(type(one), one.fault) for one in source] == [(sv.Range, "no_pose")] * 3
    assert survey(source).kind == "range"


def test_a_second_topic_in_the_worlds_own_frame_is_refused(tmp_path):
    """Its rays would begin at the world's origin, and clear what nobody saw."""
    with RobotBagMaker(tmp_path / "two.bag") as bag:
        for k in range(40):
            stamp = START_NS + (10 * k - 100) * MS
            bag.tf(stamp, "odom", "lidar", planar_numbers(0.01 * k, 0, 0))
        for topic, frame in (("/points", "lidar"), ("/map", "odom")):
            for n in range(2):
                stamp = START_NS + 100 * n * MS
                bag.add(topic, "sensor_msgs/PointCloud2", stamp, bag.cloud(stamp, POINTS[:2] + n, frame))
    path = tmp_path / "two.bag"
    assert len(list(sv.open_source(f"{path}?cloud=/points"))) == 2
    with pytest.raises(SourceError, match="/map is in frame 'odom', in which lidar moves"):
        sv.open_source(f"{path}?cloud=/points,/map")


def test_a_bag_of_ranges_becomes_a_map_by_the_command(tmp_path, capsys):
    bag = write_sonars(tmp_path / "sonars.bag", [1.0, 1.0, 1.0, 1.01, 1.02, 1.0])
    assert main(["map", f"{bag}?range=/left", "--out", str(tmp_path / "m.svox"), "--voxel-size", "0.1"]) == 0
    found = sv.load_map(tmp_path / "m.svox")
    ahead = planar_motion(0.2, 0, 0.5) @ [0.5, 0, 0, 1]
    assert found.probability(ahead[None, :3])[0] < 0.4
    with pytest.raises(SourceError, match=r"holds sensor_msgs/Range; \?scan= needs"):
        sv.open_source(f"{bag}?scan=/left")


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ("cloud=/nowhere", "no topic /nowhere"),
        ("cloud=/scan", "holds sensor_msgs/LaserScan"),
        ("cloud=/points&scan=/scan", "give one of"),
        ("cloud=/points,/scan", "holds sensor_msgs/LaserScan"),
        ("cloud=/points,/points", "several topics must differ"),
        ("cloud=/points&silence_clears=1", "silence_clears= is not for"),
        ("cloud=/points&depth=/d", "unknown parameter 'depth'"),
        ("cloud=/points&sigma=0.0001&range_min=-3", "range"),
    ],
)
def test_what_a_bag_does_not_have_is_one_line(bag, options, why):
    with pytest.raises(SourceError, match=why) as refused:
        sv.open_source(f"{bag}?{options}")
    assert "\n" not in str(refused.value)


def test_a_bag_without_depth_images_names_its_clouds(bag):
    with pytest.raises(SourceError, match=r"\?cloud=/points"):
        sv.open_source(bag)


def test_a_cloud_whose_time_no_pose_covers_has_a_fault(tmp_path):
    path = write_bag(tmp_path / "drive.bag", [0.0, 5.0, 0.0])
    assert sv.open_source(f"{path}?cloud=/points").frame(0).fault == "no_pose"


def test_fields_of_times_that_do_not_fit_are_left_out():
    messages = Messages(1)
    cloud = messages.cloud(
        5,
        np.ones((2, 3)),
        fields=[*(messages.field(n, 4 * k, 7) for k, n in enumerate("xyz")), messages.field("t", 10, 8)],
    )
    assert read_point_cloud(messages.wire("sensor_msgs/PointCloud2", cloud)).times_s is None


def test_a_clock_in_float32_says_nothing():
    """Its steps at today's dates are 128 s, so its points would be taken from far along the drive."""
    stamp, points = 1_700_000_000_000_000_000, np.ones(3, bool)
    for times in (np.full(3, 1.7e9, "f4"), np.array([1.7e9, 1.7e9 + 128, 1.7e9], "f4")):
        found = sweep_times(times, points, stamp, 0.1)
        assert found.seconds is None
        assert "too coarse" in found.words


def test_times_that_fit_no_sweep_refuse_the_cloud(tmp_path):
    path = write_bag(tmp_path / "drive.bag", [0.0, 5.0, 0.0])
    detail = sv.open_source(f"{path}?cloud=/points").frame(0).fault_detail
    assert "span 5, in no unit between 0.01 and 0.25 s; add ?deskew=0" in detail
    assert sv.open_source(f"{path}?cloud=/points&deskew=0").frame(0).fault is None


@pytest.mark.parametrize("ros", [1, 2])
def test_clouds_of_the_first_version_and_of_livox(tmp_path, ros):
    """By their definitions: PointCloud.msg, and CustomMsg.msg of livox_ros_driver2, whose points have 19 bytes."""
    messages, points = Messages(ros), POINTS[:2]
    head = messages.raw("std_msgs/Header", messages.header(START_NS, "lidar"))
    head += bytes(-(len(head) - 4) % 4) if ros == 2 else b""
    name = b"t\0\0\0" if ros == 2 else b"t"
    channels = np.uint32([1, 2 if ros == 2 else 1]).tobytes() + name
    first = head + np.uint32(2).tobytes() + points.tobytes() + channels + np.uint32(2).tobytes()
    first += np.float32([0, 0.05]).tobytes()
    base = bytes(-(len(head) - 4) % 8) if ros == 2 else b""
    livox = head + base + np.uint64(START_NS + 10**6).tobytes() + np.uint32(2).tobytes() + bytes([3, 0, 0, 0])
    livox += np.uint32(2).tobytes()
    for n, point in enumerate(points):
        livox += np.uint32(n * 50_000_000).tobytes() + point.tobytes() + bytes([9, 8, 7])
        livox += b"\0" if ros == 2 and n == 0 else b""
    for kind, data, times in (
        ("sensor_msgs/PointCloud", first, [0, 0.05]),
        ("livox_ros_driver2/CustomMsg", livox, [0.001, 0.051]),
    ):
        cloud = read_point_cloud(Wire(data, cdr=ros == 2), kind, 0.1)
        assert (cloud.stamp_ns, cloud.frame_id, cloud.fault) == (START_NS, "lidar", "")
        np.testing.assert_array_equal(cloud.points, points)
        np.testing.assert_allclose(cloud.times_s, times, atol=1e-8)
        for length in range(0, len(data), 3):
            with pytest.raises(ValueError, match=r"bytes are announced|numbers"):
                read_point_cloud(Wire(data[:length], cdr=ros == 2), kind, 0.1)


def lidar_points(order, seed=1):
    """What a lidar of 16 rings measures in a room, in the order of its rings, of its columns, or in none."""
    elevation, azimuth = np.radians(np.linspace(-15, 15, 16)), np.linspace(-np.pi, np.pi, 400, endpoint=False)
    e, a = np.meshgrid(elevation, azimuth, indexing="ij" if order == "rings" else "xy")
    if order == "rings":
        e, a = e.ravel(), a.ravel()
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], -1).reshape(-1, 3)
    points = room_points(made_pose(0.7, 0.4), directions) + np.random.default_rng(seed).normal(0, 0.01, (6400, 3))
    return np.random.default_rng(seed).permutation(points) if order == "none" else points


@pytest.mark.parametrize("order", ["rings", "columns", "none"])
@pytest.mark.parametrize(("columns", "dtype"), [(3, "<f4"), (4, "<f4"), (5, "<f4"), (6, "<f4"), (3, "<f8"), (4, "<f8")])
def test_raw_clouds_of_any_maker(tmp_path, order, columns, dtype):
    """x, y, z, then intensity, ring (nuScenes) and time."""
    points = lidar_points(order)
    rest = [np.random.default_rng(0).uniform(0, 1, 6400), np.arange(6400) % 16, np.linspace(0, 0.1, 6400)]
    table = np.column_stack([points, *rest])[:, :columns].astype(dtype)
    (tmp_path / "scans").mkdir()
    for n in range(2):
        table.tofile(tmp_path / f"scans/{n:06d}.bin")
    write_poses(tmp_path, [0, 10**8])
    source = sv.open_source(tmp_path)
    np.testing.assert_allclose(source.frame(1).points, points, atol=1e-5)
    assert any("a point" in note for note in source.notes) is ((columns, dtype) != (4, "<f4"))


def test_raw_clouds_of_an_unknown_layout_are_refused(tmp_path):
    (tmp_path / "scans").mkdir()
    lidar_points("rings").T.astype("<f4").tofile(tmp_path / "scans/000000.bin")  # all x, then all y, then all z
    write_poses(tmp_path, [0])
    with pytest.raises(SourceError, match=r"not known how many numbers a point has.*\?columns="):
        sv.open_source(tmp_path)
    assert sv.open_source(f"{tmp_path}?columns=3").frame(0).fault is None
    with pytest.raises(SourceError, match="columns=2 must be 3 to 32"):
        sv.open_source(f"{tmp_path}?columns=2")


def test_a_lidar_on_a_body_whose_poses_a_folder_holds(folder):
    mount = sv.open_source(f"{folder}?mount=0.5,0,1,0,0,{np.pi}")  # upside down
    T = np.diag([1.0, -1, -1, 1])
    T[:3, 3] = 0.5, 0, 1
    np.testing.assert_allclose(mount.frame(1).T_world_sensor, pose(1) @ T, atol=1e-6)
