# SPDX-License-Identifier: Apache-2.0
"""Readings of an IMU: what is none, what covers a span, and those that arrive one by one."""

from threading import Thread

import numpy as np
import pytest

from stereovox.errors import SourceError, StereovoxError
from stereovox.sources.imu import KEPT, ImuReadings, LiveImu, at_times, in_order

MS = 1_000_000
STAMPS = np.arange(0, 100, 10) * MS
RATES = np.column_stack([np.arange(10.0), np.zeros(10), np.ones(10)])


def readings(**other):
    return ImuReadings(**{"stamps_ns": STAMPS, "angular_rate": RATES, "specific_force": RATES + 9, **other})


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"stamps_ns": STAMPS[::-1]}, "ascending"),
        ({"stamps_ns": np.zeros(10, int)}, "ascending"),
        ({"angular_rate": RATES[:5]}, "angular_rate has shape"),
        ({"specific_force": RATES[:, :2]}, "specific_force has shape"),
        ({"angular_rate": RATES * np.nan}, "finite rad/s"),
        ({"T_sensor_imu": 2 * np.eye(4)}, "not a rigid motion"),
    ],
)
def test_what_are_no_readings_is_said_in_one_line(other, said):
    with pytest.raises(StereovoxError, match=said) as error:
        readings(name="walk imu", **other)
    assert str(error.value).startswith("walk imu: ")


@pytest.mark.parametrize(
    ("span", "stamps"), [((21, 39), (20, 30, 40)), ((20, 40), (20, 30, 40)), ((-9, 5), (0, 10)), ((95, 99), (90,))]
)
def test_a_span_has_the_neighbours_before_and_after(span, stamps):
    found = readings().between(span[0] * MS, span[1] * MS)
    assert (found.stamps_ns // MS).tolist() == list(stamps)
    np.testing.assert_array_equal(found.angular_rate[:, 0], np.array(stamps) / 10)
    np.testing.assert_array_equal(found.specific_force[:, 0], np.array(stamps) / 10 + 9)


def test_how_often():
    assert readings().rate_hz == pytest.approx(100)
    assert repr(readings(name="walk")) == "<ImuReadings: 10 of walk, 100 a second>"
    assert ImuReadings(STAMPS[:1], RATES[:1], RATES[:1]).rate_hz == 0


def test_files_are_sorted_and_what_is_no_reading_is_left_out():
    order = [3, 1, 1, 0, 2]
    rates = RATES[order].copy()
    rates[0, 0] = np.nan
    found = in_order(STAMPS[order], rates, RATES[order], np.eye(4), "a")
    assert (found.stamps_ns // MS).tolist() == [0, 10, 20]
    with pytest.raises(SourceError, match="a: holds 0 usable readings"):
        in_order(STAMPS, RATES * np.nan, RATES, np.eye(4), "a")


def test_values_at_other_times_lie_on_straight_lines_and_gaps_stay_empty():
    found = at_times(np.array([0, 10, 500]) * MS, RATES[:3], np.array([-1, 0, 4, 10, 100, 500, 501]) * MS)
    np.testing.assert_allclose(found[:, 0], [np.nan, 0, 0.4, 1, np.nan, 2, np.nan])
    assert np.isnan(at_times(np.empty(0, np.int64), np.empty((0, 3)), STAMPS)).all()
    np.testing.assert_allclose(at_times(STAMPS[1:2], RATES[1:2], STAMPS[:2])[:, 0], [np.nan, 1])


def live(count=10, step=10):
    imu = LiveImu(name="camera IMU")
    for k in range(count):
        imu.add_angular_rate(k * step * MS, (k, 0, 0))
        imu.add_specific_force((k * step + 5) * MS, (0, 0, k))
    return imu


def test_a_live_one_says_what_a_recorded_one_would():
    found = live().between(21 * MS, 39 * MS)
    assert (found.stamps_ns // MS).tolist() == [20, 30, 40]
    np.testing.assert_allclose(found.angular_rate[:, 0], [2, 3, 4])
    np.testing.assert_allclose(found.specific_force[:, 2], [1.5, 2.5, 3.5])
    assert len(live().between(0, 95 * MS)) == 10
    assert len(LiveImu().between(0, MS)) == 0


def test_a_live_one_forgets_what_is_old_and_leaves_what_is_none():
    imu = live(KEPT + 50, 1)
    assert imu.seconds == pytest.approx((KEPT - 1) / 1000)
    assert imu.between(0, 10 * MS).stamps_ns[0] >= 50 * MS or not len(imu.between(0, 10 * MS))
    before = len(imu.between(0, 10**15))
    imu.add_angular_rate(5, (1, 1, 1))  # of the past
    imu.add_angular_rate(10**15, (np.nan, 0, 0))
    assert len(imu.between(0, 10**15)) == before
    with pytest.raises(StereovoxError, match="give 3 numbers"):
        imu.add_specific_force(10**15, (1, 2))
    with pytest.raises(StereovoxError, match="not a rigid motion"):
        LiveImu(np.zeros((4, 4)))


def test_one_thread_adds_while_another_reads():
    imu, failed = LiveImu(), []

    def read():
        try:
            for _ in range(300):
                imu.between(0, 10**12)
        except Exception as error:
            failed.append(error)

    thread = Thread(target=read)
    thread.start()
    for k in range(3000):
        imu.add_angular_rate(k, (0, 0, 1))
    thread.join()
    assert not failed
    assert len(imu.between(0, 10**12)) == 3000
