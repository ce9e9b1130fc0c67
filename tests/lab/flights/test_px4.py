"""PX4's collision prevention, case by case from its documents."""

import numpy as np
import pytest

from stereovox_lab.flights.px4 import CollisionPrevention, Parameters, max_speed

NO_DATA, FREE = 65535, 501
AHEAD = np.array([1.0, 0.0])
NO_GUIDE = Parameters(cp_dist=0.5, cp_guide_ang=0)


def told(distances, now=0.0, parameters=NO_GUIDE):
    autopilot = CollisionPrevention(parameters)
    autopilot.receive(np.asarray(distances, np.uint16), 500, now)
    return autopilot


def around(value=FREE, **of_sector):
    cm = np.full(72, value)
    for bearing, own in of_sector.items():
        cm[int(bearing[1:]) // 5] = own
    return cm


def flown(autopilot, wanted=AHEAD, velocity=(0.0, 0.0), yaw=0.0, now=0.0):
    return autopilot.limited(np.asarray(wanted, float), np.asarray(velocity, float), yaw, now)


def test_stopping_distance_is_that_of_the_jerk_limited_brake():
    for metres in (0.0, 0.1, 1.0, 7.0):
        v = max_speed(8.0, 3.0, metres)
        assert v * v / (2 * 3.0) + v * 2 * 3.0 / 8.0 == pytest.approx(metres)


def test_free_space_is_flown_at_the_speed_asked_for_up_to_the_range():
    assert flown(told(around())) == pytest.approx([1, 0])
    fast = flown(told(around()), wanted=(20.0, 0.0))
    assert np.linalg.norm(fast) == pytest.approx(min(0.95 * 4.51, max_speed(8, 3, 4.51)))


def test_the_nearer_an_obstacle_the_slower():
    speeds = [flown(told(around(b0=cm)))[0] for cm in (60, 80, 120)]
    assert speeds == pytest.approx([0.95 * 0.1, 0.95 * 0.3, 0.95 * 0.7], rel=0.2)
    assert flown(told(around(b0=50))) == pytest.approx([0, 0])
    assert flown(told(around(b0=1))) == pytest.approx([0, 0])


def test_an_obstacle_aside_limits_what_brings_it_nearer_and_none_behind_does():
    aside = flown(told(around(b60=80)))[0]
    assert aside == pytest.approx(min(0.95 * 0.3, max_speed(8, 3, 0.3)) / 0.5)
    assert flown(told(around(b120=60))) == pytest.approx([1, 0])


def test_bearings_are_clockwise_from_the_front():
    right = told(around(b90=50))
    assert flown(right, wanted=(0, -1)) == pytest.approx([0, 0])
    assert flown(right, wanted=(0, 1)) == pytest.approx([0, 1])
    assert flown(right, wanted=(1, 0), yaw=np.pi / 2) == pytest.approx([0, 0])  # now its right is the world's x


def test_speed_counts_for_the_delay():
    still = flown(told(around(b0=200)), wanted=(3, 0))[0]
    moving = flown(told(around(b0=200)), wanted=(3, 0), velocity=(1, 0))[0]
    stop = 1.5 - 0.4
    assert moving == pytest.approx(min(0.95 * stop, max_speed(8, 3, stop)))
    assert moving < still
    old = flown(told(around(b0=200)), wanted=(3, 0), velocity=(1, 0), now=0.3)[0]
    assert old < moving


def test_where_nothing_is_known_it_does_not_fly():
    assert flown(told(around(b0=NO_DATA))) == pytest.approx([0, 0])
    assert flown(told(around(NO_DATA, b180=300))) == pytest.approx([0, 0])
    assert flown(told(around(NO_DATA))) == pytest.approx([0, 0])
    assert flown(CollisionPrevention(NO_GUIDE)) == pytest.approx([0, 0])


def test_it_stands_after_half_a_second_without_a_message():
    assert flown(told(around()), now=0.49) == pytest.approx([1, 0])
    assert flown(told(around()), now=0.5) == pytest.approx([0, 0])


def test_no_data_leaves_a_sector_as_it_was_for_half_a_second():
    autopilot = told(around())
    for now in (0.1, 0.3, 0.45):
        autopilot.receive(around(b0=NO_DATA).astype(np.uint16), 500, now)
        assert flown(autopilot, now=now) == pytest.approx([1, 0])
    autopilot.receive(around(b0=NO_DATA).astype(np.uint16), 500, 0.6)
    assert flown(autopilot, now=0.6) == pytest.approx([0, 0])


def test_it_is_guided_to_where_there_is_more_room_and_never_into_no_data():
    guided = Parameters(cp_dist=0.5)
    cm = around(90, b20=300, b10=300, b30=300)
    turned = flown(told(cm, parameters=guided))
    assert np.degrees(np.arctan2(-turned[1], turned[0])) == pytest.approx(20)
    none = flown(told(around(90, b20=NO_DATA, b10=NO_DATA, b30=NO_DATA), parameters=guided))
    assert not 5 < np.degrees(np.arctan2(-none[1], none[0])) < 35
