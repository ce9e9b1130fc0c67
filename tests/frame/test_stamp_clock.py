# SPDX-License-Identifier: Apache-2.0
"""How old an event is by its stamp: known clocks, recognised ones, least delays, and recordings at any speed."""

import numpy as np
import pytest

import stereovox as sv
from stereovox.errors import ConfigError
from stereovox.frame.stamp_clock import CONFIRMED, StampClock

S = 1_000_000_000
CAMERA = sv.PinholeCamera(16, 12, 12.0, 12.0, 7.5, 5.5, 0.05)
POSE = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])


def frame(**changes):
    return sv.Frame(np.full((12, 16), 2.0, np.float32), CAMERA, POSE, **changes)


class Time:
    """The true time in seconds, by the test's word, and what two clocks show then: the mapper's, and the epoch's."""

    def __init__(self, now_s=1000.0):
        self.s = now_s

    def __call__(self):
        return round(self.s * S)

    def epoch(self):
        return round((self.s + 1.7e9) * S)


def stamps(time, by=None, ordered=True):
    return StampClock(time, by, time.epoch, ordered)


def delays_seen(clock, time, delays_s, step_s=0.1, offset_s=0.0, source="camera"):
    """Return what is said of the age of each event when it comes, seconds; events happen every `step_s`."""
    seen, begin = [], time.s
    for k, delay_s in enumerate(delays_s):
        event_s = begin + k * step_s
        time.s = event_s + delay_s
        stamp_ns = round((event_s + offset_s) * S)
        clock.heard(source, stamp_ns, time())
        seen.append(clock.age_ns(stamp_ns, time()) / S)
    return seen


def test_a_told_clock_says_how_late_an_event_is_from_the_first_on():
    time = Time()
    clock = stamps(time, lambda: time() + 77 * S)
    assert delays_seen(clock, time, [3.0] * 4, offset_s=77) == pytest.approx([3.0] * 4)


@pytest.mark.parametrize(("now_s", "offset_s"), [(1000.0, 1.7e9), (5.0, 1.7e9), (1000.0, 0.0)])
def test_the_clock_of_this_machine_is_recognised(now_s, offset_s):
    time = Time(now_s)
    assert delays_seen(stamps(time), time, [3.0] * 3, offset_s=offset_s) == pytest.approx([3.0] * 3, abs=1e-6)
    time = Time(now_s)
    replay = delays_seen(stamps(time, "replay"), time, [3.0] * 3, offset_s=offset_s)
    assert replay == pytest.approx([0.0] * 3)


@pytest.mark.parametrize("offset_s", [0.0, -7 * 86400.0, 1.3e9])
def test_nothing_is_recognised_that_may_be_chance(offset_s):
    time = Time(20.0)  # a machine that was just started, and a recording whose stamps begin at 0
    assert delays_seen(stamps(time), time, [0.0] * 3, offset_s=offset_s - 20.0) == pytest.approx([0.0] * 3)


def test_a_growing_delay_is_an_age_where_stamps_are_live_and_none_in_a_replay():
    delays_s = [0.05 + 0.02 * k for k in range(100)]
    time = Time()
    live = delays_seen(stamps(time, "live"), time, delays_s, offset_s=-500)
    assert live[-1] == pytest.approx(delays_s[-1] - delays_s[0], abs=0.1)
    time = Time()
    assert max(delays_seen(stamps(time, "replay"), time, delays_s, offset_s=-500)) == pytest.approx(0.0)


def test_a_function_that_does_not_know_is_as_live():
    time = Time()
    live = delays_seen(stamps(time, lambda: None), time, [0.0] * 6 + [2.0], offset_s=-500)
    assert live[-1] == pytest.approx(2.0, abs=1e-3)


def test_newer_stamps_of_poses_prove_that_an_image_is_old_from_the_first_on():
    time = Time()
    clock = stamps(time)
    clock.heard("poses", 100 * S, time())
    clock.heard("camera", 97 * S, time())
    time.s += 0.5
    assert clock.age_ns(97 * S, time()) == 3.5 * S


