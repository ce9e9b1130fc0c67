# SPDX-License-Identifier: Apache-2.0
"""Distances of an autopilot's sensors, encoded and decoded by pymavlink."""

from math import inf, isnan, radians

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

import stereovox as sv
from stereovox.errors import FrameRefused
from stereovox.mavlink.ranges import range_of


def message(orientation=0, current=150, **changes):
    fields = {
        "time_boot_ms": 5, "min_distance": 20, "max_distance": 400, "current_distance": current, "type": 1, "id": 3,
        "orientation": orientation, "covariance": 4, "horizontal_fov": radians(25), "vertical_fov": radians(20),
        "quaternion": [0.0, 0.0, 0.0, 0.0], "signal_quality": 0, **changes,
    }  # fmt: skip
    link = common.MAVLink(None)
    packed = common.MAVLink_distance_sensor_message(**fields).pack(link)
    return common.MAVLink(None).parse_buffer(packed)[0]


@pytest.mark.parametrize(
    ("orientation", "along"),
    [(0, (1, 0, 0)), (2, (0, -1, 0)), (4, (-1, 0, 0)), (6, (0, 1, 0)), (24, (0, 0, 1)), (25, (0, 0, -1))],
)
def test_a_cone_points_where_the_sensor_does(orientation, along):
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    seen = range_of(message(orientation), T, 7)
    np.testing.assert_allclose(seen.T_world_sensor[:3, 0], along, atol=1e-12)
    np.testing.assert_allclose(seen.T_world_sensor[:3, 3], [1, 2, 3])
    assert (seen.distance, seen.stamp_ns, seen.sensor) == (1.5, 7, "distance 3")
    assert (seen.beam.range_min, seen.beam.range_max, seen.beam.sigma) == pytest.approx((0.2, 4.0, 0.02))
    assert seen.beam.beam == pytest.approx(radians(25))


def test_a_quaternion_turns_it_in_the_axes_of_the_autopilot():
    """90 degrees about z, which points down: to the right."""
    seen = range_of(message(100, quaternion=[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]), np.eye(4), 0)
    np.testing.assert_allclose(seen.T_world_sensor[:3, 0], [0, -1, 0], atol=1e-6)


@pytest.mark.parametrize(("current", "distance"), [(401, inf), (19, -inf), (400, 4.0), (20, 0.2)])
def test_distances_beyond_its_limits_are_none(current, distance):
    assert range_of(message(current=current), np.eye(4), 0).distance == distance


def test_an_invalid_reading_is_none_and_what_is_not_known_is_usual():
    assert isnan(range_of(message(signal_quality=1), np.eye(4), 0).distance)
    beam = range_of(message(covariance=255, horizontal_fov=0, vertical_fov=0), np.eye(4), 0).beam
    assert (beam.sigma, beam.beam) == (0.03, radians(30))


@pytest.mark.parametrize("changes", [{"orientation": 12}, {"orientation": 100}, {"min_distance": 500}])
def test_what_cannot_be_is_refused(changes):
    with pytest.raises(FrameRefused) as refused:
        range_of(message(**changes), np.eye(4), 0)
    assert refused.value.reason == "bad_form"


def test_it_enters_a_map():
    mapper = sv.Mapper(voxel_size=0.1, max_range=5.0)
    assert not mapper.add(range_of(message(), np.eye(4), 0)).refused
    assert mapper.map.state([[0.75, 0.05, 0.05]]) == sv.State.FREE
    assert mapper.add(range_of(message(current=500), np.eye(4), 10**8)).refused == "no_valid_range"
