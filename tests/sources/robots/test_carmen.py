# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: scans, odometry, mounts and times as written; damage is counted and named."""

import bz2
from pathlib import Path

import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry import se2
from stereovox.opening import open_robot
from stereovox.sources.robots.carmen import CarmenLog

DATA = Path(__file__).resolve().parents[4] / "shared/data/carmen"
HEAD = "# message_name [message contents] ipc_timestamp\nPARAM robot_frontlaser_offset 0.2 nohost 0\nSYNC x nohost 0\n"


def flaser(ranges, odometry=(1.0, 2.0, 0.5), stamp="10.250000", laser=(9.0, 9.0, 9.0)):
    words = ["FLASER", len(ranges), *ranges, *laser, *odometry, stamp, "nohost", "0.1"]
    return " ".join(map(str, words)) + "\n"


def robotlaser(ranges, laser, robot, stamp="11.5"):
    head = ["ROBOTLASER1", 0, -1.2, 2.4, 0.6, 20.0, 0.01, 0, len(ranges), *ranges, 2, 7, 8]
    return " ".join(map(str, [*head, *laser, *robot, 0.1, 0.2, 0, 0, 0, stamp, "host", "1.0"])) + "\n"


def log(tmp_path, text, name="drive.clf"):
    path = tmp_path / name
    path.write_bytes(bz2.compress(text.encode()) if name.lower().endswith(".bz2") else text.encode())
    return str(path)


@pytest.mark.parametrize("name", ["drive.clf", "drive.log", "drive.clf.bz2", "DRIVE.CLF.BZ2", "drive.log.bz2"])
def test_a_scan_is_what_the_line_says(tmp_path, name):
    ranges = [1.0 + 0.01 * i for i in range(180)]
    where = log(tmp_path, HEAD + "ODOM 0 0 0 0 0 0 9 nohost 0\n" + flaser(ranges), name)
    robot = open_robot(where)
    assert isinstance(robot, CarmenLog)
    assert robot.name == name.partition(".")[0]
    scan = robot.scans[0]
    assert len(robot.scans) == 1
    assert len(robot.frames) == 0
    assert robot.truth is None
    assert np.allclose(scan.ranges, ranges)
    assert scan.stamp_ns == 10_250_000_000
    assert np.allclose(scan.pose_world_base, [1.0, 2.0, 0.5])
    assert np.allclose(se2.flattened(scan.T_base_sensor), [0.2, 0, 0])
    assert np.allclose(se2.flattened(scan.T_world_sensor), se2.compose([1.0, 2.0, 0.5], [0.2, 0, 0]))


@pytest.mark.parametrize(("beams", "step", "last"), [(180, 1.0, 89), (181, 1.0, 90), (360, 0.5, 89.5), (361, 0.5, 90)])
def test_beams_are_those_of_a_sick(tmp_path, beams, step, last):
    scan = CarmenLog(log(tmp_path, flaser([2.0] * beams))).scans[0]
    assert np.degrees(scan.angles[0]) == pytest.approx(-90)
    assert np.degrees(scan.angle_step) == pytest.approx(step)
    assert np.degrees(scan.angles[-1]) == pytest.approx(last)


@pytest.mark.parametrize(
    ("far", "option", "infinite"),
    [
        ((30.0, 50.0), "?no_echo=free", [False, True]),
        ((30.0, 49.8), "?no_echo=free", [False, False]),
        ((50.5, 81.91), "?no_echo=free", [False, True]),
        ((30.0, 50.0), "?max_range=20&no_echo=free", [True, True]),
    ],
)
def test_ranges_that_mean_nothing_seen_are_infinite(tmp_path, far, option, infinite):
    robot = CarmenLog(log(tmp_path, flaser([1.0, 0.0, -1.0, "nan", *far])) + option)
    scan = robot.scans[0]
    assert np.isposinf(scan.ranges[4:]).tolist() == infinite
    assert np.isnan(scan.ranges[1:4]).all()
    assert scan.ranges[0] == 1
    assert scan.ranges[np.isfinite(scan.ranges)].max() < scan.range_max
    assert f"{scan.range_max:g} m" in robot.notes[0]