def test_one_stamp_too_far_ahead_does_not_make_all_later_ones_old():
    time = Time()
    clock = stamps(time, "live")
    delays_seen(clock, time, [0.02] * 20, 0.1, -500)
    clock.heard("camera", time() - 500 * S + S * 6 // 10, time())
    ages_s = delays_seen(clock, time, [0.02] * 20, 0.1, -500)
    assert max(ages_s[:3]) > 0.4  # while it may be true
    assert max(ages_s[8:]) < 0.05
    ahead = delays_seen(clock, time, [-0.3] * CONFIRMED + [0.02], 0.1, -500)
    assert ahead[-1] == pytest.approx(0.32, abs=0.01)  # confirmed: it is the others that were late


def test_a_clock_that_was_set_back_is_learnt_anew():
    time = Time()
    clock = stamps(time, "live")
    delays_seen(clock, time, [0.0] * 10)
    assert delays_seen(clock, time, [0.0] * 10, offset_s=-30)[-1] == pytest.approx(0.0)


def test_two_quartzes_that_run_apart_make_nothing_old():
    time = Time()
    clock, last = stamps(time, "live"), 0
    for k in range(40_000):
        time.s = 1000.0 + k
        last = round((k * (1 - 5e-5)) * S)
        clock.heard("camera", last, time())
    assert clock.age_ns(last, time()) / S < 0.01


def test_without_order_the_newest_stamp_is_not_the_last_event():
    time = Time()
    clock = stamps(time, ordered=False)
    clock.heard("camera", 100 * S, time())
    clock.heard("camera", 99 * S, time())
    assert clock.age_ns(99 * S, time()) <= 0


def mapper_at(time, **more):
    return sv.Mapper(voxel_size=0.25, max_range=3.0, clock=time, **more)


@pytest.mark.parametrize("speed", [0.1, 1.0, 20.0])
def test_a_recording_of_2011_is_current_at_any_speed(speed):
    time = Time()
    mapper = mapper_at(time)
    for k in range(8):
        time.s += 0.1 / speed
        mapper.add(frame(stamp_ns=1_300_000_000 * S + round(0.1 * k * S)))
    assert (mapper.health().state, mapper.health().age_s) == ("current", 0.0)


def test_a_late_camera_is_stale_although_it_never_falls_silent():
    time = Time()
    mapper = mapper_at(time, stamp_clock=time)
    for _ in range(5):
        time.s += 0.1
        mapper.add(frame(stamp_ns=time() - 3 * S))
    health = mapper.health()
    assert (health.state, health.age_s) == ("stale", pytest.approx(3.0))
    assert health.text == "stale: last trusted frame 3.00 s ago; frames of 'camera' arrive 3.00 s late"
    time.s += 2.5
    assert mapper.health().state == "lost"


def test_a_late_sensor_next_to_one_in_time_makes_the_map_stale_and_a_silent_one_degrades_it():
    time = Time()
    mapper = mapper_at(time)
    for _ in range(10):
        time.s += 0.1
        mapper.add(frame(sensor="left", stamp_ns=time()))
        mapper.add(frame(sensor="right", stamp_ns=time() - 2 * S))
    health = mapper.health()
    assert (health.state, health.ages_s) == ("stale", pytest.approx({"left": 0.0, "right": 2.0}))
    for _ in range(6):
        time.s += 0.1
        mapper.add(frame(sensor="left", stamp_ns=time()))
    health = mapper.health()
    assert (health.state, health.ages_s["right"]) == ("degraded", pytest.approx(2.6))


def test_the_clock_can_be_said_later_and_nonsense_is_refused():
    time = Time()
    mapper = mapper_at(time)
    assert mapper.stamp_clock is None
    mapper.add(frame(stamp_ns=5 * S))
    mapper.stamp_clock = lambda: 9 * S
    assert mapper.health().age_s == pytest.approx(4.0)
    for bad in ("epoch", 7):
        with pytest.raises(ConfigError, match="give 'live', 'replay' or a function"):
            mapper.stamp_clock = bad
