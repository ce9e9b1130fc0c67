# SPDX-License-Identifier: Apache-2.0
"""Clouds are checked as depth images are, straightened where the sensor moved, and enter the map like these."""

from dataclasses import replace

import numpy as np
import pytest
from made_clouds import HALF, directions_of, pose, room_cloud, room_points

import stereovox as sv
from stereovox.depth.cloud import checked_cloud, deskewed
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.geometry.se3 import inverse

CONFIG = sv.load_config()


def test_a_room_is_mapped_from_clouds():
    mapper = sv.Mapper(voxel_size=0.1)
    for n in range(10):
        report = mapper.add(room_cloud(n, 20_000))
        assert report.refused is None
        assert report.cells
    voxel_map = mapper.map
    assert list(voxel_map.history.trusted) == ["lidar"]
    walls = room_points(np.eye(4), directions_of(99, 2000))
    states = voxel_map.state(walls)
    assert np.mean(states == sv.State.OCCUPIED) > 0.95
    inside = np.random.default_rng(1).uniform(-0.9, 0.9, (2000, 3)) * HALF
    assert np.mean(voxel_map.state(inside) == sv.State.FREE) > 0.95
    assert (voxel_map.state(inside) != sv.State.OCCUPIED).all()
    assert (voxel_map.state(walls * 1.2) == sv.State.UNKNOWN).all()


def test_a_camera_and_a_lidar_make_one_map_each_with_its_own_noise():
    frames = list(sv.open_source("sim:box?image_width=96&frames=4"))
    mapper = sv.Mapper(voxel_size=0.1)
    for frame in frames:
        assert mapper.add(frame).refused is None
        cloud = sv.Cloud(np.array([[1.0, 0, 0], [0, 1.0, 0]]), frame.T_world_sensor, frame.stamp_ns)
        assert mapper.add(cloud).refused is None
    assert set(mapper.map.history.trusted) == {"camera", "lidar"}
    alone = sv.Mapper(voxel_size=0.1, **{"noise.s2": 0.5})  # how badly a camera measures is nothing to a lidar
    other = sv.Mapper(voxel_size=0.1)
    for each in (alone, other):
        each.add(room_cloud(0))
    np.testing.assert_array_equal(alone.map.cells()[1], other.map.cells()[1])
    noisy = sv.Mapper(voxel_size=0.1)
    noisy.add(room_cloud(0, lidar=sv.Lidar(0.3)))
    assert noisy.map.cells()[1].max() < other.map.cells()[1].max()


def test_points_without_value_and_near_ones_clear_nothing():
    points = np.array([[np.nan, 0, 0], [np.inf, 0, 0], [0, 0, 0], [0.2, 0, 0], [2, 0, 0]], np.float32)
    cloud = checked_cloud(sv.Cloud(points, np.eye(4)), CONFIG)
    np.testing.assert_array_equal(cloud.ends, [[2, 0, 0]])
    assert cloud.hits.all()


def test_rays_end_where_the_lidar_measures_no_further():
    lidar = sv.Lidar(range_max=10.0)
    cloud = checked_cloud(sv.Cloud(np.array([[20.0, 0, 0], [0, 5.0, 0]]), np.eye(4), lidar=lidar), CONFIG)
    np.testing.assert_allclose(cloud.ends, [[10, 0, 0], [0, 5, 0]])
    assert cloud.hits.tolist() == [False, True]


def test_a_surface_at_the_end_of_the_range_is_not_freed():
    """A wall at 2.99 m, of a lidar that measures up to 3 m, is now and then measured beyond."""
    mapper = sv.Mapper(voxel_size=0.05)
    for k in range(10):
        points = np.array([[3.01, 0.03, 0.03], [2.0, 0.1 * k, 1.0]])
        mapper.add(sv.Cloud(points, np.eye(4), 10**8 * k, sv.Lidar(range_max=3.0)))
    states = mapper.map.state([[2.88, 0.03, 0.03], [2.99, 0.03, 0.03]])
    assert states.tolist() == [sv.State.FREE, sv.State.UNKNOWN]


def test_rays_without_echo_are_free_only_where_that_is_said():
    cloud = sv.Cloud(np.array([[2.0, 0, 0]]), np.eye(4), clear=np.array([[0, 3.0, 0], [np.nan, 0, 0]]))
    checked = checked_cloud(cloud, CONFIG)
    np.testing.assert_array_equal(checked.ends, [[2, 0, 0], [0, 3, 0]])
    assert checked.hits.tolist() == [True, False]
    mapper = sv.Mapper(voxel_size=0.2)
    for k in range(5):
        mapper.add(replace(cloud, stamp_ns=10**8 * k))
    assert mapper.map.state([[0, 2.5, 0]])[0] == sv.State.FREE
    assert mapper.map.state([[0, 3.5, 0], [0, -2.5, 0]]).tolist() == [sv.State.UNKNOWN] * 2


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"points": np.zeros((4, 2))}, "bad_shape"),
        ({"points": np.zeros((4, 3), int)}, "bad_dtype"),
        ({"points": [[1.0, 2.0, 3.0]]}, "bad_form"),
        ({"points": np.full((4, 3), np.nan)}, "no_valid_point"),
        ({"points": np.empty((0, 3))}, "no_valid_point"),
        ({"points": np.ma.masked_array(np.ones((4, 3)), True)}, "bad_form"),
        ({"origins": np.zeros((3, 3))}, "bad_shape"),
        ({"lidar": None}, "bad_form"),
        ({"T_world_sensor": np.full((4, 4), np.nan)}, "pose_not_finite"),
        ({"T_world_sensor": None}, "no_pose"),
        ({"T_world_sensor": 2 * np.eye(4)}, "pose_not_rigid"),
        ({"stamp_ns": 0.5}, "bad_stamp"),
        ({"fault": "unreadable"}, "unreadable"),
        ({"pose_sigma": (-1, 0)}, "bad_form"),
    ],
)
def test_what_is_no_cloud_is_refused_and_counted(change, reason):
    mapper = sv.Mapper(voxel_size=0.5)
    cloud = replace(sv.Cloud(np.ones((4, 3)), np.eye(4)), **change)
    assert mapper.add(cloud).refused == reason
    assert mapper.map.history.refused == {reason: 1}
    assert not mapper.map.frames


