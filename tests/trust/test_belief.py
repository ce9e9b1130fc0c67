# SPDX-License-Identifier: Apache-2.0
"""Frames that disagree with the map: refused at first, believed when the world has changed, not when the camera has."""

import json
from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.trust.gate import MAX_LIMIT, MIN_FRAMES, SPREADS, USUAL_AT_FIRST, DisagreementMonitor
from stereovox.trust.history import MAX_SENSORS, Doubt, History, RunningMean, Seen

FRAME = sv.Frame(np.ones((2, 2), np.float32), sv.PinholeCamera(2, 2, 1, 1, 0.5, 0.5), np.eye(4))


class Told:
    """A monitor that is asked frame by frame; its history goes through a file before each of them."""

    def __init__(self, moved=False, **trust):
        self.config = load_config(voxel_size=0.1, **{f"trust.{name}": value for name, value in trust.items()})
        self.history, self.moved, self.asked = History(), moved, 0

    def __call__(self, *shares, ms=100, sensor="camera"):
        """Return what becomes of one frame after the other, `ms` apart: "", why it was refused, or "after ..."."""
        return [self.one(share, ms, sensor) for share in shares]

    def one(self, against, ms, sensor):
        self.now = getattr(self, "now", 0) + ms * 1_000_000
        self.history = History.loaded(json.loads(json.dumps(self.history.saved())))
        monitor = DisagreementMonitor(self.config, self.history)
        fits = monitor.limit_elsewhere(sensor, self.now, against) is not None and self.ask()
        try:
            agreement = monitor.check(FRAME, sensor, self.now, against, fits)
        except FrameRefused as refused:
            return refused.reason
        monitor.accept(sensor, agreement)
        return f"after {agreement.after}" if agreement.after else ""

    def ask(self):
        self.asked += 1
        return self.moved


CHANGED, MOVED = "disagrees_with_map", "camera_moved"


def test_a_frame_may_disagree_as_much_as_usual_and_some_more():
    told = Told()
    assert told(*[0.03] * 40) == [""] * 40
    assert told.history.usual["camera"] == pytest.approx((0.03, 0), abs=1e-3)
    limit = DisagreementMonitor(told.config, told.history).limit("camera", 0)
    assert limit == pytest.approx(0.03 + told.config.trust.max_disagreement, abs=1e-3)
    assert told(limit - 0.001) == [""]
    assert told(0.3, 0.03, 0.03) == [CHANGED, "", ""]


def test_at_first_nothing_is_known_of_what_is_usual():
    assert Told()(2 * USUAL_AT_FIRST.mean - 0.01) == [""]
    assert Told()(2 * USUAL_AT_FIRST.mean + 0.01) == [CHANGED]


def test_where_frames_disagree_now_more_and_now_less_a_frame_may_as_well():
    told = Told()
    assert told(*[0.1, 0.3] * 20) == [""] * 40
    mean, spread = told.history.usual["camera"]
    assert (mean, spread) == (pytest.approx(0.2, abs=0.03), pytest.approx(0.1, abs=0.03))
    assert told(mean + SPREADS * spread - 0.01) == [""]
    assert Told()(*[0.2] * 40, mean + SPREADS * spread - 0.01)[-1] == CHANGED


def test_small_cells_disagree_by_small_errors_of_the_pose():
    fine = load_config(voxel_size=0.02, **{"trust.pose_error_m": 0.006})
    history = History(usual={"camera": RunningMean(0.05, 0.0)})
    assert DisagreementMonitor(fine, history).limit("camera", 0) == pytest.approx(0.35)
    noisy = History(usual={"camera": RunningMean(0.7, 0.0)})
    assert DisagreementMonitor(fine, noisy).limit("camera", 0) == MAX_LIMIT


def test_a_world_that_has_changed_is_believed_after_a_second():
    told = Told()
    assert told(*[0.03] * 30, *[0.6] * 12) == [""] * 30 + [CHANGED] * 10 + [f"after {CHANGED}", ""]
    assert told.asked == 11
    assert told.history.usual["camera"].mean < 0.05  # what had to be believed is not usual
    assert told(0.03, 0.6) == ["", CHANGED]  # it agreed again: from here on the second starts anew


def test_a_frame_that_agrees_ends_the_waiting():
    told = Told()
    assert told(*[0.03] * 30, *[0.6] * 9, 0.03, *[0.6] * 9)[30:] == [CHANGED] * 9 + [""] + [CHANGED] * 9


def test_how_long_is_a_setting():
    assert Told(changed_s=0.6)(*[0.03] * 30, *[0.6] * 7)[30:] == [CHANGED] * 6 + [f"after {CHANGED}"]
    assert Told(changed_s=0)(*[0.03] * 30, 0.6)[30:] == [f"after {CHANGED}"]


