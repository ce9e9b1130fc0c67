# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.errors import StereovoxError
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.track import Track

STAMPS = np.array([1_000, 2_000, 4_000]) + 1_700_000_000_000_000_000
DRIFT = np.array([[1.0, -2.0, 0.2], [3.0, 2.0, 0.6], [3.0, 2.0, -0.2]])


def track(drift=DRIFT, stamps=STAMPS):
    return Track(np.array(stamps), np.zeros((len(stamps), 3)), np.array(drift))


def at(found, ns):
    return found.correction(int(STAMPS[0]) - 1_000 + ns)


def test_the_correction_in_between_is_in_between():
    assert at(track(), 1_500) == pytest.approx([2, 0, 0.4])
    assert at(track(), 1_250) == pytest.approx([1.5, -1, 0.3])
    assert at(track(), 3_500) == pytest.approx([3, 2, 0])


def test_at_its_own_times_it_is_the_one_of_the_pose():
    for stamp_ns, drift in zip(STAMPS, DRIFT, strict=True):
        assert track().correction(int(stamp_ns)) == pytest.approx(drift)


@pytest.mark.parametrize("ns", [-(10**15), 0, 999])
def test_before_the_first_pose_it_is_held(ns):
    assert at(track(), ns) == pytest.approx(DRIFT[0])


@pytest.mark.parametrize("ns", [4_001, 10**15])
def test_after_the_last_pose_it_is_held(ns):
    assert at(track(), ns) == pytest.approx(DRIFT[-1])


@pytest.mark.parametrize("sign", [1, -1])
def test_a_turn_over_half_a_turn_goes_the_short_way(sign):
    ends = np.array([[0, 0, sign * (np.pi - 0.1)], [0, 0, sign * (0.3 - np.pi)]])
    found = track(ends, STAMPS[:2])
    yaws = [se2.wrapped(at(found, ns)[2] - sign * np.pi) for ns in (1_250, 1_500, 1_750)]
    assert yaws == pytest.approx(np.array([0, 0.1, 0.2]) * sign, abs=1e-9)


def test_asking_changes_nothing():
    found = track()
    for ns in (1_500, 3_000):
        at(found, ns)
    assert np.array_equal(found.pose_map_odom, DRIFT)


def test_a_scan_is_put_where_the_robot_was_in_the_map():
    mount = se2.lifted((0.2, 0.1, 0.4))
    mount[2, 3] = 0.3
    odom = (5.0, 1.0, -0.7)
    stamp_ns = int(STAMPS[0]) + 500
    scan = Scan(np.ones(3, np.float32), 0, 0.1, 0.1, 5.0, se2.lifted(odom) @ mount, mount, stamp_ns=stamp_ns)
    found = track().corrected(scan)
    assert found.pose_world_base == pytest.approx(se2.compose((2, 0, 0.4), odom))
    assert found.T_world_sensor[2, 3] == pytest.approx(0.3)
    assert found.stamp_ns == stamp_ns


@pytest.mark.parametrize("stamps", [[1, 3, 2, 4], [1, 2, 2, 3], [4, 3, 2, 1]])
def test_times_that_do_not_rise_are_an_error_of_one_line(stamps):
    with pytest.raises(StereovoxError, match=r"times of a track must rise: pose [12] at [23] ns") as caught:
        track(np.zeros((4, 3)), stamps)
    assert "\n" not in str(caught.value)


def test_nothing_is_refused_unless_said():
    assert (track().refused, track().first_refusal) == ({}, "")
    assert track().refused is not track().refused


def test_the_file_holds_stamps_places_and_turns(tmp_path):
    poses = np.array([[1.5, -2.0, 0.0], [0.0, 3.0, np.pi / 2]])
    Track(STAMPS[:2], poses, poses).save(tmp_path / "way.tum")
    rows = [line.split() for line in (tmp_path / "way.tum").read_text().splitlines()[1:]]
    assert rows[0][0] == "1700000000.000001000"
    assert np.array(rows, float)[:, 1:] == pytest.approx(
        np.array([[1.5, -2, 0, 0, 0, 0, 1], [0, 3, 0, 0, 0, *[np.sqrt(0.5)] * 2]]), abs=1e-6
    )
