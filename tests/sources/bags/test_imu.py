# SPDX-License-Identifier: Apache-2.0
"""An accelerometer in a bag reports which way is up, where /tf says how it is mounted and it feels gravity alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_robot_bags import MS, START_NS, RobotBagMaker
from made_unposed import room

from stereovox.errors import SourceError
from stereovox.opening import open_images, open_source
from stereovox.runs.survey import survey
from stereovox.sources.bags.writer import BagWriter

ASIDE = [0.3, 0, 0, np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
"""The camera in the body: its y is the body's z."""
LEAN = np.radians(20)


def bag(path, force, mounted=True, covariance=0.0):
    """A body that leans by 20 degrees about x in a world `map`, whose IMU feels `force` (3,)."""
    lean = [0, 0, 1, np.sin(LEAN / 2), 0, 0, np.cos(LEAN / 2)]
    with RobotBagMaker(path) as made:
        made.depth(3)
        made.tf(START_NS, "body", "optical", ASIDE, "/tf_static")
        if mounted:
            made.tf(START_NS, "body", "imu", [0, 0, 0, 0, 0, 0, 1], "/tf_static")
        rng = np.random.default_rng(1)
        for k in range(60):
            stamp_ns = START_NS + 10 * k * MS
            made.tf(stamp_ns, "map", "body", lean)
            felt = np.asarray(force) + 0.3 * rng.normal(size=3)
            zero = made._vector("geometry_msgs/Vector3", (0.0, 0.0, 0.0))
            message = made.make(
                "sensor_msgs/Imu", header=made.header(stamp_ns, "imu"),
                orientation=made.make("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=np.zeros(9), angular_velocity=zero, angular_velocity_covariance=np.zeros(9),
                linear_acceleration=made._vector("geometry_msgs/Vector3", felt.tolist()),
                linear_acceleration_covariance=np.full(9, covariance),
            )  # fmt: skip
            made.add("/imu", "sensor_msgs/Imu", stamp_ns, message)
    return open_source(made.path)


@pytest.mark.parametrize("name", ["walk.bag", "walk.db3"])
def test_up_is_what_the_accelerometer_feels_turned_by_its_mount(tmp_path, name):
    source = bag(tmp_path / name, (0.0, 0.0, 9.81))
    up = source.gravity()
    np.testing.assert_allclose(up, [0, -np.sin(LEAN), np.cos(LEAN)], atol=0.02)
    found = survey(source).up
    assert (found.axis, found.sure, found.why) == ("z", True, "by the accelerometer")
    assert np.degrees(found.off) == pytest.approx(20, abs=2)
    place = tmp_path / name.removesuffix(".db3")
    assert open_source(place, ":2").gravity() is not None


@pytest.mark.parametrize(
    ("force", "options"),
    [
        ((0.0, 0.0, 1.0), {}),  # in g, or falling
        ((0.0, 0.0, 9.81), {"mounted": False}),
        ((0.0, 0.0, 9.81), {"covariance": -1.0}),  # not measured
        ((np.nan, 0.0, 9.81), {}),
    ],
)
def test_nothing_is_said_where_that_is_not_gravity(tmp_path, force, options):
    assert bag(tmp_path / "walk.bag", force, **options).gravity() is None


def test_a_recording_without_an_imu_measures_nothing():
    assert open_source("sim:wall?image_width=160").gravity() is None
    assert open_source("sim:wall?image_width=160").imu() is None


RATE, FORCE = np.array([0.1, -0.2, 0.3]), np.array([0.5, 1.0, 9.7])
MOUNT = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
OPTICAL = "camera_depth_optical_frame"


def turning(path, write, frames=2):
    """A bag of our own with depth images, and what `write` adds."""
    with BagWriter(path) as made:
        for frame in room(frames):
            made.depth(replace(frame, stamp_ns=START_NS + frame.stamp_ns))
        write(made)
    return open_images(path)


def both(made, topic="/imu", frame_id="imu"):
    for k in range(20):
        made.imu(START_NS + 5 * k * MS, (1 + k) * RATE, FORCE, topic, frame_id)


@pytest.mark.parametrize("name", ["walk.bag", "walk.db3", "walk.mcap", "walk"])
def test_readings_come_back_with_their_mount(tmp_path, name):
    def write(made):
        made.fixed("imu", OPTICAL, MOUNT)
        both(made)

    found = turning(tmp_path / name, write).imu()
    np.testing.assert_array_equal(found.stamps_ns, START_NS + 5 * MS * np.arange(20))
    np.testing.assert_allclose(found.angular_rate, np.outer(1 + np.arange(20), RATE))
    np.testing.assert_allclose(found.specific_force, np.tile(FORCE, (20, 1)))
    np.testing.assert_allclose(found.T_sensor_imu, np.linalg.inv(MOUNT), atol=1e-6)
    assert found.name == f"{name} /imu"
    assert open_images(tmp_path / name, "1:").imu() is not None
    assert open_images(f"{tmp_path / name}?imu=off").imu() is None


@pytest.mark.parametrize("zeros", [True, False])
def test_gyroscope_and_accelerometer_on_topics_of_their_own(tmp_path, zeros):
    """As realsense-ros writes them, at 200 and 100 Hz; what is not measured is zero, or said not to be."""
    nothing = np.zeros(3) if zeros else None

    def write(made):
        for k in range(20):
            made.imu(START_NS + 5 * k * MS, RATE, nothing, "/camera/gyro/sample", "camera_gyro_optical_frame")
        for k in range(11):
            force = FORCE * (1 + k)
            made.imu(START_NS + (10 * k - 3) * MS, nothing, force, "/camera/accel/sample", "camera_accel_optical_frame")

    found = turning(tmp_path / "walk.bag", write).imu()
    assert len(found) == 20
    np.testing.assert_allclose(found.specific_force, np.outer(1 + (5 * np.arange(20) + 3) / 10, FORCE))
    np.testing.assert_array_equal(found.T_sensor_imu, np.eye(4))


def test_an_imu_whose_mount_nothing_says_is_not_used(tmp_path):
    source = turning(tmp_path / "walk.bag", both)
    with pytest.raises(SourceError, match=r"the mount of the IMU .* record /tf_static, or add \?imu=off"):
        source.imu()


def test_frames_without_a_name_are_not_the_same(tmp_path):
    with BagWriter(tmp_path / "walk.bag") as made:
        for frame in room(2):
            made.depth(replace(frame, stamp_ns=START_NS + frame.stamp_ns), frame_id="")
        both(made, frame_id="")
    with pytest.raises(SourceError, match=r"the mount of the IMU .* is unknown"):
        open_images(tmp_path / "walk.bag").imu()


def test_of_several_one_is_named(tmp_path):
    def write(made):
        both(made, "/imu", "imu_optical")
        both(made, "/base/imu", "base_optical")

    source = turning(tmp_path / "walk.bag", write)
    with pytest.raises(SourceError, match=r"\?imu=/base/imu or \?imu=/imu"):
        source.imu()
    assert open_images(f"{tmp_path}/walk.bag?imu=/base/imu").imu().name == "walk.bag /base/imu"
    with pytest.raises(SourceError, match="no topic /im of sensor_msgs/Imu"):
        open_images(f"{tmp_path}/walk.bag?imu=/im").imu()


def test_an_accelerometer_alone_is_no_imu(tmp_path):
    source = turning(tmp_path / "walk.bag", lambda made: made.imu(START_NS, None, FORCE))
    assert source.imu() is None
    assert turning(tmp_path / "none.bag", lambda made: None).imu() is None


@pytest.mark.parametrize("numbers", [(1, 2), (1, 2, np.nan)])
def test_what_is_no_reading_is_not_written(tmp_path, numbers):
    with pytest.raises(SourceError, match="give 3 finite numbers"), BagWriter(tmp_path / "a.bag") as made:
        made.imu(0, numbers, None)