def test_too_many_points_are_refused(monkeypatch):
    monkeypatch.setattr("stereovox.depth.cloud.MAX_POINTS", 3)
    assert sv.Mapper().add(sv.Cloud(np.ones((4, 3)), np.eye(4))).refused == "too_many_points"


def test_the_same_cloud_from_another_place_is_a_frozen_lidar():
    mapper = sv.Mapper(voxel_size=0.1)
    mapper.add(room_cloud(0))
    frozen = replace(room_cloud(0), T_world_sensor=pose(0.5), stamp_ns=10**9)
    assert mapper.add(frozen).refused == "frozen_image"


def room_cloud_at(n, shift=(0.0, 0.0, 0.0)):
    """Return the n-th cloud of a slow walk, with a pose that is wrong by a shift."""
    T = pose(0.02 * n, 0.01 * n, 0.03 * n)
    points = room_points(T, directions_of(n, 20_000)).astype(np.float32)
    T[:3, 3] += shift
    return sv.Cloud(points, T, 10**8 * n)


def test_a_lidar_whose_pose_is_wrong_is_refused():
    mapper = sv.Mapper(voxel_size=0.1)
    for n in range(12):
        assert mapper.add(room_cloud_at(n)).refused is None
    reports = [mapper.add(room_cloud_at(n, (0.4, 0.3, 0.0))) for n in range(12, 40)]
    assert all(report.refused for report in reports)
    assert mapper.add(room_cloud_at(40)).refused is None


def moving(stamp_ns):
    """Return the pose of a sensor that moves at 5 m/s and turns."""
    seconds = 1e-9 * stamp_ns
    return pose(5 * seconds - 0.5, 1.0 * seconds, 2.0 * seconds)


def swept(stamp_ns, count=2000):
    """Return what a moving lidar delivers: each point as seen at its own time; and these times."""
    times = np.linspace(-0.05, 0.05, count)
    directions = directions_of(3, count)
    seen = zip(times, directions, strict=True)
    points = [room_points(moving(stamp_ns + round(1e9 * t)), way[None])[0] for t, way in seen]
    return sv.Cloud(np.array(points), moving(stamp_ns), stamp_ns), times


def wall_error(cloud):
    """Return how far points lie from the room's walls in metres, 95 %."""
    T = cloud.T_world_sensor
    points = np.asarray(cloud.points) @ T[:3, :3].T + T[:3, 3]
    return np.quantile(np.abs(np.abs(points / HALF).max(axis=1) - 1) * HALF.min(), 0.95)


def test_a_cloud_of_a_moving_sensor_is_straightened():
    cloud, times = swept(10**8)
    straight = deskewed(cloud, times, moving)
    assert wall_error(cloud) > 0.1
    assert wall_error(straight) < 0.01
    began = inverse(cloud.T_world_sensor) @ moving(cloud.stamp_ns - 50_000_000)
    np.testing.assert_allclose(straight.origins[0], began[:3, 3], atol=1e-6)
    lengths = np.linalg.norm(np.asarray(straight.points) - straight.origins, axis=1)
    np.testing.assert_allclose(lengths, np.linalg.norm(cloud.points, axis=1), atol=1e-9)


def test_one_point_with_a_wrong_time_spoils_no_other():
    cloud, times = swept(10**8)
    late = deskewed(cloud, np.append(times[:-1], 5.0), moving)
    assert wall_error(late) < 0.01
    with pytest.raises(FrameRefused, match="unit of its times"):
        deskewed(cloud, np.append(times[:-1], 100.0), moving)


def test_a_sensor_at_rest_changes_nothing():
    cloud = room_cloud(2, 100)
    straight = deskewed(cloud, np.zeros(100), lambda stamp_ns: cloud.T_world_sensor)
    np.testing.assert_allclose(straight.points, cloud.points, atol=1e-6)
    np.testing.assert_allclose(straight.origins, 0, atol=1e-9)


def test_points_without_a_time_are_left_out():
    cloud, times = swept(10**8, 10)
    times[3] = np.nan
    straight = deskewed(cloud, times, moving)
    assert np.flatnonzero(~np.isfinite(np.asarray(straight.points)).all(axis=1)).tolist() == [3]
    assert not np.isfinite(np.asarray(deskewed(cloud, np.full(10, np.nan), moving).points)).any()


def test_times_must_be_one_for_each_point_and_poses_known():
    cloud, times = swept(10**8, 10)
    with pytest.raises(FrameRefused, match="times for 10 points"):
        deskewed(cloud, times[:9], moving)

    def unknown(stamp_ns):
        raise FrameRefused("no_pose", "nobody knows")

    with pytest.raises(FrameRefused, match="nobody knows"):
        deskewed(cloud, times, unknown)
    with pytest.raises(FrameRefused, match="unit of its times"):
        deskewed(cloud, np.append(times[:-1], 1e305), moving)


@pytest.mark.parametrize("numbers", [{"sigma": 0}, {"range_min": -1}, {"range_min": 5, "range_max": 4}])
def test_a_lidar_has_sensible_numbers(numbers):
    with pytest.raises(StereovoxError, match="lidar: "):
        sv.Lidar(**numbers)
