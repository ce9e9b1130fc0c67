# SPDX-License-Identifier: Apache-2.0
"""The simulated robot: its drive, its odometry, its lidar and its Kinect."""

from __future__ import annotations

import numpy as np
import pytest
from made_segments import distance_to

from stereovox.config import NoiseConfig
from stereovox.errors import SourceError
from stereovox.frame import Reason
from stereovox.geometry import se2
from stereovox.geometry.se3 import inverse, rigidity_error, transform_points
from stereovox.opening import open_robot
from stereovox.sensors.noise import RangeNoise
from stereovox.simulate.floors.drive import STEP_NS, Kinect, Odometry, Stop, drive, kinect_camera, metres, zigzag
from stereovox.simulate.floors.floor import PLANS, Floor

SMALL = "image_width=80"
DRIVES = ("sim:floor", "sim:floor?shut=1", "sim:floor?plan=testbed")


@pytest.fixture(scope="module")
def short() -> Floor:
    return Floor(f"sim:floor?plan=testbed&seconds=30&{SMALL}")


@pytest.fixture(scope="module")
def full_size() -> Floor:
    return Floor("sim:floor?plan=testbed&seconds=120&depth_hz=0.2")


@pytest.mark.parametrize("where", DRIVES)
def test_the_drive_stays_clear_of_everything_and_comes_everywhere(where):
    floor = Floor(where)
    places = floor.truth.T_world_body[::10, :2, 3]
    assert distance_to(floor.plan.outline(0.0, 0.6), places).min() > 0.3  # a Pioneer is 0.4 m wide
    grid = floor.true_grid(0.1)
    rows, columns = np.nonzero(grid.cells == 0)
    far = np.linalg.norm(grid.centres(rows, columns)[:, None] - places[None, ::5], axis=2).min(1)
    assert far.max() < 5.0
    assert np.median(far) < 1.0


def test_a_drive_is_that_of_two_wheels():
    poses = drive([Stop(0, 0), Stop(2, 0, 90), Stop(2, 2), *zigzag((2, 2), (6, 2), 0.3, 1.0)], 0.5)
    step = se2.relative(poses[:-1], poses[1:])
    seconds = STEP_NS / 1e9
    assert np.abs(step[:, 1]).max() < 1e-4  # never sideways
    assert step[:, 0].max() <= 0.5 * seconds + 1e-9
    assert step[:, 0].min() > -1e-9
    assert np.abs(step[:, 2]).max() < 0.85 * seconds
    assert np.linalg.norm(poses[-1, :2] - [6, 2]) < 0.11
    assert poses[:, 1].max() > 2.15
    assert poses[poses[:, 0] > 2.2, 1].min() < 1.85  # both sides of the straight way


def test_odometry_errs_as_it_says():
    straight = np.column_stack([np.linspace(0, 20, 2001), np.zeros((2001, 2))])
    ends = np.array([Odometry().measured(straight, seed)[-1] for seed in range(300)])
    wrong = Odometry()
    assert metres(Odometry().measured(straight, 1))[-1] == pytest.approx(20 * 1.02, abs=0.2)
    assert ends[:, 2].mean() == pytest.approx(20 * wrong.veer, abs=0.01)
    assert ends[:, 2].std() == pytest.approx(wrong.veer_noise * np.sqrt(20), rel=0.15)
    turning = np.column_stack([np.zeros((629, 2)), se2.wrapped(np.linspace(0, 2 * np.pi, 629))])
    turns = np.array([Odometry().measured(turning, seed)[-1, 2] for seed in range(300)])
    assert turns.mean() == pytest.approx(2 * np.pi * wrong.turn, abs=0.02)
    assert turns.std() == pytest.approx(wrong.turn_noise * np.sqrt(2 * np.pi), rel=0.15)


@pytest.mark.parametrize("where", DRIVES)
def test_the_odometry_drifts_by_metres_and_without_errors_not_at_all(where):
    floor = Floor(where)
    true = se2.relative(floor.start, se2.flattened(floor.truth.T_world_body[-1]))
    end = se2.flattened(floor.odometry.T_world_body[-1])
    assert 0.5 < np.linalg.norm((end - true)[:2]) < 8
    exact = Floor(f"{where}{'&' if '?' in where else '?'}drift=0")
    for stamp in exact.odometry.stamps_ns[::400]:
        T = se2.lifted(exact.start) @ exact.odometry.at(stamp)
        np.testing.assert_allclose(T, exact.truth.at(stamp), atol=1e-9)


