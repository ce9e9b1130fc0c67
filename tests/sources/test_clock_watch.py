# SPDX-License-Identifier: Apache-2.0
"""A clock that was set is noticed by when stamps arrive, and nothing else is."""

import numpy as np
import pytest

from stereovox.sources.poses.clock_watch import CLOCK, GONE, LATE, ClockWatch, Delays

MS = 1_000_000


def run(lates_ms, offsets_ms, period_ms=33, pose_delay_ms=5, pose_offsets_ms=None, watch=None):
    """Hand over images that come so late and whose clock is so much off; return the doubts and the watch."""
    poses = Delays()
    watch = watch or ClockWatch(poses)
    doubts, pose_ms = [], 0
    for k, (late, off) in enumerate(zip(lates_ms, offsets_ms, strict=True)):
        taken_ms = 1000 + k * period_ms
        arrived_ms = taken_ms + late
        while pose_ms + pose_delay_ms <= arrived_ms:
            shift = 0 if pose_offsets_ms is None else pose_offsets_ms[k]
            poses.heard((pose_ms + shift) * MS, (pose_ms + pose_delay_ms) * MS)
            pose_ms += 10
        doubts.append(watch.heard(int((taken_ms + off) * MS), int(arrived_ms * MS)))
    return doubts, watch


def jitter(n, seed=0):
    return 20 + np.random.default_rng(seed).exponential(8, n)


def test_clocks_that_agree_are_never_doubted():
    doubts, watch = run(jitter(1000), np.zeros(1000))
    assert watch.doubt is None
    assert sum(doubt is not None for doubt in doubts) <= 2


@pytest.mark.parametrize("step_ms", [-400, -100, -35, 100, 400, 5000, -100_000])
def test_a_clock_that_is_set_is_noticed_with_its_first_image(step_ms):
    doubts, watch = run(jitter(100), np.repeat([0, step_ms], 50))
    assert all(doubt is None for doubt in doubts[:50])
    assert watch.doubt is not None
    assert all(doubt is watch.doubt for doubt in doubts[50 if step_ms != 100 else 55 :])  # where late ones look usual
    assert watch.doubt.off_ns / MS == pytest.approx(-step_ms, abs=12)
    assert watch.doubt.announced == (step_ms < 0)


def test_an_image_that_is_late_once_is_cleared_by_the_next_one():
    lates = jitter(100)
    lates[60] = 150
    doubts, watch = run(lates, np.zeros(100))
    assert doubts[60].became == GONE
    assert doubts[60].cleared
    assert watch.doubt is None


def test_a_stamp_that_went_back_is_not_cleared_by_the_next_one():
    offsets = np.zeros(100)
    offsets[60:63] = -300
    doubts, watch = run(jitter(100), offsets)
    assert watch.doubt is None
    assert doubts[61].became == GONE
    assert not doubts[61].cleared


@pytest.mark.parametrize("per_s", [3, -3])
def test_a_clock_that_drifts_is_noticed_before_it_is_a_tenth_of_a_second_off(per_s):
    times_s = np.arange(1500) * 0.033
    doubts, watch = run(jitter(1500), per_s * times_s)
    assert watch.doubt is not None
    first = max(k for k, doubt in enumerate(doubts) if doubt is None)
    assert abs(per_s * times_s[first]) < 125


def test_a_clock_of_the_poses_that_is_set_is_noticed_too():
    _, watch = run(jitter(100), np.zeros(100), pose_offsets_ms=np.repeat([0, -400], 50).tolist())
    assert watch.doubt is not None
    assert watch.doubt.off_ns / MS == pytest.approx(-400, abs=15)


def test_both_clocks_may_be_set_at_once_as_by_the_one_of_the_machine():
    both = np.repeat([0, 400], 60)
    _, watch = run(jitter(120), both, pose_offsets_ms=both.tolist())
    assert watch.doubt is None


@pytest.mark.parametrize("offset_ms", [400, -400, 100_000])
def test_clocks_that_never_agreed_are_doubted_from_the_first_image_on(offset_ms):
    doubts, watch = run(jitter(50), np.full(50, offset_ms))
    assert all(doubt is watch.doubt for doubt in doubts)
    assert watch.doubt.start
    assert watch.doubt.off_ns / MS == pytest.approx(15 - offset_ms, abs=15)


def test_what_was_decided_counts_from_then_on():
    poses = Delays()
    watch = ClockWatch(poses)

    def image(ms, late_ms, stamp_off_ms=0):
        poses.heard((ms + late_ms - 5) * MS, (ms + late_ms) * MS)
        return watch.heard((ms + stamp_off_ms) * MS, (ms + late_ms) * MS)

    assert image(0, 30) is None
    late = image(1000, 430)
    watch.late()
    assert late.became == LATE
    assert image(1100, 430) is None
    set_back = image(1200, 430, -400)
    watch.corrected()
    assert set_back.became == CLOCK
    assert image(1300, 430) is None


def test_without_poses_nothing_can_be_said():
    watch = ClockWatch(Delays())
    assert watch.heard(0, 5 * MS) is None
    assert watch.heard(-(10**12), 40 * MS) is None