@pytest.mark.parametrize(("mark", "between", "known"), [(81.83, 30.0, False), (81.83, 70.0, True), (29.9, 20.0, False)])
def test_marks_of_no_echo_are_found_by_the_gap_below_them(tmp_path, mark, between, known):
    """A log whose driver writes a number of its own; what lies in the gap shows that these are distances."""
    text = "".join(flaser([1.0 + 0.1 * k % 20, between, *[mark] * 3, 5.0], stamp=f"1{k}.5") for k in range(10))
    robot = CarmenLog(log(tmp_path, text))
    assert np.isfinite(robot.scans[0].ranges).tolist() == [True, True, *[known] * 3, True]
    assert (f"ranges of {robot.scans[0].range_max:g} m and more are no echo" in robot.notes[0]) is True
    assert robot.scans[0].range_max < 82


def test_a_mark_of_no_echo_just_below_the_declared_range(tmp_path):
    line = robotlaser([1.0, 2.0, *[81.83] * 3], [0, 0, 0], [0, 0, 0]).replace(" 20.0 ", " 81.9 ")
    scan = CarmenLog(log(tmp_path, line * 10)).scans[0]
    assert np.isfinite(scan.ranges).tolist() == [True, True, False, False, False]
    far = robotlaser([1.0, 70.0, *[81.83] * 3], [0, 0, 0], [0, 0, 0]).replace(" 20.0 ", " 81.9 ")
    assert np.isfinite(CarmenLog(log(tmp_path, far * 10)).scans[0].ranges).all()


def test_without_an_echo_nothing_is_known_unless_one_says_so(tmp_path):
    path = log(tmp_path, flaser([1.0, 81.91]))
    assert np.isnan(CarmenLog(path).scans[0].ranges[1])
    assert "no echo: unknown" in CarmenLog(path).notes[0]
    with pytest.raises(SourceError, match="no_echo=maybe must be unknown or free"):
        CarmenLog(path + "?no_echo=maybe")


def test_the_new_format_tells_angles_and_mount(tmp_path):
    laser = se2.compose([1.0, -2.0, 0.3], [0.25, 0.1, 0.05])
    robot = CarmenLog(log(tmp_path, HEAD + robotlaser([1, 2, 25, 3, 4], laser, [1.0, -2.0, 0.3])))
    scan = robot.scans[0]
    assert np.allclose(scan.angles, [-1.2, -0.6, 0.0, 0.6, 1.2])
    assert np.allclose(se2.flattened(scan.T_base_sensor), [0.25, 0.1, 0.05])
    assert np.allclose(scan.pose_world_base, [1.0, -2.0, 0.3])
    assert np.isnan(scan.ranges[2])  # no echo
    assert scan.stamp_ns == 11_500_000_000


def test_scans_are_in_order_of_time_and_sliced(tmp_path):
    text = "".join(flaser([float(i)], stamp=f"{t}.0") for i, t in ((1, 12), (2, 10), (3, 11)))
    scans = CarmenLog(log(tmp_path, text)).scans
    assert [scan.stamp_ns for scan in scans] == [10 * 10**9, 11 * 10**9, 12 * 10**9]
    assert [float(scan.ranges[0]) for scan in scans[1:]] == [3.0, 1.0]
    assert scans[-1].ranges[0] == 1.0


