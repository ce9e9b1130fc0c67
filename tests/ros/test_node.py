# SPDX-License-Identifier: Apache-2.0
"""The node in one process: what it receives, publishes and does on request."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import wire
from made_walks import CAMERA, DEPTH, OPTICAL, START_NS, T_BASE_CAMERA, base_at, depth_at

rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import PoseStamped  # noqa: E402
from nav_msgs.msg import OccupancyGrid, Odometry, Path  # noqa: E402
from nav_msgs.srv import LoadMap  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image, PointCloud2  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from stereovox.config import load_config  # noqa: E402
from stereovox.errors import StereovoxError  # noqa: E402
from stereovox.geometry.se3 import from_quaternion, inverse  # noqa: E402
from stereovox.maps import load_map  # noqa: E402
from stereovox.products.projection import project  # noqa: E402
from stereovox.ros.library import optional_message  # noqa: E402
from stereovox.ros.mapping import Mapping  # noqa: E402
from stereovox.ros.node import MapNode  # noqa: E402
from stereovox.ros.options import Options, freeze  # noqa: E402
from stereovox.ros.poses.poses import fixed_transform  # noqa: E402
from stereovox.ros.poses.tf_message import tf_message  # noqa: E402
from stereovox.simulate.simulation import Simulation  # noqa: E402

TFMessage = tf_message()
Octomap = optional_message("octomap_msgs", "Octomap")
MOUNT = f"base_link {OPTICAL} 0.1 0 0.4 -1.5708 0 -1.5708"
STANDS = {"scan.floor": 0.0, "scan.heights": [0.1, 0.6], "trust.stale_s": 600.0, "trust.lost_s": 900.0}
"""The images of the walk show no floor: its world stands on it. On a busy machine, maps are published however late."""
BY_TF = {"odometry": (), "fixed": ()} if TFMessage else {"odometry": ("/odom",), "fixed": (MOUNT,)}
"""tf2_msgs is not on PyPI: without it poses come by odometry."""
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENCE_S = 60.0


class Robot:
    """A node, and next to it one that sends and listens."""

    def __init__(self, out: str):
        self.options = Options(depth=(DEPTH,), wait_s=0.3, cloud_rate=20.0, late_s=60.0, out=out, **BY_TF)
        self.reports = []
        self.mapping = Mapping(load_config(voxel_size=0.1, **STANDS))
        given = [rclpy.Parameter("voxel_size", value=0.1)]
        node = rclpy.create_node(
            "stereovox", parameter_overrides=given, automatically_declare_parameters_from_overrides=True
        )
        self.other = rclpy.create_node("robot")
        freeze(node, out)
        self.node = node
        self.maker = MapNode(
            node, self.mapping, self.options, lambda: str(node.get_parameter("ros.out").value), self.reports.append
        )
        self.listening = SingleThreadedExecutor()
        self.listening.add_node(self.other)
        kinds = {DEPTH: Image, "/camera/depth/camera_info": CameraInfo}
        kinds |= {"/tf": TFMessage} if TFMessage else {"/odom": Odometry}
        self.send = {topic: self.other.create_publisher(kind, topic, 20) for topic, kind in kinds.items()}
        if TFMessage:
            self.send["/tf_static"] = self.other.create_publisher(TFMessage, "/tf_static", KEPT)
        self.came: dict[str, list] = {}

    def listen(self, kind, topic, qos=KEPT):
        self.came[topic] = []
        self.other.create_subscription(kind, topic, self.came[topic].append, qos)

    def until(self, condition):
        end = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < end, "nothing came"
            self.maker.spin_once()
            self.listening.spin_once(timeout_sec=0.01)

    def drive(self, frames: int, first: int = 0):
        self.until(lambda: all(one.get_subscription_count() for one in self.send.values()))
        made = wire.messages()
        if TFMessage:
            self.publish("/tf_static", made.transforms(0, [("base_link", OPTICAL, T_BASE_CAMERA)]))
        for k in range(first, first + frames):
            frame = depth_at(k)
            self.publish("/camera/depth/camera_info", made.camera_info(CAMERA, frame.stamp_ns, OPTICAL))
            self.publish(DEPTH, made.image(frame.depth, frame.stamp_ns, OPTICAL))
            self.stand(base_at(frame.stamp_ns), frame.stamp_ns)
        self.until(lambda: len(self.reports) == first + frames)

    def stand(self, T, stamp_ns):
        if TFMessage:
            self.publish("/tf", wire.messages().transforms(stamp_ns, [("odom", "base_link", T)]))
        else:
            pose = np.array([T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])])
            self.publish("/odom", wire.messages().odometry(pose, stamp_ns, "odom", "base_link"))

    def correct(self, frames, T):
        """Send a path of the robot on which some frames are moved."""
        made, poses = wire.messages(), []
        for stamp_ns in (depth_at(k).stamp_ns for k in frames):
            pose = made._pose(T @ base_at(stamp_ns))
            poses.append(wire.made("geometry_msgs/msg/PoseStamped", header=wire.header(stamp_ns, ""), pose=pose))
        self.publish("/path", wire.made("nav_msgs/msg/Path", header=wire.header(0, "odom"), poses=poses))

    def publish(self, topic, message):
        self.send[topic].publish(wire.packed(message))

    def call(self, kind, name, request=None):
        client = self.other.create_client(kind, name)
        self.until(client.service_is_ready)
        future = client.call_async(request or kind.Request())
        self.until(future.done)
        return future.result()


@pytest.fixture
def robot(tmp_path, monkeypatch, domains):
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domains[1]))
    rclpy.init(args=[])
    robot = Robot(str(tmp_path / "live.svox"))
    yield robot
    robot.maker.close()
    robot.node.destroy_node()
    robot.other.destroy_node()
    rclpy.shutdown()


def test_what_is_published_is_what_the_map_says(robot):
    topics = {"/map_mapping": OccupancyGrid, "/occupied_cells": PointCloud2}
    if Octomap is not None:
        topics["/octomap_binary"] = Octomap
    for topic, kind in topics.items():
        robot.listen(kind, topic)
    robot.listen(DiagnosticArray, "/diagnostics", 10)
    robot.drive(4)
    last_ns = depth_at(3).stamp_ns

    def all_came():
        stamps = [robot.came[topic][-1].header.stamp if robot.came[topic] else None for topic in topics]
        return all(stamp and stamp.sec * 10**9 + stamp.nanosec == last_ns for stamp in stamps)

    def diagnosed():
        return {pair.key: pair.value for one in robot.came["/diagnostics"][-1:] for pair in one.status[0].values}

    robot.until(lambda: all_came() and diagnosed().get("frames_in_map") == "4")
    voxel_map = robot.mapping.snapshot()()
    grid, cloud, *octomap = (robot.came[topic][-1] for topic in topics)
    assert {one.header.frame_id for one in (grid, cloud, *octomap)} == {"odom"}
    check_grid(grid, project(voxel_map))
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)
    np.testing.assert_allclose(points[:, :3], voxel_map.occupied(), atol=1e-6)
    np.testing.assert_allclose(points[:, 3], voxel_map.probability(voxel_map.occupied()), atol=1e-6)
    assert [(field.name, field.offset) for field in cloud.fields][-1] == ("probability", 12)
    for message in octomap:
        check_octomap(message, voxel_map)
    assert diagnosed()["received"] == "4"
    levels = {one.status[0].message.partition(":")[0]: one.status[0].level for one in robot.came["/diagnostics"]}
    assert levels.items() <= {"waiting": b"\1", "current": b"\0", "stale": b"\3"}.items()


def shifted(x, y, z):
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def check_grid(message, expected):
    cells = np.array(message.data, np.int8).reshape(message.info.height, message.info.width)
    known = np.argwhere(cells >= 0)
    (bottom, left), (top, right) = known.min(axis=0), known.max(axis=0) + 1
    np.testing.assert_array_equal(cells[bottom:top, left:right], expected.message_cells)
    side, place = message.info.resolution, message.info.origin.position
    assert side == pytest.approx(0.1)
    assert (place.x + left * side, place.y + bottom * side) == pytest.approx(expected.origin[:2], abs=1e-5)


def shows(messages, expected):
    """Return whether the last grid received is as expected."""
    try:
        check_grid(messages[-1], expected)
    except (AssertionError, IndexError):
        return False
    return True


def check_octomap(message, voxel_map):
    """Read the message with OctoMap itself."""
    octomap = pytest.importorskip("octomap", reason="octomap-python is not installed")
    assert (message.id, message.binary) == ("OcTree", True)
    data = bytes(np.array(message.data, np.int8).tobytes())
    children = np.frombuffer(data, "<u2")[:, None] >> 2 * np.arange(8) & 3
    size = len(children) + np.isin(children, (1, 2)).sum()  # inner nodes and leaves
    text = f"# Octomap OcTree binary file\nid OcTree\nsize {size}\nres {message.resolution!r}\ndata\n"
    tree = octomap.OcTree(message.resolution)
    assert tree.readBinary(text.encode() + data)
    occupied = [tree.isNodeOccupied(tree.search(point)) for point in voxel_map.occupied()]
    free = [tree.isNodeOccupied(tree.search(point)) for point in voxel_map.free()]
    assert all(occupied)
    assert not any(free)


def test_a_frame_whose_pose_never_comes_is_refused_and_counted(robot):
    robot.drive(1)
    late = depth_at(30)
    robot.publish(DEPTH, wire.messages().image(late.depth, late.stamp_ns, OPTICAL))
    robot.publish(DEPTH, wire.messages().image(late.depth[:, :9], START_NS, OPTICAL))
    robot.until(lambda: len(robot.reports) == 3)
    assert robot.mapping.history.frames == 1
    assert dict(robot.mapping.history.refused) == {"no_pose": 1, "bad_shape": 1}


def test_without_tf2_msgs_odometry_and_mounts_do(robot, monkeypatch, capfd):
    monkeypatch.setattr("stereovox.ros.subscriptions.tf_message", lambda: None)
    other = rclpy.create_node("no_tf")
    options = Options(depth=(DEPTH,), odometry=("/odom",), fixed=(MOUNT,))
    mapping, reports = Mapping(load_config(voxel_size=0.1, **STANDS)), []
    maker = MapNode(other, mapping, options, str, reports.append)
    odometry = robot.send.get("/odom") or robot.other.create_publisher(Odometry, "/odom", 10)
    robot.maker = maker
    robot.until(lambda: odometry.get_subscription_count() and robot.send[DEPTH].get_subscription_count() == 2)
    made, frame = wire.messages(), depth_at(0)
    robot.publish("/camera/depth/camera_info", made.camera_info(CAMERA, frame.stamp_ns, OPTICAL))
    robot.publish(DEPTH, made.image(frame.depth, frame.stamp_ns, OPTICAL))
    odometry.publish(wire.packed(made.odometry(np.zeros(3), frame.stamp_ns, "odom", "base_link")))
    robot.until(lambda: reports)
    assert [report.refused for report in reports] == [None]
    assert "/tf is ignored" in capfd.readouterr().err
    T_world_camera = mapping.mapper.map.viewpoint.T_world_camera
    np.testing.assert_allclose(T_world_camera[:3, 3], [0.1, 0, 0.4], atol=1e-6)
    np.testing.assert_allclose(T_world_camera[:3, 2], [1, 0, 0], atol=1e-4)  # it looks ahead


def test_without_tf2_msgs_and_any_other_pose_the_node_says_so_at_once(robot, monkeypatch):
    monkeypatch.setattr("stereovox.ros.subscriptions.tf_message", lambda: None)
    other = rclpy.create_node("no_poses")
    with pytest.raises(StereovoxError, match=r"^no poses: tf2_msgs is not installed.*--odometry") as error:
        MapNode(other, Mapping(load_config(voxel_size=0.1, **STANDS)), Options(depth=(DEPTH,)), str)
    assert len(str(error.value)) <= 300
    other.destroy_node()


def test_names_that_no_topic_has_end_in_one_line(robot):
    for options in (Options(depth=("a b",)), Options(depth=("",)), Options(depth=(DEPTH,), odometry=("1x",))):
        with pytest.raises(StereovoxError, match=r"^topic '.*': Invalid topic name.*[^:]$"):
            MapNode(robot.node, robot.mapping, options, str)


def test_a_corrected_path_changes_what_is_published_and_no_frame_is_lost(robot):
    """The map and the grid become those of a new run at the path's poses; images keep arriving meanwhile."""
    settings = {"voxel_size": 0.1, "map.keep_frames": True, "trust.max_disagreement": 1}
    other = rclpy.create_node("corrected")
    options = replace(robot.options, corrected_path="/path", path_frame="base_link", out="")
    mapping = Mapping(load_config(**STANDS, **settings))
    robot.mapping.close()
    robot.maker = MapNode(other, mapping, options, str, robot.reports.append)
    robot.send["/path"] = robot.other.create_publisher(Path, "/path", 1)
    robot.listen(OccupancyGrid, "/map_mapping")
    robot.listen(DiagnosticArray, "/diagnostics", 10)
    robot.until(lambda: robot.send["/path"].get_subscription_count())
    robot.drive(4)
    robot.correct(range(4), shifted(1.0, -0.3, 0.2))
    robot.drive(3, first=4)
    robot.until(lambda: robot.maker.counts()["corrections"] == 1)
    shift = shifted(0.5, -0.3, 0.2)
    robot.correct(range(4), shift)  # when no image comes any longer
    robot.until(lambda: robot.maker.counts()["corrections"] == 2)
    assert robot.maker.counts()["frames_in_map"] == 7
    new = Mapping(load_config(**STANDS, **settings))
    for k, kept in enumerate(mapping.mapper.map.kept_frames.frames):
        wanted = depth_at(k).T_world_sensor
        np.testing.assert_allclose(kept.T_world_sensor, shift @ wanted if k < 4 else wanted, atol=1e-5)
        assert new.add(replace(depth_at(k), T_world_sensor=kept.T_world_sensor, sensor=DEPTH)).refused is None
    for mine, theirs in zip(mapping.snapshot()().storage.blocks(), new.snapshot()().storage.blocks(), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    robot.until(lambda: shows(robot.came["/map_mapping"], project(new.snapshot()())))
    robot.maker.close()
    other.destroy_node()


def test_a_jump_of_odometry_in_the_map_is_noticed_while_it_drives(robot):
    """Here the pose of odom in the map arrives as a message; with tf2_msgs it may also arrive on /tf."""
    other = rclpy.create_node("jumping")
    options = replace(robot.options, correct_jumps=True, world_frame="map", pose=("/slam=odom",), out="")
    mapping = Mapping(load_config(voxel_size=0.1, **STANDS, **{"map.keep_frames": True, "trust.max_disagreement": 1}))
    robot.mapping.close()
    robot.maker = MapNode(other, mapping, options, str, robot.reports.append)
    robot.send["/slam"] = robot.other.create_publisher(PoseStamped, "/slam", 20)
    made = wire.messages()
    robot.until(lambda: robot.send["/slam"].get_subscription_count())
    for k in range(7):
        stamp_ns = depth_at(k).stamp_ns
        place = made._pose(shifted(0, 0.6 if k > 3 else 0.0, 0))
        told = wire.made("geometry_msgs/msg/PoseStamped", header=wire.header(stamp_ns, "map"), pose=place)
        robot.publish("/slam", told)
    robot.drive(7)
    robot.until(lambda: robot.maker.counts()["corrections"] == 1)
    sideways = [
        kept.T_world_sensor[1, 3] - depth_at(k).T_world_sensor[1, 3]
        for k, kept in enumerate(mapping.mapper.map.kept_frames.frames)
    ]
    np.testing.assert_allclose(sideways, [0, 0.2, 0.4, 0.6, 0.6, 0.6, 0.6], atol=0.01)
    robot.maker.close()
    other.destroy_node()


def latched(robot, kind, topic):
    """Return the message that a new subscriber gets."""
    robot.listen(kind, topic)
    robot.until(lambda: robot.came[topic])
    return robot.came[topic][0]


def test_save_reset_and_load(robot, tmp_path):
    robot.drive(3)
    before = robot.mapping.snapshot()().storage.blocks()
    saved = robot.call(Trigger, "/stereovox/save")
    assert (saved.success, "3 frames" in saved.message) == (True, True)
    assert max(latched(robot, OccupancyGrid, "/map_mapping").data) > 50
    assert len(latched(robot, PointCloud2, "/occupied_cells").data)
    assert robot.call(Trigger, "/stereovox/reset").success
    assert list(latched(robot, OccupancyGrid, "/map_mapping").data) == [-1]
    assert len(latched(robot, PointCloud2, "/occupied_cells").data) == 0
    assert robot.mapping.history.frames == 0
    assert len(robot.mapping.snapshot()().occupied()) == 0
    missing = robot.call(LoadMap, "/stereovox/load", LoadMap.Request(map_url=str(tmp_path / "nothing")))
    assert missing.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
    no_name = robot.call(LoadMap, "/stereovox/load", LoadMap.Request(map_url="x" * 5000))
    assert no_name.result == LoadMap.Response.RESULT_MAP_DOES_NOT_EXIST
    loaded = robot.call(LoadMap, "/stereovox/load", LoadMap.Request(map_url=f"file://{tmp_path / 'live.svox'}"))
    assert loaded.result == LoadMap.Response.RESULT_SUCCESS
    assert loaded.map.data == latched(robot, OccupancyGrid, "/map_mapping").data
    assert max(loaded.map.data) > 50
    assert (loaded.map.info.resolution, loaded.map.header.frame_id) == (pytest.approx(0.1), "odom")
    for mine, theirs in zip(robot.mapping.snapshot()().storage.blocks(), before, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert load_map(tmp_path / "live.svox").frames == 3
    (tmp_path / "other").mkdir()
    (tmp_path / "other/file").touch()
    robot.node.set_parameters([rclpy.Parameter("ros.out", value=str(tmp_path / "other"))])
    refused = robot.call(Trigger, "/stereovox/save")
    assert (refused.success, "not a stereovox map" in refused.message) == (False, True)
    assert not robot.node.set_parameters([rclpy.Parameter("voxel_size", value=0.2)])[0].successful


def test_without_poses_the_camera_is_tracked_and_what_is_lost_is_told(robot):
    source = Simulation("sim:room?camera=kinect&image_width=160")
    frames = [source.frame(i) for i in range(0, 10, 2)]
    other = rclpy.create_node("tracked")
    options = Options(depth=(DEPTH,), fixed=(MOUNT,), poses="track", late_s=60.0)
    mapping, reports = Mapping(load_config(voxel_size=0.1, **STANDS)), []
    first, robot.maker = robot.maker, MapNode(other, mapping, options, str, reports.append)
    maker = robot.maker
    robot.listen(Odometry, "/tracked_odometry", 10)
    robot.listen(DiagnosticArray, "/diagnostics", 10)
    robot.until(lambda: robot.send[DEPTH].get_subscription_count() == 2)
    robot.until(lambda: robot.other.count_publishers("/tracked_odometry"))
    made = wire.messages()
    for frame in [*frames, replace(frames[-1], depth=0 * frames[-1].depth, stamp_ns=frames[-1].stamp_ns + 10**8)]:
        stamp_ns = START_NS + frame.stamp_ns
        robot.publish("/camera/depth/camera_info", made.camera_info(frame.camera, stamp_ns, OPTICAL))
        robot.publish(DEPTH, made.image(frame.depth, stamp_ns, OPTICAL))
    robot.until(lambda: len(reports) == 6 and len(robot.came["/tracked_odometry"]) == 4)
    assert [report.refused for report in reports] == ["tracking_lost", None, None, None, None, "tracking_lost"]
    last = robot.came["/tracked_odometry"][-1]
    assert (last.header.frame_id, last.child_frame_id) == ("odom", "base_link")
    numbers = fixed_transform(MOUNT)[2]
    T_base_camera = from_quaternion(numbers[:3], numbers[3:])
    travelled = inverse(frames[0].T_world_sensor) @ frames[-1].T_world_sensor
    place = last.pose.pose.position
    expected = (T_base_camera @ travelled @ inverse(T_base_camera))[:3, 3]
    np.testing.assert_allclose([place.x, place.y, place.z], expected, atol=0.03)
    assert 0 < np.reshape(last.pose.covariance, (6, 6)).diagonal().max() < 1e-2
    counts = maker.counts()
    assert (counts["frames_tracked"], counts["frames_lost"], counts["tracking"][:5]) == (4, 2, "lost:")
    robot.came["/diagnostics"].clear()
    robot.until(lambda: [one for one in robot.came["/diagnostics"] if "tracked" in one.status[0].name])
    status = next(one.status[0] for one in robot.came["/diagnostics"] if "tracked" in one.status[0].name)
    assert {pair.key: pair.value for pair in status.values}["frames_lost"] == "2"
    older = robot.call(LoadMap, "/tracked/load", LoadMap.Request(map_url="/"))
    assert older.result == LoadMap.Response.RESULT_INVALID_MAP_DATA
    maker.close()
    robot.maker = first
    other.destroy_node()


def test_several_cameras_make_one_map(robot):
    """Each with its own topics, camera and mount: one faces ahead, one back, and no frames are mixed up."""
    back, info, optical = "/back/depth/image_raw", "/back/depth/camera_info", "back_optical_frame"
    turned = np.diag([-1.0, -1, 1, 1])
    other, camera = rclpy.create_node("two_cameras"), replace(CAMERA, fx=30.0, fy=30.0)
    mount = f"base_link {optical} -0.1 0 0.4 1.5707963 0 -1.5707963"
    options = replace(robot.options, depth=(DEPTH, back), fixed=(*robot.options.fixed, mount), out="")
    robot.mapping.close()
    robot.mapping = Mapping(load_config(voxel_size=0.1, **STANDS))
    robot.maker = MapNode(other, robot.mapping, options, str, robot.reports.append)
    robot.send |= {back: robot.other.create_publisher(Image, back, 20)}
    robot.send |= {info: robot.other.create_publisher(CameraInfo, info, 20)}
    robot.until(lambda: all(one.get_subscription_count() for one in robot.send.values()))
    made, behind = wire.messages(), np.full((CAMERA.height, CAMERA.width), 1550, np.uint16)
    for k in range(8):
        stamp_ns = depth_at(k).stamp_ns
        robot.publish(info, made.camera_info(camera, stamp_ns, optical))
        robot.publish(back, made.image(behind, stamp_ns, optical))
    robot.drive(8)
    robot.until(lambda: len(robot.reports) == 16)
    assert [report.refused for report in robot.reports] == [None] * 16
    new = Mapping(load_config(voxel_size=0.1, **STANDS))
    for k in range(8):
        ahead = depth_at(k)
        T = base_at(ahead.stamp_ns) @ turned @ T_BASE_CAMERA
        assert new.add(replace(ahead, sensor=DEPTH)).refused is None
        seen = replace(ahead, depth=behind, camera=camera, T_world_sensor=T, sensor=back)
        assert new.add(seen).refused is None
    mine, theirs = robot.mapping.snapshot()(), new.snapshot()()
    centres = theirs.occupied()
    assert centres[:, 0].min() < -1.3  # what is behind
    assert centres[:, 0].max() > 1.25  # the pole ahead
    assert (mine.state(centres) == 3).mean() > 0.98  # mounts are reported in four digits
    robot.maker.close()
    other.destroy_node()