def test_the_same_words_give_the_same_recording(short):
    again, other = Floor(short.name), Floor(f"{short.name}&seed=1")
    assert len(short.scans) == len(again.scans) > 290
    assert len(short.frames) == len(again.frames) > 140
    np.testing.assert_array_equal(short.scans[7].ranges, again.scans[7].ranges)
    np.testing.assert_array_equal(short.frames[3].depth, again.frames[3].depth)
    np.testing.assert_array_equal(short.odometry.T_world_body, again.odometry.T_world_body)
    assert not np.array_equal(short.scans[7].ranges, other.scans[7].ranges)
    assert not np.array_equal(short.frames[3].depth, other.frames[3].depth)
    assert not np.array_equal(short.odometry.T_world_body, other.odometry.T_world_body)
    np.testing.assert_array_equal(short.truth.T_world_body, other.truth.T_world_body)


def test_scans_and_frames_come_in_order_and_by_slices(short):
    for stream, hz in ((short.scans, 10), (short.frames, 5)):
        stamps = np.array([one.stamp_ns for one in stream[:20]])
        np.testing.assert_array_equal(np.diff(stamps), 10**9 // hz)
        assert [one.stamp_ns for one in stream[10:4:-2]] == stamps[10:4:-2].tolist()
        assert stream[-1].stamp_ns == stream[len(stream) - 1].stamp_ns
        with pytest.raises(IndexError):
            stream[len(stream)]
    assert short.scans[0].fault is None
    assert all(rigidity_error(one.T_world_sensor) < 1e-9 for one in (short.scans[9], short.frames[9]))


def test_the_lidar_sees_the_plan_within_its_noise(short):
    scan = short.scans[40]
    assert (len(scan.ranges), scan.range_min, scan.range_max) == (683, 0.02, 5.6)
    assert np.degrees(scan.angles[[0, -1]]) == pytest.approx([-120, 120], abs=0.25)
    true = short.true_ranges(scan.stamp_ns)
    T = short.truth.at(scan.stamp_ns) @ scan.T_base_sensor
    rays = np.column_stack([np.cos(scan.angles), np.sin(scan.angles), np.zeros(683)]) @ T[:3, :3].T
    solid = short.plan.scene.cast(T[:3, 3], rays)
    near = solid < 5.6
    assert (np.abs(true - solid)[near] < 1e-3).mean() > 0.99
    assert T[2, 3] == pytest.approx(0.225)
    both = near & np.isfinite(scan.ranges)
    sigma = np.maximum(0.01, 0.01 * true[both])
    off = (scan.ranges[both] - true[both]) / sigma
    assert abs(off.mean()) < 0.2
    assert off.std() == pytest.approx(1, abs=0.15)
    assert np.isposinf(scan.ranges[solid > 5.9]).all()
    np.testing.assert_allclose(scan.pose_world_base, se2.flattened(short.odometry.at(scan.stamp_ns)), atol=1e-9)


def test_the_kinect_sees_what_the_lidar_sees(full_size):
    seen = 0
    for frame in full_size.frames[::6]:
        T = full_size.truth.at(frame.stamp_ns) @ full_size.T_base_camera
        assert T[2, 3] == pytest.approx(0.28)
        points = frame.camera.back_project(frame.depth * np.float32(frame.depth_scale)).reshape(-1, 3)
        points = transform_points(T, points[(frame.reason == Reason.VALID).ravel()])
        slice_ = points[np.abs(points[:, 2] - 0.225) < 0.02]
        away = np.linalg.norm(slice_[:, :2] - T[:2, 3], axis=1)
        if not len(slice_):
            continue  # all is beyond its reach
        off = distance_to(full_size.plan.outline(0.2, 0.25), slice_[:, :2])
        assert (off < 0.02 + 0.006 * away**2).mean() > 0.97
        seen += len(slice_)
        floor = points[points[:, 2] < 0.05]
        if len(floor):
            assert np.median(np.abs(floor[:, 2])) < 0.03
    assert seen > 3000


def test_the_kinect_measures_in_steps_and_tells_why_a_pixel_is_empty():
    kinect = Kinect(kinect_camera())
    assert np.degrees(2 * np.arctan(320 / kinect.camera.fx)) == pytest.approx(57)
    assert np.degrees(2 * np.arctan(240 / kinect.camera.fy)) == pytest.approx(43)
    for depth in (1.0, 3.0, 5.0):
        measured, reason = kinect.measure(np.full((480, 640), depth, np.float32), 1)
        assert (reason == Reason.VALID).all()
        assert measured.mean() / 1000 == pytest.approx(depth, rel=0.01)
        step = depth**2 / (kinect.camera.fx * 0.075) / 8
        assert measured.std() / 1000 == pytest.approx(step * np.sqrt(0.25 + 1 / 12), rel=0.2)  # noise and rounding
        assert len(np.unique(measured)) <= 7
    scene = np.full((480, 640), 4.0, np.float32)
    scene[:, :200], scene[100:380, 300:400], scene[:, 600:] = 0.5, 1.5, np.inf
    measured, reason = kinect.measure(scene, 1)
    assert (reason[:, :200] == Reason.TOO_NEAR).all()
    assert (reason[:, 605:] == Reason.TOO_FAR).all()
    beside = reason[200, 260:300]
    assert (beside[-15:] == Reason.UNMATCHED).all()  # in the shadow of what is nearer
    assert (beside[:10] == Reason.VALID).all()
    assert not measured[reason != Reason.VALID].any()


@pytest.mark.parametrize("width", [640, 160])
def test_the_kinect_tells_its_noise(width):
    kinect = Kinect(kinect_camera(width))
    noise = RangeNoise.of(NoiseConfig.model_validate({}), kinect.camera)
    for depth in (2.0, 3.0, 5.0):
        measured, _ = kinect.measure(np.full((kinect.camera.height, width), depth, np.float32), 1)
        assert noise.sigma(depth) == pytest.approx(measured.std() / 1000, rel=0.06)


def test_without_noise_all_is_exact():
    floor = Floor(f"sim:floor?noise=0&drift=0&seconds=3&{SMALL}")
    frame = floor.frames[2]
    valid = frame.reason == Reason.VALID
    np.testing.assert_array_equal(frame.depth[valid], floor.true_depth(frame.stamp_ns)[valid])
    ranges = floor.scans[2].ranges
    inside = np.isfinite(ranges)
    np.testing.assert_allclose(ranges[inside], floor.true_ranges(floor.scans[2].stamp_ns)[inside], rtol=1e-6)
    world = inverse(se2.lifted(floor.start)) @ floor.truth.at(frame.stamp_ns) @ floor.T_base_camera
    np.testing.assert_allclose(frame.T_world_sensor, world, atol=2e-3)  # between two poses of the odometry


def test_a_shut_door_is_shut():
    assert len(PLANS) == 2
    open_, shut = Floor("sim:floor"), Floor("sim:floor?shut=1")
    x0, y0, x1, y1 = shut.behind_door

    def inside(floor: Floor) -> bool:
        x, y = floor.truth.T_world_body[:, :2, 3].T
        return bool(((x > x0) & (x < x1) & (y > y0) & (y < y1)).any())

    assert inside(open_)
    assert not inside(shut)
    grid = shut.true_grid(0.05)
    rows, columns = np.nonzero(grid.cells == 0)
    x, y = grid.centres(rows, columns).T
    assert not ((x > x0) & (x < x1) & (y > y0 + 0.05) & (y < y1)).any()
    assert Floor("sim:floor?plan=testbed").behind_door is None


def test_a_robot_is_opened_by_its_name_and_bad_words_end_in_one_line():
    robot = open_robot("sim:floor?seconds=2&scan_hz=0&depth_hz=1")
    assert isinstance(robot, Floor)
    assert (len(robot.scans), len(robot.frames)) == (0, 2)
    for words in ("plan=garden", "speed=0", "sped=1", "seconds=x", "image_width=4", "depth_hz=-1", "drift=nan", "plan"):
        with pytest.raises(SourceError, match=r"^sim:floor\?") as error:
            open_robot(f"sim:floor?{words}")
        assert "\n" not in str(error.value)
