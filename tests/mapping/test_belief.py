# SPDX-License-Identifier: Apache-2.0
"""Frames that contradict the map: refused until they agree, or show from several places that the world has changed."""

import json
from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.mapping.disagreement import LOOKS, MAX_LIMIT, SPREADS, USUAL_AT_FIRST, DisagreementMonitor, Sight
from stereovox.maps.record.glance import SIDE, Glance, Votes
from stereovox.maps.record.history import MAX_SENSORS, DisagreementSpell, History, RunningMean, StampedPose

FRAME = sv.Frame(np.ones((2, 2), np.float32), sv.PinholeCamera(2, 2, 1, 1, 0.5, 0.5), np.eye(4))
GLANCE = Glance.at(np.array([[0.5, 0.2, 2.0]]), np.eye(4))
WORLD = Sight(0.7, "", 100, 0, Votes(world=80, sensor=5, neither=5), GLANCE)
"""What contradicts the map stays where it is in the world, seen from elsewhere."""
STILL = WORLD._replace(votes=Votes(both=100))
FIXED = WORLD._replace(votes=Votes(world=10, sensor=60))
RESTLESS = WORLD._replace(votes=Votes(world=20, neither=60))
BEHIND = STILL._replace(behind=200)
ELSEWHERE = WORLD._replace(anchored=0.4)
MOVED_SIGHT = WORLD._replace(fault="moved")
SCALED = WORLD._replace(fault="seen with depths x 1.2")
AGREES = WORLD._replace(anchored=0.97)


class Told:
    """A monitor that judges frame by frame; its history is saved and loaded before each frame."""

    def __init__(self, sight=WORLD, **trust):
        self.config = load_config(voxel_size=0.1, **{f"trust.{name}": value for name, value in trust.items()})
        self.history, self.sight, self.asked, self.now = History(), sight, 0, 0

    def __call__(self, *shares, ms=100, sensor="camera"):
        """Return what becomes of one frame after the other, `ms` apart: "", why it was refused, or "after ..."."""
        return [self.one(share, ms, sensor) for share in shares]

    def one(self, against, ms, sensor):
        self.now += ms * 1_000_000
        self.history = History.loaded(json.loads(json.dumps(self.history.saved())))
        monitor = DisagreementMonitor(self.config, self.history)
        doubted = monitor.in_doubt(sensor, self.now, against)
        self.asked += doubted
        try:
            agreement = monitor.check(FRAME, sensor, self.now, against, self.sight if doubted else None)
        except FrameRefused as refused:
            self.detail = str(refused)
            return refused.reason
        monitor.accept(sensor, agreement)
        return f"after {agreement.after}" if agreement.after else ""


DISAGREES, CONTRADICTS, MOVED = "disagrees_with_map", "contradicts_map", "camera_moved"


def test_a_frame_may_disagree_as_much_as_usual_and_some_more():
    told = Told()
    assert told(*[0.03] * 40) == [""] * 40
    assert told.history.usual["camera"] == pytest.approx((0.03, 0), abs=1e-3)
    limit = DisagreementMonitor(told.config, told.history).limit("camera", 0)
    assert limit == pytest.approx(0.03 + told.config.trust.max_disagreement, abs=1e-3)
    assert told(limit - 0.001) == [""]
    assert told(0.3, 0.03, 0.03) == [DISAGREES, "", ""]


def test_at_first_nothing_is_known_of_what_is_usual():
    assert Told()(2 * USUAL_AT_FIRST.mean - 0.01) == [""]
    assert Told()(2 * USUAL_AT_FIRST.mean + 0.01) == [DISAGREES]


def test_where_frames_disagree_now_more_and_now_less_a_frame_may_as_well():
    told = Told()
    assert told(*[0.1, 0.3] * 20) == [""] * 40
    mean, spread = told.history.usual["camera"]
    assert (mean, spread) == (pytest.approx(0.2, abs=0.03), pytest.approx(0.1, abs=0.03))
    assert told(mean + SPREADS * spread - 0.01) == [""]
    assert Told()(*[0.2] * 40, mean + SPREADS * spread - 0.01)[-1] == DISAGREES


def test_small_cells_disagree_by_small_errors_of_the_pose():
    fine = load_config(voxel_size=0.02, **{"trust.pose_error_m": 0.006})
    history = History(usual={"camera": RunningMean(0.05, 0.0)})
    assert DisagreementMonitor(fine, history).limit("camera", 0) == pytest.approx(0.35)
    noisy = History(usual={"camera": RunningMean(0.7, 0.0)})
    assert DisagreementMonitor(fine, noisy).limit("camera", 0) == MAX_LIMIT


