# SPDX-License-Identifier: Apache-2.0
"""An accelerometer in a bag tells which way is up, where /tf says how it is mounted and it feels gravity alone."""

from __future__ import annotations

import numpy as np
import pytest
from made_robot_bags import MS, START_NS, RobotBagMaker

from stereovox.opening import open_source
from stereovox.survey import survey

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
