"""The other machine's clock, from made up delays."""

import numpy as np
import pytest

from stereovox.mavlink.link import ENOUGH, RemoteClock

AHEAD_NS = 5_000_000_000_000
MS = 1_000_000


def ask(clock, at_ns, there_ns, back_ns, ahead_ns=AHEAD_NS):
    clock.answered(at_ns, at_ns + there_ns + ahead_ns, at_ns + there_ns + back_ns)


def test_the_answer_with_the_shortest_round_trip_counts():
    clock, random = RemoteClock(), np.random.default_rng(0)
    for k in range(30):
        ask(clock, k * 200 * MS, *(1 * MS + random.exponential(5 * MS, 2).astype(int)))
    assert clock.error_ns is not None
    assert abs(clock.offset_ns - AHEAD_NS) <= clock.error_ns
    assert abs(clock.offset_ns - AHEAD_NS) < 2 * MS
    assert clock.local_ns(AHEAD_NS + 7) == AHEAD_NS + 7 - clock.offset_ns


def test_an_even_delay_makes_no_error():
    clock = RemoteClock()
    ask(clock, 10, 4 * MS, 4 * MS)
    assert clock.offset_ns == AHEAD_NS


def test_slow_answers_are_passed_over():
    clock = RemoteClock()
    ask(clock, 0, 400 * MS, 1 * MS)
    assert clock.offset_ns is None


def test_without_answers_the_least_delay_counts_once_enough_came():
    clock, random = RemoteClock(), np.random.default_rng(1)
    delays = 2 * MS + random.exponential(10 * MS, 100).astype(int)
    for k, delay in enumerate(delays[: ENOUGH - 1]):
        clock.heard(k * 20 * MS + AHEAD_NS, k * 20 * MS + delay)
    assert clock.offset_ns is None
    for k, delay in enumerate(delays[ENOUGH - 1 :], ENOUGH - 1):
        clock.heard(k * 20 * MS + AHEAD_NS, k * 20 * MS + delay)
    assert clock.offset_ns == AHEAD_NS - delays.min()
    assert clock.error_ns is None
    ask(clock, 3000 * MS, 1 * MS, 1 * MS)
    assert clock.offset_ns == AHEAD_NS  # an answer is worth more


@pytest.mark.parametrize("way", ["answered", "heard"])
def test_a_clock_that_was_started_again_is_a_new_one(way):
    clock = RemoteClock()
    for k in range(2 * ENOUGH):
        ask(clock, k * 200 * MS, MS, MS)
        clock.heard(k * 200 * MS + AHEAD_NS, k * 200 * MS + MS)
    at = 2 * ENOUGH * 200 * MS
    if way == "answered":
        ask(clock, at, MS, MS, ahead_ns=-at)
        assert clock.offset_ns == -at
    else:
        clock.heard(0, at)
        assert clock.offset_ns is None


def test_a_clock_that_drifts_is_followed():
    clock = RemoteClock()
    for k in range(1000):
        at = k * 200 * MS
        ask(clock, at, MS, MS, ahead_ns=AHEAD_NS + at // 20_000)  # 50 ppm
    assert abs(clock.offset_ns - (AHEAD_NS + 999 * 200 * MS // 20_000)) < 0.5 * MS


@pytest.mark.parametrize("step_ms", [-400, -150, -30, 30, 150, 400])
def test_a_clock_that_is_set_is_known_again_with_the_first_answer(step_ms):
    clock, random = RemoteClock(), np.random.default_rng(2)
    for k in range(60):
        ahead_ns = AHEAD_NS + (step_ms * MS if k >= 40 else 0)
        ask(clock, k * 200 * MS, *(1 * MS + random.exponential(3 * MS, 2).astype(int)), ahead_ns)
        if k != 40:
            assert clock.times_set == (k > 40)
    assert abs(clock.offset_ns - AHEAD_NS - step_ms * MS) < 3 * MS


@pytest.mark.parametrize("answers", [True, False])
def test_a_clock_that_is_set_back_gives_no_time_until_it_is_known_again(answers):
    clock, back_ns, wrong = RemoteClock(), 400 * MS, []
    for k in range(200):
        at, ahead_ns = k * 20 * MS, AHEAD_NS - (back_ns if k >= 100 else 0)
        if answers and k % 10 == 0 and k != 100:
            ask(clock, at, 2 * MS, 2 * MS, ahead_ns)
        clock.heard(at + ahead_ns, at + 3 * MS)
        local_ns = clock.local_ns(at + ahead_ns)
        if local_ns is not None and abs(local_ns - at) > 5 * MS:
            wrong.append(k)
    assert not wrong
    assert clock.offset_ns is not None
    assert clock.times_set == 1


def test_a_message_that_is_overtaken_is_no_clock_that_was_set():
    clock = RemoteClock()
    for k in range(3 * ENOUGH):
        clock.heard(AHEAD_NS + (k * 20 - (50 if k % 7 == 0 else 0)) * MS, k * 20 * MS)
    assert clock.times_set == 0
