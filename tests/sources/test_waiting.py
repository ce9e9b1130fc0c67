# SPDX-License-Identifier: Apache-2.0
"""Frames wait for their pose, in order, and not for ever."""

import pytest

from stereovox.sources.latest import Arrival, Waiting

MS = 1_000_000


class Clock:
    def __init__(self):
        self.now = 0

    def __call__(self) -> int:
        return self.now


@pytest.fixture
def clock():
    return Clock()


def queue(clock, most=10, wait=100, late=50) -> Waiting[str]:
    return Waiting(most, wait * MS, late * MS, clock)


def always(_: Arrival) -> bool:
    return True


def never(_: Arrival) -> bool:
    return False


def taken(waiting: Waiting[str], is_ready) -> list[str]:
    found = []
    while (one := waiting.pop(is_ready)) is not None:
        found.append(one.content)
    return found


def test_a_frame_waits_until_it_is_ready_and_goes_on_as_it_is_after_that(clock):
    waiting = queue(clock)
    waiting.put("a", 5, "f", "one")
    clock.now = 100 * MS
    assert waiting.pop(never) is None
    clock.now += 1
    assert waiting.pop(never).content == "one"
    assert len(waiting) == 0
    assert not waiting.dropped


def test_frames_of_one_sensor_keep_their_order_even_if_a_later_one_is_ready_first(clock):
    waiting = queue(clock)
    for n, name in enumerate("abc"):
        waiting.put("s", n, "f", name)
    assert waiting.pop(lambda one: one.content != "a") is None
    assert taken(waiting, always) == ["a", "b", "c"]


def test_sensors_do_not_wait_for_each_other_and_the_oldest_goes_first(clock):
    waiting = queue(clock)
    waiting.put("slow", 1, "f", "slow")
    waiting.put("x", 30, "f", "x30")
    waiting.put("y", 20, "f", "y20")
    assert taken(waiting, lambda one: one.sensor != "slow") == ["y20", "x30"]
    assert taken(waiting, always) == ["slow"]


def test_where_the_map_is_busy_the_newest_frames_count(clock):
    waiting = queue(clock)
    for n in range(4):
        waiting.put("s", n, "f", f"{n}")
    assert waiting.pop(always).content == "0"  # 1, 2 and 3 are not known to be ready so far
    waiting.pop(lambda one: one.content == "1")
    waiting = queue(clock)
    for n in range(4):
        waiting.put("s", n, "f", f"{n}")
    waiting._queues["s"][0].ready_ns = clock.now
    waiting._queues["s"][1].ready_ns = clock.now
    clock.now += 51 * MS
    assert taken(waiting, always) == ["2", "3"]
    assert waiting.dropped == {"s": 2}


def test_what_is_late_still_counts_where_nothing_newer_is_ready(clock):
    waiting = queue(clock)
    waiting.put("s", 1, "f", "old")
    waiting.put("s", 2, "f", "new")
    waiting._queues["s"][0].ready_ns = clock.now
    clock.now += 60 * MS
    assert waiting.pop(lambda one: one.content == "old").content == "old"
    assert not waiting.dropped


def test_a_burst_of_poses_drops_nothing(clock):
    waiting = queue(clock)
    for n in range(6):
        clock.now = 10 * n * MS
        waiting.put("s", n, "f", f"{n}")
        assert waiting.pop(never) is None
    clock.now = 99 * MS
    assert taken(waiting, always) == list("012345")
    assert not waiting.dropped


def test_the_queue_is_bounded(clock):
    waiting = queue(clock, most=3)
    for n in range(8):
        waiting.put("s", n, "f", f"{n}")
    assert len(waiting) == 4
    assert taken(waiting, always) == ["4", "5", "6", "7"]
    assert waiting.dropped == {"s": 4}


def test_what_waits_for_longer_than_the_queue_holds_is_returned_as_it_is(clock):
    waiting, came = queue(clock, most=3), []
    for n in range(8):
        clock.now = n * MS
        waiting.put("s", n, "f", f"{n}")
        came += taken(waiting, never)
    assert came == list("01234")
    assert not waiting.dropped


def test_a_frame_is_late_by_when_it_was_ready_not_by_when_its_turn_came(clock):
    """A map that stays too slow must not fall behind by as many frames as fit into the queue."""
    waiting = queue(clock, late=50)
    for k in range(8):
        waiting.put("a", k, "", str(k))
    waiting.pop(always)
    clock.now = 60 * MS
    found = waiting.pop(always)
    assert found is not None
    assert found.content == "7"
    assert waiting.dropped["a"] == 6
