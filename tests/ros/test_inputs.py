# SPDX-License-Identifier: Apache-2.0
"""Messages become frames; whatever else they hold, they become a counted refusal and change nothing."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import wire

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.mapper import GridMapper, Mapper
from stereovox.ros.inputs import CloudInput, DepthInput, FloorCloudInput, RangeInput, RaysInput, ScanInput
from stereovox.ros.poses.poses import Pose
from stereovox.sources.bags.writer_messages import packed_png
from stereovox.sources.clouds.options import LidarOptions

CAMERA = PinholeCamera(8, 6, 10.0, 10.5, 3.5, 2.5)
DEPTH = np.arange(48, dtype=np.uint16).reshape(6, 8) + 1000
T = np.eye(4)
T[:3, 3] = 1, 2, 3


def there(frame_id: str, stamp_ns: int) -> Pose:
    return Pose(T, np.eye(4), 7)


def nowhere(frame_id: str, stamp_ns: int) -> Pose:
    raise FrameRefused("no_pose", "nobody knows")


def info(**changes) -> bytes:
    message = wire.messages().camera_info(CAMERA, 1, "eye")
    for name, value in changes.items():
        setattr(message, name, value)
    return wire.packed(message)


def depth_input(topic: str = "/cam/depth/image") -> DepthInput:
    one = DepthInput(topic)
    one.on_camera_info(info())
    return one


def test_a_depth_image_becomes_a_frame():
    one = depth_input()
    frame = one.frame(wire.image(DEPTH, stamp_ns=5_000_000_007), there)
    assert frame.fault is None
    assert (frame.depth == DEPTH).all()
    assert (frame.stamp_ns, frame.depth_scale, frame.pose_off_ns) == (5_000_000_007, 0.001, 7)
    assert (frame.camera, frame.sensor) == (CAMERA, "/cam/depth/image")
    assert (frame.T_world_sensor == T).all()
    assert "5.000000007" in frame.name


def test_floats_and_packed_images_are_read():
    metres = (DEPTH / 1000).astype(np.float32)
    metres[0, :3] = np.nan, np.inf, -np.inf
    frame = depth_input().frame(wire.image(metres), there)
    np.testing.assert_array_equal(frame.depth, metres)
    assert frame.depth_scale == 1.0
    packed = wire.packed(wire.messages().compressed(packed_png(DEPTH), 5, "eye"))
    one = depth_input("/cam/depth/image/compressedDepth")
    assert one.info == "/cam/depth/camera_info"
    assert one.kind == "sensor_msgs/CompressedImage"
    assert (one.frame(packed, there).depth == DEPTH).all()


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"width": 7}, "bad_shape"),
        ({"width": 2**31, "height": 2**31 + 1}, "bad_shape"),
        ({"data": np.zeros(95, np.uint8)}, "unreadable"),
        ({"data": np.zeros(0, np.uint8)}, "unreadable"),
        ({"step": 3}, "unreadable"),
        ({"step": 2**32 - 1}, "unreadable"),
        ({"encoding": "rgb8"}, "bad_dtype"),
        ({"encoding": ""}, "bad_dtype"),
    ],
)
def test_hostile_images_are_refused(changes, why):
    mapper = Mapper("default")
    report = mapper.add(depth_input().frame(wire.image(DEPTH, **changes), there))
    assert report.refused == why
    assert mapper.map.history.refused == {why: 1}
    assert sum(mapper.map.counts().values()) == 0


def test_cut_off_messages_are_refused_at_any_length():
    whole, one, mapper = wire.image(DEPTH), depth_input(), Mapper("default")
    lengths = [*range(0, 80), len(whole) - 1]
    for length in lengths:
        assert mapper.add(one.frame(whole[:length], there)).refused == "unreadable"
    assert mapper.map.history.refused["unreadable"] == len(lengths)


def test_an_image_of_another_camera_on_the_topic_is_refused():
    """The camera, and its pose, are those of the first one's frame."""
    one = depth_input()
    assert one.frame(wire.image(DEPTH, 5, "eye"), there).fault is None
    other = one.frame(wire.image(DEPTH, 6, "other_eye"), there)
    assert other.fault == "no_camera"
    assert "'other_eye'" in other.fault_detail
    assert one.frame(wire.image(DEPTH, 7, "/eye"), there).fault is None


def test_without_camera_or_pose_nothing_is_mapped():
    report = Mapper("default").add(DepthInput("/d/image").frame(wire.image(DEPTH), there))
    assert report.refused == "no_camera"
    assert "/d/camera_info" in report.detail
    assert Mapper("default").add(depth_input().frame(wire.image(DEPTH), nowhere)).refused == "no_pose"