def test_a_frame_that_comes_late_may_disagree_more():
    told = Told()
    told(*[0.03] * 40)
    told.history.trusted["camera"] = Seen(told.now, (0.0,) * 12)
    early, late = (
        DisagreementMonitor(told.config, told.history).limit("camera", told.now + ms * 1_000_000) for ms in (200, 1200)
    )
    assert late - 0.03 == pytest.approx(2 * (early - 0.03), rel=1e-2)
    assert DisagreementMonitor(told.config, told.history).limit("camera", told.now + 10**12) == late
    told.history.doubts["camera"] = Doubt(told.now, told.now + 10**9)
    assert DisagreementMonitor(told.config, told.history).limit("camera", told.now + 1_200_000_000) == early
    told.history.trusted["camera"] = Seen(told.now + 3 * 10**9, (0.0,) * 12)  # nothing is known of what it saw
    assert DisagreementMonitor(told.config, told.history).limit("camera", told.now + 3_200_000_000) == early


@pytest.mark.parametrize("moved", [False, True])
def test_a_few_frames_are_not_enough_however_long_they_take(moved):
    told = Told(moved=moved, moved_s=1e9)
    found = told(*[0.03] * 30, *[0.6] * MIN_FRAMES, 0.03, ms=2000)[30:]
    assert found == [CHANGED] * MIN_FRAMES + [""]
    told(*[0.6] * (MIN_FRAMES + 1), ms=2000)
    assert told.history.doubts["camera"].verdict == ("moved" if moved else "changed")


def test_frames_without_times_count_thirty_a_second():
    told = Told()
    found = told(*[0.03] * 40, *[0.6] * 32, ms=0)[40:]
    assert found == [CHANGED] * 30 + [f"after {CHANGED}", ""]


def test_a_clock_that_goes_back_does_not_end_the_waiting():
    told = Told()
    told(*[0.03] * 30, *[0.6] * 5)
    told.now -= 10**12
    assert told.one(0.6, 100, "camera") == CHANGED


def test_a_camera_that_was_moved_is_not_believed_until_it_agrees():
    told = Told(moved=True)
    assert told(*[0.03] * 30, *[0.6] * 40)[30:] == [CHANGED] * 10 + [MOVED] * 30
    assert told(None) == [MOVED]  # where nothing is known it is not believed either
    assert told(0.03, 0.03) == ["", ""]


def test_it_is_enough_that_a_third_of_the_frames_fit_elsewhere():
    for each, verdict in ((3, MOVED), (4, f"after {CHANGED}")):
        told = Told()
        told(*[0.03] * 30)
        found = []
        for i in range(12):
            told.moved = i % each == 0
            found.append(told.one(0.6, 100, "camera"))
        assert found[10] == verdict


def test_a_camera_that_was_moved_may_be_believed_after_a_stated_time():
    told = Told(moved=True, moved_s=2)
    assert told(*[0.03] * 30, *[0.6] * 22)[30:] == [CHANGED] * 10 + [MOVED] * 10 + [f"after {MOVED}", ""]


def test_what_cannot_be_compared_passes_unless_frames_are_in_doubt():
    told = Told()
    assert told(*[None] * 5, *[0.03] * 30) == [""] * 35
    assert told(0.6, None, 0.6, None, *[0.6] * 8) == [CHANGED] * 10 + [f"after {CHANGED}", ""]
    assert told(None, 0.03, None) == [""] * 3


def test_each_sensor_is_for_itself_and_there_are_so_many():
    told = Told()
    told(*[0.03] * 30, sensor="left")
    assert told(0.3, sensor="right") == [""]
    assert told(0.3, sensor="left") == [CHANGED]
    for i in range(2 * MAX_SENSORS):
        told(0.9, sensor=str(i))
    assert len(told.history.doubts) == MAX_SENSORS


def test_a_doubt_ends_where_the_gate_lets_a_sensor_begin_anew():
    """A map that is gone on with elsewhere, or later, must not refuse what it has never seen."""
    mapper = sv.Mapper(voxel_size=0.1, **{"trust.settle_s": 0.5})
    frames = list(sv.open_source("sim:room?image_width=160", frames=":30"))
    for frame in frames:
        mapper.add(frame)
    mapper.map.history.doubts["camera"] = Doubt(0, frames[-1].stamp_ns, 40, 40, "moved")
    far = np.eye(4)
    far[0, 3] = 300.0
    found = [
        mapper.add(replace(frame, T_world_sensor=far @ frame.T_world_sensor, stamp_ns=frame.stamp_ns + 10**9)).refused
        for frame in frames
    ]
    assert found[0] == "pose_jump"
    assert found[-1] is None
    assert mapper.map.history.doubts == {}


def test_a_camera_is_not_taken_for_moved_for_ever():
    told = Told(moved=True)
    found = told(*[0.03] * 30, *[0.6, None] * 60)[30:]
    assert set(found[12:48]) == {MOVED}
    assert f"after {MOVED}" in found
    assert set(found[-5:]) == {""}