def test_a_changed_world_that_is_seen_from_several_places_is_believed_after_a_second():
    told = Told()
    assert told(*[0.03] * 30, *[0.6] * 12) == [""] * 30 + [DISAGREES] * 10 + [f"after {DISAGREES}", ""]
    assert told.asked == 12
    assert told.history.usual["camera"].mean < 0.05  # what had to be believed is not usual
    assert told(0.03, 0.6) == ["", DISAGREES]  # it agreed again: from here on the second starts anew


FAULTY = {"fixed": FIXED, "restless": RESTLESS, "elsewhere": ELSEWHERE, "scaled": SCALED, "still": STILL}


@pytest.mark.parametrize("sight", FAULTY.values(), ids=list(FAULTY))
def test_time_alone_is_no_evidence(sight):
    told = Told(sight)
    assert told(*[0.03] * 30, *[0.6] * 300)[30:] == [DISAGREES] * 10 + [CONTRADICTS] * 290
    assert told(None) == [CONTRADICTS]  # if nothing is known it is not believed either
    assert told(0.03, 0.03) == ["", ""]
    assert told.history.doubts == {}


def test_the_refusal_says_what_helps():
    for sight, words in ((STILL, "move the sensor"), (FIXED, "clean"), (ELSEWHERE, "new map"), (SCALED, "x 1.2")):
        told = Told(sight)
        told(*[0.03] * 30, *[0.6] * 12)
        assert words in told.detail


def test_a_look_that_shows_no_changed_world_makes_the_looks_begin_anew():
    for sight, again in ((STILL, ["", ""]), (RESTLESS, [CONTRADICTS, CONTRADICTS])):
        told = Told()
        told(*[0.03] * 30, *[0.6] * 9)
        told.sight = sight
        told(0.6)
        told.sight = WORLD
        assert [one.removeprefix(f"after {DISAGREES}") for one in told(0.6, 0.6)] == again


def test_a_fault_after_a_change_is_refused():
    told = Told()
    assert told(*[0.03] * 30, *[0.6] * 12)[-1] == ""
    told.sight = SCALED
    assert told(0.6, 0.6) == [CONTRADICTS] * 2
    told.sight = WORLD
    assert told(*[0.6] * LOOKS) == [CONTRADICTS] * (LOOKS - 1) + [f"after {CONTRADICTS}"]


def test_what_is_gone_is_believed_where_known_surfaces_are_seen_behind_it():
    assert Told(BEHIND)(*[0.03] * 30, *[0.6] * 12)[-2:] == [f"after {DISAGREES}", ""]
    few = BEHIND._replace(behind=100)
    assert Told(few)(*[0.03] * 30, *[0.6] * 12)[-1] == CONTRADICTS


def test_a_frame_that_agrees_ends_the_waiting():
    told = Told()
    assert told(*[0.03] * 30, *[0.6] * 9, 0.03, *[0.6] * 9)[30:] == [DISAGREES] * 9 + [""] + [DISAGREES] * 9


def test_how_long_is_a_setting():
    assert Told(changed_s=0.6)(*[0.03] * 30, *[0.6] * 7)[30:] == [DISAGREES] * 6 + [f"after {DISAGREES}"]
    found = Told(changed_s=0)(*[0.03] * 30, *[0.6] * LOOKS)[30:]
    assert found == [CONTRADICTS] * (LOOKS - 1) + [f"after {CONTRADICTS}"]


def test_a_frame_that_comes_late_may_disagree_more():
    told = Told()
    told(*[0.03] * 40)
    told.history.trusted["camera"] = StampedPose(told.now, (0.0,) * 12)
    early, late = (
        DisagreementMonitor(told.config, told.history).limit("camera", told.now + ms * 1_000_000) for ms in (200, 1200)
    )
    assert late - 0.03 == pytest.approx(2 * (early - 0.03), rel=1e-2)
    assert DisagreementMonitor(told.config, told.history).limit("camera", told.now + 10**12) == late
    told.history.doubts["camera"] = DisagreementSpell(told.now, told.now + 10**9)
    assert DisagreementMonitor(told.config, told.history).limit("camera", told.now + 1_200_000_000) == early
    told.history.trusted["camera"] = StampedPose(told.now + 3 * 10**9, (0.0,) * 12)  # nothing is known of what it saw
    assert DisagreementMonitor(told.config, told.history).limit("camera", told.now + 3_200_000_000) == early


def test_a_few_frames_are_not_enough_however_long_they_take():
    found = Told()(*[0.03] * 30, *[0.6] * LOOKS, ms=2000)[30:]
    assert found == [DISAGREES, *[CONTRADICTS] * (LOOKS - 2), f"after {CONTRADICTS}"]


def test_frames_without_times_count_thirty_a_second():
    told = Told()
    found = told(*[0.03] * 40, *[0.6] * 32, ms=0)[40:]
    assert found == [DISAGREES] * 30 + [f"after {DISAGREES}", ""]