def test_camera_info_that_cannot_be_is_told_and_a_good_one_stays():
    one = DepthInput("/d/image")
    wide, huge = (np.array([f, 0, 0, 0, f, 0, 0, 0, 1]) for f in (0.006, 1e300))
    odd = [info(k=k, width=1, height=1) for k in (np.zeros(9), np.full(9, np.nan), wide, huge)]
    for bad in (*odd, info(width=0), info(width=2**31, height=2**31), b""):
        one.on_camera_info(bad)
        assert not one.ready
    assert "camera" in one.frame(wire.image(DEPTH), there).fault_detail
    one.on_camera_info(info())
    one.on_camera_info(info(k=np.zeros(9)))
    assert one.ready


def test_rectified_images_have_the_camera_of_p():
    one = DepthInput("/d/image_rect", "/other/info")
    p = np.array([20.0, 0, 3, 0, 0, 21.0, 2, 0, 0, 0, 1, 0])
    one.on_camera_info(info(p=p))
    camera = one.frame(wire.image(DEPTH), there).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (20, 21, 3, 2)
    assert one.info == "/other/info"


def test_a_cloud_marks_its_points_and_clears_up_to_them():
    beside = np.radians(np.arange(-3, 4))
    y, z = 2 * np.tan(np.stack(np.meshgrid(beside, beside), axis=-1).reshape(-1, 2).T)
    points = np.vstack([np.stack([np.full(49, 2.0), y, z], axis=1), [np.nan, 0, 0], [0, 3.0, 0.5]])
    mapper, one = Mapper("default", voxel_size=0.1), CloudInput("/points", Lidar())
    for stamp in (1, 2):
        cloud = one.frame(wire.cloud(points, stamp), lambda *_: Pose(np.eye(4), np.eye(4), 3))
        assert (cloud.sensor, cloud.stamp_ns, cloud.pose_off_ns) == ("/points", stamp, 3)
        assert mapper.add(cloud).refused is None
    occupied = {tuple(np.floor(p / 0.1).astype(int)) for p in mapper.map.occupied()}
    assert any(abs(x - 20) <= 1 and abs(y) <= 1 and abs(z) <= 1 for x, y, z in occupied)
    assert any(abs(x) <= 1 and abs(y - 30) <= 1 and abs(z - 5) <= 1 for x, y, z in occupied)
    assert all(np.nanmin(np.linalg.norm(p - points, axis=1)) < 0.3 for p in mapper.map.occupied())
    assert mapper.map.state([[1.0, 0.0, 0.0], [0.0, 1.0, 0.17]]).tolist() == [1, 1]
    assert mapper.map.state([[-1.0, 0.0, 0.0], [2.6, 0.0, 0.0]]).tolist() == [0, 0]  # no point tells of them


def test_a_cloud_with_times_is_straightened_by_the_poses_of_its_sweep():
    """The sensor drives along x at 10 m/s towards a wall at 5 m, and measures it all the while."""
    times = np.linspace(0, 0.125, 50)
    points = np.column_stack([5 - 10 * times, np.linspace(-1, 1, 50), np.zeros(50), times])

    def driving(frame_id, stamp_ns):
        place = np.eye(4)
        place[0, 3] = stamp_ns / 1e8
        return Pose(place, np.eye(4), 0)

    one = CloudInput("/points", Lidar())
    asked = []
    poses = SimpleNamespace(is_final=lambda frame_id, stamp_ns: asked.append(stamp_ns))
    one.is_final(poses, "lidar", 0)
    cloud = one.frame(wire.cloud(points, 0, names="xyzt"), driving)
    np.testing.assert_allclose(cloud.points[:, 0], 5, atol=0.02)
    np.testing.assert_allclose(cloud.origins[:, 0], 10 * times, atol=0.02)
    one.is_final(poses, "lidar", 7)
    assert asked == [0, 7 + 125_000_000]  # the next cloud waits for the poses of a sweep as long

    def unknown_later(frame_id, stamp_ns):
        if stamp_ns > 50_000_000:
            raise FrameRefused("no_pose", "not yet")
        return driving(frame_id, stamp_ns)

    assert one.frame(wire.cloud(points, 0, names="xyzt"), unknown_later).fault == "no_pose"


def test_a_scan_enters_a_3d_map_as_rays():
    told = wire.messages().scan(Scan(np.array([2.0, np.inf, np.nan], np.float32), -0.5, 0.5, 0.1, 5.0, T), "laser")
    mapper, one = Mapper("default", voxel_size=0.2), RaysInput("/scan", LidarOptions(0.01))
    for _ in range(2):
        cloud = one.frame(wire.packed(told), there)
        assert (len(cloud.points), len(cloud.clear), cloud.lidar.sigma, cloud.lidar.range_max) == (1, 1, 0.01, 5.0)
        assert mapper.add(cloud).refused in (None, "repeated_stamp")
    ahead = T[:3, 3] + [[4.0, 0, 0], [1.2 * np.cos(-0.5), 1.2 * np.sin(-0.5), 0]]
    assert mapper.map.state(ahead).tolist() == [1, 1]
    assert RaysInput("/scan", LidarOptions()).frame(b"\0\1\0\0", there).fault == "unreadable"


