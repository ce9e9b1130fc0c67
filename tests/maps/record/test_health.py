# SPDX-License-Identifier: Apache-2.0
"""The age of a map, by a clock that the tests control: current, stale after half a second, lost after five."""

import json

import numpy as np
import pytest

import stereovox as sv
from stereovox.frame import Scan
from stereovox.mapper import GridMapper
from stereovox.maps.record.health import Health

CAMERA = sv.PinholeCamera(16, 12, 12.0, 12.0, 7.5, 5.5, 0.05)
POSE = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
S = 1_000_000_000


class Clock:
    """Nanoseconds that pass when the test says so; they start anywhere."""

    def __init__(self):
        self.ns = 7 * S

    def __call__(self):
        return self.ns

    def wait(self, seconds):
        self.ns += round(seconds * S)


def mapper_and_clock(**settings):
    clock = Clock()
    mapper = sv.Mapper(voxel_size=0.25, max_range=3.0, clock=clock, **settings)
    mapper.map.history.unconfirmed = 0  # these are about time; see test_first_frame
    return mapper, clock


def frame(**changes):
    return sv.Frame(np.full((12, 16), 2.0, np.float32), CAMERA, POSE, **changes)


def test_a_map_waits_until_the_first_frame_that_can_be_trusted():
    mapper, clock = mapper_and_clock()
    assert mapper.health() == Health("waiting", None, {}, None, 0, {}, {}, "waiting: no trusted frame yet")
    mapper.add(frame(fault="no_pose"))
    clock.wait(60)
    assert mapper.health().state == "waiting"
    mapper.add(frame(stamp_ns=3 * S))
    health = mapper.health()
    assert (health.state, health.age_s, health.ages_s, health.stamp_ns) == ("current", 0.0, {"camera": 0.0}, 3 * S)


@pytest.mark.parametrize(
    ("seconds", "state"),
    [(0.0, "current"), (0.5, "current"), (0.500000001, "stale"), (5.0, "stale"), (5.000000001, "lost"), (1e6, "lost")],
)
def test_the_first_question_after_half_a_second_is_answered_stale_and_after_five_lost(seconds, state):
    mapper, clock = mapper_and_clock()
    mapper.add(frame())
    clock.wait(seconds)
    health = mapper.health()
    assert (health.state, health.age_s) == (state, pytest.approx(seconds))
    assert health.text.startswith(f"{state}: last trusted frame {seconds:.2f} s ago")
    mapper.add(frame())
    assert mapper.health().age_s == 0


def test_limits_are_settings_and_the_time_may_be_told():
    mapper, clock = mapper_and_clock(**{"trust.stale_s": 2.0, "trust.lost_s": 3.0})
    mapper.add(frame())
    states = [mapper.health(clock.ns + round(s * S)).state for s in (1.9, 2.1, 2.9, 3.1)]
    assert states == ["current", "stale", "stale", "lost"]


def test_refused_frames_do_not_keep_a_map_current_and_are_told_for_a_while():
    mapper, clock = mapper_and_clock()
    for i in range(4):
        clock.wait(0.1)
        mapper.add(frame(stamp_ns=i))
    for _ in range(6):
        clock.wait(0.1)
        mapper.add(frame(fault="no_pose"))
    health = mapper.health()
    assert (health.state, health.age_s) == ("stale", pytest.approx(0.6))
    assert (health.frames, health.refused, health.refused_share) == (10, {"no_pose": 6}, 0.6)
    assert "6 of 10 frames refused (6 x no_pose)" in health.text
    mapper.add(frame(stamp_ns=9))
    assert mapper.health().state == "degraded"
    clock.wait(4.9)
    mapper.add(frame(stamp_ns=9))
    assert mapper.health().state == "degraded"
    clock.wait(0.2)  # the last refusal is 5.1 s ago
    assert mapper.health().state == "current"


def test_a_sensor_that_falls_silent_degrades_the_map():
    mapper, clock = mapper_and_clock()
    for i in range(12):
        clock.wait(0.1)
        mapper.add(frame(sensor="left", stamp_ns=i))
        if i < 4:
            mapper.add(frame(sensor="right", stamp_ns=i))
    health = mapper.health()
    assert health.state == "degraded"
    assert health.ages_s == pytest.approx({"left": 0.0, "right": 0.8})
    assert "sensor 'right' silent for 0.80 s" in health.text