DAMAGE = {
    "cut off": flaser([1.0] * 9)[:30] + "\n",
    "no number": flaser([1.0, "x"]),
    "no count": "FLASER many 1 2 3\n",
    "bare": "FLASER\n",
    "count lies": flaser([1.0] * 5).replace("FLASER 5", "FLASER 5000000000"),
    "negative count": flaser([1.0] * 5).replace("FLASER 5", "FLASER -5"),
    "nothing": flaser([]),
    "pose not finite": flaser([1.0], odometry=("nan", 0, 0)),
    "pose far off": flaser([1.0], odometry=(1e9, 0, 0)),
    "time": flaser([1.0], stamp="now"),
    "endless time": flaser([1.0], stamp="1e999999"),
    "not a time": flaser([1.0], stamp="NaN"),
    "robot": robotlaser([1.0], (1e5, 0, 0), (0, 0, 0)),
    "robot cut": robotlaser([1.0], (0, 0, 0), (0, 0, 0))[:40] + "\n",
    "bytes": "FLASER 2 \udcff\udcfe 1 2\n",
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_damaged_lines_are_left_out_and_named(tmp_path, kind):
    path = tmp_path / "bad.clf"
    path.write_bytes(
        (HEAD + flaser([1.0] * 9) + DAMAGE[kind] + flaser([2.0] * 9, stamp="12")).encode("utf8", "surrogateescape")
    )
    robot = CarmenLog(str(path))
    assert [float(scan.ranges[0]) for scan in robot.scans] == [1.0, 2.0]
    assert "1 damaged lines left out, the first: line 5" in robot.notes[-1]
    assert "\n" not in robot.notes[-1]


def test_an_offset_that_makes_no_sense_is_not_used(tmp_path):
    text = (
        "PARAM robot_frontlaser_offset 1e9 h 0\nPARAM robot_frontlaser_offset\nPARAM robot_frontlaser_offset nan h 0\n"
    )
    scan = CarmenLog(log(tmp_path, text + flaser([1.0]))).scans[0]
    assert np.allclose(scan.T_base_sensor, np.eye(4))


def test_a_packed_file_that_ends_early_keeps_what_was_read(tmp_path):
    rng = np.random.default_rng(0)
    text = "".join(flaser(rng.random(180).round(3), stamp=f"{t}") for t in range(2000))
    path = tmp_path / "cut.clf.bz2"
    path.write_bytes(bz2.compress(text.encode())[:-20000])
    robot = CarmenLog(str(path))
    assert 500 < len(robot.scans) < 2000
    assert "ends too early" in robot.notes[-1] or "damaged" in robot.notes[-1]


@pytest.mark.parametrize(
    ("text", "name", "complaint"),
    [
        (HEAD, "a.clf", "holds no scan"),
        ("", "a.clf", "holds no scan"),
        (None, "a.clf", "no such file"),
        (flaser([1.0]), "a.clf?max_range=-1", "must be a positive number"),
        (flaser([1.0]), "a.clf?max_rang=1", "did you mean 'max_range'"),
    ],
)
def test_mistakes_are_one_line(tmp_path, text, name, complaint):
    if text is not None:
        (tmp_path / "a.clf").write_text(text)
    with pytest.raises(SourceError, match=complaint) as error:
        CarmenLog(str(tmp_path / name))
    assert "\n" not in str(error.value)


def test_what_is_not_packed_is_one_line(tmp_path):
    (tmp_path / "a.clf.bz2").write_text(flaser([1.0]))
    with pytest.raises(SourceError, match="holds no scan"):
        CarmenLog(str(tmp_path / "a.clf.bz2"))


def test_other_files_are_not_for_us():
    assert not CarmenLog.recognises("walk.bag")
    assert not CarmenLog.recognises("sim:floor")
    assert CarmenLog.recognises("aces.clf.bz2?max_range=40")


@pytest.mark.parametrize(
    ("name", "scans", "beams", "limit"), [("aces", 7374, 180, 50.0), ("mit-csail", 1988, 361, 81.9)]
)
def test_real_logs(name, scans, beams, limit):
    path = DATA / f"{name}.clf.bz2"
    if not path.exists():
        pytest.skip("no ../shared/data/carmen")
    robot = CarmenLog(str(path))
    assert len(robot.scans) == scans
    assert not robot.damaged
    assert {len(scan.ranges) for scan in robot.scans[::100]} == {beams}
    assert robot.scans[0].range_max == limit