def range_message(distance: float, stamp_ns: int = 5, **other) -> bytes:
    fields = {"radiation_type": 0, "field_of_view": 0.3, "min_range": 0.2, "max_range": 4.0, "variance": 0.0025} | other
    head = wire.header(stamp_ns, "sonar")
    return wire.packed(wire.made("sensor_msgs/msg/Range", header=head, range=distance, **fields))


@pytest.mark.parametrize("mapper", [Mapper("default", voxel_size=0.2), GridMapper("ist2019")], ids=["space", "floor"])
def test_a_range_enters_maps_as_a_cone(mapper):
    one = RangeInput("/sonar")
    for k in range(6):
        seen = one.frame(range_message(2.1, 10**9 + k * 10**8), lambda name, _, k=k: Pose(moved(k), np.eye(4), 7))
        assert (seen.distance, seen.beam.beam) == (pytest.approx(2.1), pytest.approx(0.3))
        assert (seen.sensor, seen.pose_off_ns) == ("/sonar", 7)
        assert seen.beam.sigma == pytest.approx(0.05)
        assert mapper.add(seen).refused is None
    places = T[:3, 3] + [[1.1, 0.0, 0.1], [2.095, 0.0, 0.01], [3.1, 0.0, 0.1], [0.0, 1.0, 0.1]]
    rules = mapper.map.storage.rules
    numbers = mapper.map.log_odds(places[:, : mapper.config.dimensions])
    free, arc = numbers[:2] - rules.prior_log_odds
    assert free < -0.5
    assert 0 < arc < 0.7
    assert numbers[2:].tolist() == [0, 0]  # unknown
    assert mapper.add(one.frame(range_message(4.0, 2 * 10**9), there)).refused == "no_valid_range"  # silence
    assert mapper.add(RangeInput("/s", silence_clears=True).frame(range_message(4.0, 3 * 10**9), there)).refused is None
    for bad in ({"field_of_view": -1.0}, {"min_range": 5.0}, {"max_range": np.nan}):
        assert mapper.add(one.frame(range_message(1.0, **bad), there)).refused == "unreadable"
    assert one.frame(range_message(1.0)[:30], there).fault == "unreadable"


def moved(k: int) -> np.ndarray:
    place = T.copy()
    place[1, 3] += 0.01 * k
    return place


@pytest.mark.parametrize("make", [lambda: CloudInput("/p", Lidar()), lambda: FloorCloudInput("/p")])
@pytest.mark.parametrize(
    "changes",
    [
        {"names": "abc"},
        {"width": 2**20},
        {"height": 2**16, "width": 2**16},
        {"point_step": 4},
        {"row_step": 2**31, "height": 2},
    ],
)
def test_hostile_clouds_are_refused(make, changes):
    mapper = GridMapper("ist2019") if isinstance(make(), FloorCloudInput) else Mapper("default")
    report = mapper.add(make().frame(wire.cloud(np.ones((4, 3)), **changes), there))
    assert report.refused == "unreadable"


def test_empty_clouds_and_clouds_of_nan_are_refused():
    for points in (np.empty((0, 3)), np.full((5, 3), np.nan)):
        cloud = CloudInput("/p", Lidar()).frame(wire.cloud(points), there)
        assert Mapper("default").add(cloud).refused == "no_valid_point"


def test_a_scan_comes_with_where_it_sits():
    mount = np.eye(4)
    mount[0, 3] = 0.2
    told = wire.messages().scan(Scan(np.full(9, 2.0, np.float32), -1.0, 0.25, 0.1, 5.0, T), "laser")
    scan = ScanInput("/scan").frame(wire.packed(told), lambda *_: Pose(T, mount, 3))
    assert (scan.ranges == 2).all()
    assert (scan.T_base_sensor == mount).all()
    assert (scan.pose_off_ns, scan.sensor) == (3, "/scan")
    assert GridMapper("ist2019").add(scan).refused is None
    told.angle_increment = float("nan")
    assert GridMapper("ist2019").add(ScanInput("/scan").frame(wire.packed(told), there)).refused == "unreadable"


def test_pictures_that_are_no_depth_are_refused():
    png = cv2.imencode(".png", np.zeros((6, 8, 3), np.uint8))[1].ravel()
    data = np.concatenate([np.zeros(12, np.uint8), png])
    packed = wire.packed(wire.messages().compressed(data, 5, "eye"))
    frame = depth_input("/cam/image/compressedDepth").frame(packed, there)
    assert Mapper("default").add(frame).refused in ("bad_dtype", "unreadable")