def test_frames_looked_at_less_thoroughly_degrade_the_map(monkeypatch):
    mapper, clock = mapper_and_clock()
    mapper.add(frame())
    level = mapper._deadline.quality()
    monkeypatch.setattr(level, "name", "near")
    monkeypatch.setattr(mapper._deadline, "quality", lambda: level)
    clock.wait(0.1)
    assert mapper.add(frame()).quality == "near"
    health = mapper.health()
    assert (health.state, health.reduced) == ("degraded", {"near": 1})
    assert "1 of 2 frames mapped at reduced quality (1 x near)" in health.text
    assert mapper.map.history.quality == {"full": 1, "near": 1}


def test_the_frame_counts_from_when_it_came_not_from_when_it_was_done(monkeypatch):
    mapper, clock = mapper_and_clock()
    add = mapper.map.add
    monkeypatch.setattr(mapper.map, "add", lambda evidence: (clock.wait(0.3), add(evidence))[1])
    mapper.add(frame())
    assert mapper.health().age_s == pytest.approx(0.3)


def test_as_plain_values_for_json():
    mapper, _ = mapper_and_clock()
    mapper.add(frame(stamp_ns=5))
    mapper.add(frame(fault="no_pose"))
    told = json.loads(json.dumps(mapper.health().as_dict()))
    assert told == {
        "state": "degraded",
        "age_s": 0.0,
        "ages_s": {"camera": 0.0},
        "stamp_ns": 5,
        "frames": 2,
        "refused": {"no_pose": 1},
        "reduced": {},
        "text": "degraded: last trusted frame 0.00 s ago; 1 of 2 frames refused (1 x no_pose)",
        "refused_share": 0.5,
    }


def scan():
    return Scan(np.full(40, 2.0, np.float32), -0.5, 0.025, 0.1, 5.0, np.eye(4), stamp_ns=11)


def grid_and_clock():
    clock = Clock()
    mapper = GridMapper("ist2019", clock=clock)
    mapper.map.history.unconfirmed = 0  # as above
    return mapper, clock


def test_a_floors_map_has_the_same_states():
    mapper, clock = grid_and_clock()
    assert mapper.health().state == "waiting"
    mapper.add(scan())
    assert (mapper.health().state, mapper.health().ages_s) == ("current", {"scan": 0.0})
    clock.wait(0.6)
    assert mapper.health().state == "stale"
    mapper.add(Scan(np.full(40, np.nan, np.float32), -0.5, 0.025, 0.1, 5.0, np.eye(4)))
    assert mapper.health().refused == {"no_valid_range": 1}
    clock.wait(4.5)
    assert mapper.health().state == "lost"


def test_the_reasons_told_add_up():
    mapper, _ = mapper_and_clock()
    for fault in ("a", "a", "b", "b", "c", "c", "d", "e"):
        mapper.add(frame(fault=fault))
    assert "8 of 8 frames refused (2 x a, 2 x b, 2 x c, 2 x other)" in mapper.health().text


@pytest.mark.parametrize("make", [mapper_and_clock, grid_and_clock], ids=["space", "floor"])
@pytest.mark.parametrize("back_s", [0.4, 30.0, 3600.0])
def test_a_clock_that_is_set_back_makes_no_map_current(make, back_s):
    mapper, clock = make()
    seen = frame() if isinstance(mapper, sv.Mapper) else scan()
    mapper.add(seen)
    clock.wait(0.3)
    assert mapper.health().state == "current"
    clock.wait(-back_s)
    assert mapper.health().age_s == pytest.approx(0.3)
    assert mapper.health(clock.ns + round(0.1 * S)).age_s == pytest.approx(0.4)
    ages = []
    for _ in range(4):
        clock.wait(1.7)
        ages.append(mapper.health())
    assert [one.state for one in ages] == ["stale", "stale", "lost", "lost"]
    assert [one.age_s for one in ages] == pytest.approx([2.0, 3.7, 5.4, 7.1])
    clock.wait(-back_s)  # and once more, between two frames that nobody asked about
    assert mapper.add(seen).refused is None
    assert (mapper.health().state, mapper.health().age_s) == ("current", 0.0)
    clock.wait(5.5)
    assert mapper.health().state == "lost"


def test_a_clock_that_is_put_forward_makes_a_map_old_until_the_next_frame():
    mapper, clock = mapper_and_clock()
    mapper.add(frame())
    clock.wait(3600)
    assert mapper.health().state == "lost"
    mapper.add(frame())
    assert mapper.health().state == "current"
    assert mapper.health().frames == 1