def test_a_clock_that_goes_back_does_not_end_the_waiting():
    told = Told()
    told(*[0.03] * 30, *[0.6] * 5)
    told.now -= 10**12
    assert told.one(0.6, 100, "camera") == DISAGREES


def test_a_camera_that_was_moved_is_not_believed_until_it_agrees():
    told = Told(MOVED_SIGHT)
    assert told(*[0.03] * 30, *[0.6] * 300)[30:] == [DISAGREES] * 10 + [MOVED] * 290
    assert "calibrate" in told.detail
    assert told(0.03, 0.03) == ["", ""]


def test_it_is_enough_that_a_sixth_of_the_frames_fit_elsewhere():
    for each, verdict in ((5, MOVED), (12, CONTRADICTS)):
        told = Told()
        told(*[0.03] * 30)
        found = []
        for i in range(12):
            told.sight = STILL if i % each else MOVED_SIGHT
            found.append(told.one(0.6, 100, "camera"))
        assert found[10] == verdict


def test_a_camera_that_was_moved_may_be_believed_after_a_stated_time():
    told = Told(MOVED_SIGHT, moved_s=2)
    assert told(*[0.03] * 30, *[0.6] * 22)[30:] == [DISAGREES] * 10 + [MOVED] * 10 + [f"after {MOVED}", ""]


def test_what_cannot_be_compared_passes_unless_frames_are_in_doubt():
    told = Told(WORLD._replace(anchored=None))
    assert told(*[None] * 5, *[0.03] * 30) == [""] * 35
    assert told(0.6, None, 0.6, None) == [DISAGREES] * 4
    told.sight = WORLD
    assert told(*[0.6] * 8)[-2:] == [f"after {DISAGREES}", ""]
    assert told(None, 0.03, None) == [""] * 3


def test_a_frame_nearly_all_of_which_is_where_it_was_ends_a_doubt_that_has_lasted():
    told = Told(AGREES)
    assert told(*[0.03] * 30, *[0.6] * 3, None)[30:] == [DISAGREES] * 3 + [""]  # each alone, and none after them
    told = Told(STILL)
    told(*[0.03] * 30, *[0.6] * 20)
    told.sight = AGREES._replace(fault="mirrored")
    assert told(None, 0.6) == [CONTRADICTS] * 2
    told.sight = AGREES
    assert told(None) == [""]
    assert told.history.doubts == {}


def test_each_sensor_is_for_itself_and_there_are_so_many():
    told = Told()
    told(*[0.03] * 30, sensor="left")
    assert told(0.3, sensor="right") == [""]
    assert told(0.3, sensor="left") == [DISAGREES]
    for i in range(2 * MAX_SENSORS):
        told(0.9, sensor=str(i))
    assert len(told.history.doubts) == MAX_SENSORS


def test_a_doubt_ends_where_the_gate_lets_a_sensor_begin_anew():
    """A map that is continued elsewhere, or later, must not refuse unknown space."""
    mapper = sv.Mapper(voxel_size=0.1, **{"trust.settle_s": 0.5})
    frames = list(sv.open_source("sim:room?image_width=160", frames=":30"))
    for frame in frames:
        mapper.add(frame)
    mapper.map.history.doubts["camera"] = DisagreementSpell(0, frames[-1].stamp_ns, 40, 40, "moved")
    far = np.eye(4)
    far[0, 3] = 300.0
    found = [
        mapper.add(replace(frame, T_world_sensor=far @ frame.T_world_sensor, stamp_ns=frame.stamp_ns + 10**9)).refused
        for frame in frames
    ]
    assert found[0] == "pose_jump"
    assert found[-1] is None
    assert mapper.map.history.doubts == {}


def saved(told):
    return told.history.saved()["history"]["doubts"]["camera"]


@pytest.mark.parametrize("ranges", ["", "x", "AAAA", 3, None, Glance((0.0,) * 12, bytes(2)).packed()])
def test_a_saved_glance_that_is_none_is_refused(ranges):
    told = Told()
    told(*[0.03] * 30, 0.6)
    whole = told.history.saved()
    assert History.loaded(whole) == told.history
    saved(told)  # as it is, it can be read
    whole["history"]["doubts"]["camera"]["glance"]["ranges"] = ranges
    with pytest.raises((ValueError, TypeError)):
        History.loaded(whole)


def test_a_glance_that_unpacks_to_much_is_not_unpacked_whole():
    bomb = Glance((0.0,) * 12, bytes(10**8)).packed()
    with pytest.raises(ValueError, match="distances"):
        Glance.unpacked((0.0,) * 12, bomb)
    not_finite = Glance((0.0,) * 12, np.full(SIDE * SIDE, np.nan, np.float16).tobytes()).packed()
    with pytest.raises(ValueError, match="distances"):
        Glance.unpacked((0.0,) * 12, not_finite)
