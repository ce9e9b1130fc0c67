# SPDX-License-Identifier: Apache-2.0
"""Which frames fit the earlier ones: each reason, reacceptance, and that refusals change nothing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stereovox as sv
from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.geometry.se3 import rotation_matrix
from stereovox.mapper import GridMapper
from stereovox.mapping.gate import Gate
from stereovox.maps.grid_map import load_grid
from stereovox.maps.record.history import MAX_SENSORS, History

CAMERA = sv.PinholeCamera(16, 12, 12.0, 12.0, 7.5, 5.5, 0.05)
AHEAD = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
MS = 1_000_000
FRAME_MS = 33


def frame_at(ms, x=0.0, yaw_deg=0.0, **changes):
    """A wall two metres before a camera at (x, 0, 0) that faces along x, turned to the left."""
    T = AHEAD.copy()
    T[:3, :3] = rotation_matrix([0, 0, np.radians(yaw_deg)]) @ T[:3, :3]
    T[0, 3] = x
    return sv.Frame(np.full((12, 16), 2.0, np.float32), CAMERA, T, **{"stamp_ns": round(ms * MS), **changes})


def verdicts(frames, **trust):
    """Return why each frame was refused, or after what it was accepted again, or ""."""
    history = History()
    trust = {"frozen": False, **trust}  # which looks at prepared images; see test_frozen.py
    gate, told = Gate(load_config(**{f"trust.{name}": value for name, value in trust.items()}), history), []
    for frame in frames:
        try:
            passed = gate.check(frame, frame)
        except FrameRefused as refused:
            told.append(refused.reason)
            continue
        gate.accept(passed)
        told.append(f"after {passed.after}" if passed.after else "")
    return told


def test_frames_in_order_pass():
    assert verdicts([frame_at(FRAME_MS * i, 0.5 * i, 20 * i) for i in range(20)]) == [""] * 20


def test_recordings_without_stamps_pass_wherever_they_are():
    assert verdicts([frame_at(0, x) for x in (0, 100, -500, 0)]) == [""] * 4


def test_a_stamp_that_goes_back_is_refused_and_changes_nothing_for_the_next():
    assert verdicts([frame_at(ms) for ms in (100, 66, 133, 133, 132)]) == [
        "",
        "stamp_backwards",
        "",
        "",
        "stamp_backwards",
    ]


def test_each_sensor_has_its_own_time_and_place():
    frames = [frame_at(100, sensor="left"), frame_at(50, 300, sensor="right"), frame_at(150, sensor="left")]
    assert verdicts([*frames, frame_at(40, 300, sensor="right")]) == ["", "", "", "stamp_backwards"]


@pytest.mark.parametrize(
    ("later", "why"),
    [
        (frame_at(100 - 999, 0), "stamp_backwards"),
        (frame_at(100 - 1001, 0), "clock_reset"),
        (frame_at(100 + 3_600_001, 0), "clock_reset"),
        (frame_at(100 + 3_599_999, 0), ""),
        (frame_at(133, 1.36), ""),
        (frame_at(133, 1.38), "pose_jump"),  # 33 ms at 40 m/s are 1.32 m, and 5 cm are none
        (frame_at(133, 0, 51), ""),
        (frame_at(133, 0, 52), "pose_jump"),  # 33 ms at 1500 deg/s are 49.5 degrees, and 2 are none
        (frame_at(133, 0, 180), "pose_jump"),
        (frame_at(133, pose_off_ns=50 * MS), ""),
        (frame_at(133, pose_off_ns=51 * MS), "pose_extrapolated"),
        (frame_at(133, pose_off_ns=-51 * MS), "pose_extrapolated"),
        (frame_at(0, stamp_ns=np.int64(133 * MS)), ""),
        (frame_at(133, sensor="x" * 300), "bad_sensor"),
        (frame_at(133, sensor="two\nlines"), "bad_sensor"),
    ],
)
def test_each_reason_at_its_limit(later, why):
    assert verdicts([frame_at(100), later]) == ["", why]


def test_without_order_stamps_may_go_anywhere():
    frames = [frame_at(100), frame_at(50, 30), frame_at(-(10**7), 60), frame_at(10**10, 60), frame_at(10**10 + 33, 90)]
    assert verdicts(frames, ordered=False) == ["", "", "", "", "pose_jump"]


def test_one_outlier_is_refused_and_those_after_it_pass():
    frames = [frame_at(FRAME_MS * i, 5.0 if i == 3 else 0.1 * i) for i in range(8)]
    assert verdicts(frames) == ["", "", "", "pose_jump", "", "", "", ""]


@pytest.mark.parametrize("metres", [2.0, 30.0])
def test_a_tracker_that_found_itself_elsewhere_is_believed_after_a_second(metres):
    """However small the jump: that the distance could have been travelled meanwhile does not count."""
    frames = [frame_at(100 * i, 0.1 * i + metres * (i >= 5)) for i in range(20)]
    found = verdicts(frames, max_speed_mps=10.0)
    assert found == [""] * 5 + ["pose_jump"] * 10 + ["after pose_jump"] + [""] * 4


def test_a_clock_that_starts_anew_is_believed_after_a_second():
    frames = [frame_at(10**9 + 100 * i) for i in range(3)] + [frame_at(100 * i) for i in range(14)]
    assert verdicts(frames) == [""] * 3 + ["clock_reset"] * 10 + ["after clock_reset"] + [""] * 3


def test_frames_that_do_not_agree_never_settle():
    frames = [frame_at(0), *(frame_at(100 * i, 50.0 * (i % 3)) for i in range(1, 40))]
    found = verdicts(frames)
    assert set(found[1:]) == {"", "pose_jump"}
    assert [not why for why in found[1:]] == [i % 3 == 0 for i in range(1, 40)]


def test_waiting_ends_where_a_frame_fits_again():
    """Nine tenths of a second elsewhere, one frame back, and elsewhere again: the second starts anew."""
    x = [0] + [100] * 9 + [0] + [100] * 9 + [0]
    found = verdicts([frame_at(100 * i, here) for i, here in enumerate(x)])
    assert found == ["", *["pose_jump"] * 9, "", *["pose_jump"] * 9, ""]


def test_settling_may_be_switched_off():
    assert verdicts([frame_at(0), frame_at(33, 100), frame_at(66, 100)], settle_s=0) == ["", "after pose_jump", ""]


def test_one_map_knows_so_many_sensors():
    frames = [frame_at(0, sensor=str(i)) for i in range(MAX_SENSORS + 1)]
    assert verdicts(frames) == [""] * MAX_SENSORS + ["bad_sensor"]
    assert verdicts([*frames[:MAX_SENSORS], frame_at(33, sensor="3")])[-1] == ""


# The law: what is refused leaves the map as it is, and a run may stop and go on anywhere.


class SlowGate:
    """The same rules for single frames, written plainly in NumPy; its memory is a plain dict."""

    def __init__(self):
        self.trusted, self.streak = None, None

    @staticmethod
    def problem(before, frame):
        """Return why a frame cannot follow, and how many times the allowed speed it needs."""
        seconds = (frame.stamp_ns - before.stamp_ns) / 1e9
        if seconds < -1 or seconds > 3600:
            return "clock_reset", np.inf
        if seconds < 0:
            return "stamp_backwards", np.inf
        if seconds == 0:
            return "", 0.0
        T = np.linalg.inv(before.T_world_sensor) @ frame.T_world_sensor
        metres = np.linalg.norm(T[:3, 3])
        degrees = np.degrees(np.arccos(np.clip((np.trace(T[:3, :3]) - 1) / 2, -1, 1)))
        times = max((metres - 0.05) / 40, (degrees - 2) / 1500) / seconds
        return ("pose_jump" if times > 1 else ""), times

    def verdict(self, frame):
        if abs(frame.pose_off_ns) > 50 * MS:
            return "pose_extrapolated"
        if self.trusted is None:
            self.trusted = frame
            return ""
        why, times = self.problem(self.trusted, frame)
        joins = False
        if self.streak:
            other, other_times = self.problem(self.streak[-1], frame)
            joins = other == "" and (why != "" or other_times < times)
        if not why and not joins:
            self.trusted, self.streak = frame, None
            return ""
        if not joins and why == "stamp_backwards":
            return why
        if not joins:
            self.streak, self.why = [], why
        self.streak.append(frame)
        if frame.stamp_ns - self.streak[0].stamp_ns >= 1e9:
            self.trusted, self.streak = frame, None
            return ""
        return self.why


steps_ms = st.sampled_from([0, 33, 33, 33, 400, -5, -700, -5000, 4_000_000])
places = st.sampled_from([0.0, 0.0, 0.0, 0.3, 3.0, 3.0, 60.0])
turns = st.sampled_from([0.0, 0.0, 0.0, 10.0, 170.0])
offs = st.sampled_from([0, 0, 0, 0, 0, 60 * MS])
flights = st.lists(st.tuples(steps_ms, places, turns, offs), min_size=2, max_size=25)


def flown(flight):
    ms = np.cumsum([step for step, _, _, _ in flight]).tolist()
    return [frame_at(t, x, yaw, pose_off_ns=off) for t, (_, x, yaw, off) in zip(ms, flight, strict=True)]


@settings(max_examples=300, deadline=None)
@given(flights)
def test_the_gate_decides_as_the_slow_one(flight):
    slow = SlowGate()
    assert [why if why[:5] != "after" else "" for why in verdicts(flown(flight))] == [
        slow.verdict(frame) for frame in flown(flight)
    ]


def state_of(voxel_map):
    """Everything that a refused frame must not change."""
    coords, cells = voxel_map.storage.blocks()
    view = voxel_map.viewpoint
    pose = None if view is None else (view.T_world_camera.tobytes(), view.stamp_ns)
    return coords.tobytes(), cells.tobytes(), pose, repr(voxel_map.storage.window_state)


SETTINGS = {"voxel_size": 0.25, "max_range": 3.0}
WINDOW = {**SETTINGS, "window.size": [8.0, 8.0, 4.0]}


@pytest.mark.parametrize("given_settings", [SETTINGS, WINDOW])
@settings(max_examples=25, deadline=None)
@given(flight=flights, stops=st.sets(st.integers(1, 24), max_size=3))
def test_refusals_change_no_bit_and_a_run_may_be_split_anywhere(tmp_path_factory, given_settings, flight, stops):
    folder = tmp_path_factory.mktemp("split")
    whole, parts = sv.Mapper(**given_settings), sv.Mapper(**given_settings)
    for i, frame in enumerate(flown(flight)):
        before = state_of(whole.map)
        report = whole.add(frame)
        if report.refused:
            assert state_of(whole.map) == before
        if i in stops:
            parts.map.save(folder / "map")
            parts.map.close()
            parts = sv.Mapper(**given_settings, resume=sv.load_map(folder / "map"))
        assert parts.add(frame).refused == report.refused
    assert state_of(parts.map) == state_of(whole.map)
    assert parts.map.history == whole.map.history
    assert whole.map.frames + whole.map.frames_refused == len(flight)


def scan_at(ms, x=0.0, **changes):
    T = np.eye(4)
    T[0, 3] = x
    return Scan(np.full(40, 2.0, np.float32), -0.5, 0.025, 0.1, 5.0, T, **{"stamp_ns": round(ms * MS), **changes})


def test_scans_go_through_the_same_gate_and_a_camera_beside_them_has_its_own_time(tmp_path):
    mapper = GridMapper("ist2019", **{"scan.off_level_deg": 3})
    level = frame_at(90, 0.0)
    level.T_world_sensor[2, 3] = 0.5
    assert mapper.add(scan_at(100)).refused is None
    assert mapper.add(level).refused is None  # earlier than the scan, but of another sensor
    before = mapper.map.occupancy().cells.tobytes()
    assert mapper.add(scan_at(50)).refused == "stamp_backwards"
    assert mapper.add(scan_at(133, 20.0)).refused == "pose_jump"
    assert mapper.add(scan_at(133, pose_off_ns=10**9)).refused == "pose_extrapolated"
    assert mapper.map.occupancy().cells.tobytes() == before
    mapper.map.save(tmp_path / "grid.npz")
    again = load_grid(tmp_path / "grid.npz")
    assert again.history == mapper.map.history
    assert again.frames_refused == 3
    assert GridMapper(mapper.config, resume=again).add(scan_at(166, 20.0)).refused == "pose_jump"


def test_a_floors_run_may_be_split_anywhere(tmp_path):
    ms = [0, 100, 50, 200, 300, 400, 800, 1200, 1500, -9000, -8900, -8000, -7800, 1600]
    x = [0, 0.1, 0.2, 0.2, 9, 9, 9, 9, 9, 9, 9, 9, 9, 9]
    whole, parts = GridMapper("ist2019"), GridMapper("ist2019")
    refused = []
    for scan in map(scan_at, ms, x):
        parts.map.save(tmp_path / "grid.npz")
        parts = GridMapper("ist2019", resume=load_grid(tmp_path / "grid.npz"))
        refused.append(whole.add(scan).refused)
        assert parts.add(scan).refused == refused[-1]
    jump, reset = "pose_jump", "clock_reset"
    assert refused == [None, None, "stamp_backwards", None, *[jump] * 4, None, *[reset] * 2, None, None, None]
    assert parts.map.history == whole.map.history
    assert all((a == b).all() for a, b in zip(parts.map.storage.tiles(), whole.map.storage.tiles(), strict=True))


def test_a_report_tells_that_frames_are_believed_again():
    mapper = sv.Mapper(**SETTINGS)
    reports = [mapper.add(frame_at(200 * i, 30.0 * (i > 2))) for i in range(10)]
    assert [report.refused for report in reports] == [None] * 3 + ["pose_jump"] * 5 + [None] * 2
    assert "jumped by 30 m and 0 degrees in 0.2 s" in reports[3].detail
    assert "pose_jump" in reports[8].detail
    assert reports[9].detail == ""
    assert mapper.map.history.settled == {"pose_jump": 1}
