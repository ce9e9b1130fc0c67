# SPDX-License-Identifier: Apache-2.0
"""Ordinary ROS 1 bags: which topics, which encodings, which poses."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from made_bags import START_NS, Bag, camera_info, depth, header, image, message, pose, ros_bag, stamp, text, transform

from stereovox.errors import SourceError
from stereovox.geometry.se3 import from_quaternion
from stereovox.opening import open_source
from stereovox.sources.bags.recording import Bag as BagSource
from stereovox.sources.poses.trajectory import write_trajectory

TOPIC = "/camera/depth/image_rect_raw"
INFO = "/camera/depth/camera_info"


def test_depth_in_millimetres_with_the_rectified_camera(tmp_path):
    source = open_source(ros_bag(tmp_path / "a.bag", 3))
    assert len(source) == 3
    camera = source.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline) == (11, 12, 3.6, 2.6, None)  # P, not K
    for k in (2, 1, 0):
        frame = source.frame(k)
        np.testing.assert_array_equal(frame.depth, depth(k))
        assert (frame.stamp_ns, frame.depth_scale, frame.fault) == (stamp(k), 0.001, "no_pose")


def test_a_raw_topic_has_the_raw_camera_and_distortion_is_told(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add("/depth/image", "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        bag.add("/depth/camera_info", "sensor_msgs/CameraInfo", stamp(0), camera_info(D=(0.1, 0, 0, 0, 0)))
    source = BagSource(bag.path)
    assert source.camera.fx == 10
    assert "distortion" in source.notes[0]


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize("kind", ["u2", "f4"])
def test_byte_order_and_padded_rows(tmp_path, kind, big_endian):
    values = (depth(0) if kind == "u2" else depth(0) * np.float32(0.001)).astype(kind)
    values[1, 1] = 0 if kind == "u2" else np.nan
    stored = values.astype(f"{'>' if big_endian else '<'}{kind}")
    padded = np.concatenate([stored, np.ones((6, 3), stored.dtype)], axis=1).astype(stored.dtype)
    data = np.frombuffer(padded.tobytes(), np.uint8)
    encoding = {"u2": "16UC1", "f4": "32FC1"}[kind]
    with Bag(tmp_path / "a.bag") as bag:
        other = {"step": padded.strides[0], "data": data, "is_bigendian": int(big_endian)}
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(values, encoding, stamp(0), **other))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
    frame = BagSource(f"{bag.path}?pose=fixed").frame(0)
    assert frame.depth.dtype == np.dtype(kind)
    np.testing.assert_array_equal(frame.depth, values)
    assert frame.depth_scale == (0.001 if kind == "u2" else 1.0)


def compressed(pixels: np.ndarray, form: str = "16UC1; compressedDepth png"):
    _, png = cv2.imencode(".png", pixels)
    data = np.concatenate([np.zeros(12, np.uint8), png])
    return message("sensor_msgs/CompressedImage", header=header(stamp(0)), format=form, data=data)


def test_compressed_depth(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add(f"{TOPIC}/compressedDepth", "sensor_msgs/CompressedImage", stamp(0), compressed(depth(3)))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
        bag.add("/camera/color/image/compressed", "sensor_msgs/CompressedImage", stamp(0), compressed(depth(3), "jpeg"))
    frame = BagSource(bag.path).frame(0)
    np.testing.assert_array_equal(frame.depth, depth(3))
    assert frame.stamp_ns == stamp(0)


def test_the_plain_topic_comes_before_the_compressed_one(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add(f"{TOPIC}/compressedDepth", "sensor_msgs/CompressedImage", stamp(0), compressed(depth(3)))
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(depth(1), "16UC1", stamp(0)))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
    np.testing.assert_array_equal(BagSource(bag.path).frame(0).depth, depth(1))


NUMBERS = (1.0, -2.0, 3.0, 0.1, -0.2, 0.3, 0.9)


def posed(kind: str, stamp_ns: int, numbers=NUMBERS, child: str = "/optical"):
    name = kind.rpartition("/")[2]
    head = header(stamp_ns, "map")
    if name == "PoseStamped":
        return message(kind, header=head, pose=pose(numbers))
    if name == "TransformStamped":
        return message(kind, header=head, child_frame_id=child, transform=transform(numbers))
    nothing = np.zeros(36)
    covered = message("geometry_msgs/PoseWithCovariance", pose=pose(numbers), covariance=nothing)
    if name == "PoseWithCovarianceStamped":
        return message(kind, header=head, pose=covered)
    zero = message("geometry_msgs/Vector3", x=0.0, y=0.0, z=0.0)
    twist = message("geometry_msgs/Twist", linear=zero, angular=zero)
    moving = message("geometry_msgs/TwistWithCovariance", twist=twist, covariance=nothing)
    return message(kind, header=head, child_frame_id=child, pose=covered, twist=moving)


@pytest.mark.parametrize(
    "kind",
    [
        "geometry_msgs/PoseStamped",
        "geometry_msgs/PoseWithCovarianceStamped",
        "geometry_msgs/TransformStamped",
        "nav_msgs/Odometry",
    ],
)
def test_poses_are_interpolated_at_the_image(tmp_path, kind):
    other = (3.0, 0.0, 3.0, 0.1, -0.2, 0.3, 0.9)
    with Bag(tmp_path / "a.bag") as bag:
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0), "/optical"))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
        bag.add("/pose", kind, stamp(0), posed(kind, stamp(0) - 10_000_000))
        bag.add("/pose", kind, stamp(0), posed(kind, stamp(0) + 30_000_000, other))
    source = BagSource(bag.path)
    T = source.frame(0).T_world_sensor
    np.testing.assert_allclose(T, from_quaternion([1.5, -1.5, 3.0], NUMBERS[3:]), atol=1e-9)
    named = kind in ("geometry_msgs/TransformStamped", "nav_msgs/Odometry")  # these say whose pose it is
    assert bool(source.notes) is not named


def test_another_body_is_refused_and_its_axes_can_be_told(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0), "/optical"))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
        odometry = posed("nav_msgs/Odometry", stamp(0), (1, 2, 3, 0, 0, 0, 1), child="base_link")
        bag.add("/odom", "nav_msgs/Odometry", stamp(0), odometry)
    assert BagSource(bag.path).frame(0).fault == "no_pose"
    source = BagSource(f"{bag.path}?axes=ros")
    assert source.notes == ()
    T = source.frame(0).T_world_sensor
    np.testing.assert_allclose(T[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(T[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # forward is the body's x
    np.testing.assert_allclose(T[:3, :3] @ [1, 0, 0], [0, -1, 0], atol=1e-12)  # right is minus y


def test_poses_come_from_a_file_too(tmp_path):
    path = ros_bag(tmp_path / "a.bag", 3)
    T = np.array([from_quaternion([k, 2.0 * k, 0], NUMBERS[3:]) for k in range(3)])
    write_trajectory(tmp_path / "slam.tum", [stamp(k) for k in range(3)], T, "camera")
    np.savetxt(tmp_path / "kitti.txt", T[:, :3].reshape(3, 12))
    for name in ("slam.tum", "kitti.txt", str(tmp_path / "slam.tum")):
        source = BagSource(f"{path}?poses={name}")
        for k, frame in enumerate(source):
            np.testing.assert_allclose(frame.T_world_sensor, T[k], atol=1e-6)
    with pytest.raises(SourceError, match="no topic nowhere"):
        BagSource(f"{path}?poses=nowhere.txt")


def test_several_pose_topics_need_a_choice_but_depth_comes_all_the_same(tmp_path):
    kind = "geometry_msgs/PoseStamped"
    with Bag(tmp_path / "a.bag") as bag:
        bag.add(TOPIC, "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
        bag.add("/a", kind, stamp(0), posed(kind, stamp(0)))
        bag.add("/b", kind, stamp(0), posed(kind, stamp(0), (7, 8, 9, 0, 0, 0, 1)))
    frame = BagSource(bag.path).frame(0)
    assert frame.fault == "no_pose"
    assert "?poses=/a or ?poses=/b" in frame.fault_detail
    assert frame.depth.shape == (6, 8)
    np.testing.assert_allclose(BagSource(f"{bag.path}?poses=/b").frame(0).T_world_sensor[:3, 3], [7, 8, 9])


def test_options_win(tmp_path):
    path = ros_bag(tmp_path / "a.bag", 1)
    source = BagSource(f"{path}?depth={TOPIC}&info={INFO}&pose=fixed&scale=0.0002&baseline=0.055")
    frame = source.frame(0)
    assert (frame.depth_scale, frame.camera.baseline, frame.fault) == (0.0002, 0.055, None)


def test_a_question_mark_in_the_name_is_part_of_it(tmp_path):
    assert len(BagSource(ros_bag(tmp_path / "what?.bag", 2))) == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("depth=/camera/depth/image_rect", "no topic /camera/depth/image_rect .*did you mean '/camera/depth/image_re"),
        ("depth=/chatter", "/chatter holds std_msgs/String, not images"),
        ("poses=/chatter", "/chatter holds std_msgs/String, not poses"),
        ("poses=/nowhere", "no topic /nowhere"),
        ("info=/chatter", "/chatter: 'width' is missing; name a topic"),
        ("pose=fixed&poses=/odom", "pose=fixed and poses=/odom contradict each other"),
        ("pose=fixed&axes=ros", "pose=fixed and axes=ros contradict each other"),
        ("axes=ross", "axes=ross must be"),
        ("pose=moving", "pose=moving must be fixed"),
        ("scale=-1", "scale=-1 must be a positive number"),
        ("colour=/x", "unknown parameter 'colour'"),
        ("depth", "write key=value"),
    ],
)
def test_wrong_options_end_in_one_line(tmp_path, options, said):
    path = ros_bag(tmp_path / "a.bag", 1)
    with pytest.raises(SourceError, match=said) as caught:
        BagSource(f"{path}?{options}")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_direct_is_not_rectified(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add("/direct/image", "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        bag.add("/direct/camera_info", "sensor_msgs/CameraInfo", stamp(0), camera_info())
    assert BagSource(bag.path).camera.fx == 10.0


def test_without_camera_info_the_cure_is_named(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add("/depth/image", "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        bag.add("/elsewhere/camera_info", "sensor_msgs/CameraInfo", stamp(0), camera_info())
    with pytest.raises(SourceError, match=r"no /depth/camera_info .*\?info=/topic \(there are: /elsewhere/camera_inf"):
        BagSource(bag.path)
    assert len(BagSource(f"{bag.path}?info=/elsewhere/camera_info")) == 1


@pytest.mark.parametrize(("focal", "size"), [(0.006, (1, 1)), (1e300, (8, 6)), (10.0, (2**31, 2**31))])
def test_a_camera_that_cannot_be_is_one_line(tmp_path, focal, size):
    told = camera_info(*size)
    told.K[[0, 4]] = focal
    with Bag(tmp_path / "a.bag") as bag:
        bag.add("/depth/image", "sensor_msgs/Image", stamp(0), image(depth(0), "16UC1", stamp(0)))
        bag.add("/depth/camera_info", "sensor_msgs/CameraInfo", stamp(0), told)
    with pytest.raises(SourceError, match=r"a\.bag: /depth/camera_info: ") as refused:
        BagSource(bag.path)
    assert "\n" not in str(refused.value)


def test_a_bag_without_depth_tells_what_it_holds(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add("/chatter", "std_msgs/String", START_NS, text("hello"))
        bag.add("/infra", "sensor_msgs/Image", START_NS, image(depth(0), "mono16", stamp(0)))
    with pytest.raises(SourceError, match=r"no depth images .*/chatter \(std_msgs/String\)"):
        BagSource(bag.path)


def test_the_camera_of_a_cut_and_binned_image(tmp_path):
    """K is of the whole sensor (CameraInfo.msg): the image begins at the offset, and a pixel is made of 2 x 3."""
    info = camera_info(64, 48, P=False)
    info.binning_x, info.binning_y = 2, 3
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 10, 6, 16, 18
    with Bag(tmp_path / "a.bag") as bag:
        small = np.full((6, 8), 1500, np.uint16)
        bag.add("/depth/image", "sensor_msgs/Image", stamp(0), image(small, "16UC1", stamp(0)))
        bag.add("/depth/camera_info", "sensor_msgs/CameraInfo", stamp(0), info)
    camera = BagSource(bag.path).camera
    assert (camera.width, camera.height) == (8, 6)
    columns = [[10 + 2 * k, 11 + 2 * k] for k in range(8)]  # sensor columns of each pixel: its ray is their middle
    rays = (np.mean(columns, axis=1) - 3.5) / 10.0
    np.testing.assert_allclose((np.arange(8) - camera.cx) / camera.fx, rays)
    rows = [[6 + 3 * k, 7 + 3 * k, 8 + 3 * k] for k in range(6)]
    np.testing.assert_allclose((np.arange(6) - camera.cy) / camera.fy, (np.mean(rows, axis=1) - 2.5) / 10.5)


def test_grey_images_of_16_bits_may_be_depth(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        bag.add("/depth/image", "sensor_msgs/Image", stamp(0), image(depth(0), "mono16", stamp(0)))
        bag.add("/depth/camera_info", "sensor_msgs/CameraInfo", stamp(0), camera_info())
    with pytest.raises(SourceError, match=r"if mono16 is depth here: \?depth=/depth/image"):
        open_source(bag.path)
    np.testing.assert_array_equal(open_source(f"{bag.path}?depth=/depth/image").frame(0).depth, depth(0))
