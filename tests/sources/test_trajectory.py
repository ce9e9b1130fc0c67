# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest

from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.poses.trajectory import Trajectory, ns_from_seconds, seconds_from_ns

HALF = math.sqrt(0.5)
TWO = f"1305031102.100000 1 2 3 0 0 0 1\n1305031102.180000 2 2 5 0 0 {HALF} {HALF}\n"
"""Two poses 80 ms apart: 1 m along x, 2 m along z, a quarter turn about z."""


@pytest.fixture
def trajectory(tmp_path):
    def make(text):
        (tmp_path / "groundtruth.txt").write_text(text)
        return Trajectory(tmp_path / "groundtruth.txt")

    return make


def refusal(trajectory, stamp_ns):
    with pytest.raises(FrameRefused) as caught:
        trajectory.at(stamp_ns)
    assert "\n" not in str(caught.value)
    return caught.value.reason, str(caught.value)


@pytest.mark.parametrize(
    ("text", "ns"),
    [
        ("1305031102.160407", 1_305_031_102_160_407_000),
        ("1305031102.123456789", 1_305_031_102_123_456_789),
        ("1305031102", 1_305_031_102_000_000_000),
        ("1.305031102160407e+09", 1_305_031_102_160_407_000),
        ("0.0000000016", 2),
        (".5", 500_000_000),
        ("-1.25", -1_250_000_000),
    ],
)
def test_stamps_are_exact_nanoseconds(text, ns):
    assert ns_from_seconds(text) == ns


def test_a_float_would_not_have_been_exact():
    assert int(float("1305031102.123456789") * 1e9) != ns_from_seconds("1305031102.123456789")


@pytest.mark.parametrize("text", ["", "soon", "nan", "inf", "1e999999999", "99999999999", "1.2.3", "sNaN"])
def test_what_is_no_time_is_an_error(text):
    with pytest.raises(ValueError, match="not a time"):
        ns_from_seconds(text)


def test_nanoseconds_are_written_in_full():
    assert seconds_from_ns(1_305_031_102_160_407_001) == "1305031102.160407001"


def test_a_quarter_of_the_way_is_computed_by_hand(trajectory):
    T = trajectory(TWO).at(1_305_031_102_120_000_000)
    turn = math.radians(22.5)
    np.testing.assert_allclose(T[:3, 3], [1.25, 2, 3.5], atol=1e-12)
    np.testing.assert_allclose(
        T[:3, :3], [[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]], atol=1e-12
    )
    np.testing.assert_array_equal(T[3], [0, 0, 0, 1])


def test_the_stamp_of_a_pose_gives_that_pose_also_at_both_ends(trajectory):
    poses = trajectory(TWO)
    np.testing.assert_array_equal(poses.at(1_305_031_102_100_000_000)[:3, 3], [1, 2, 3])
    np.testing.assert_array_equal(poses.at(1_305_031_102_180_000_000)[:3, 3], [2, 2, 5])


@pytest.mark.parametrize(("stamp", "side"), [("1305031102.09", "before"), ("1305031102.19", "after")])
def test_there_is_no_pose_before_the_first_and_after_the_last(trajectory, stamp, side):
    reason, message = refusal(trajectory(TWO), ns_from_seconds(stamp))
    assert reason == "no_pose"
    assert f"{side} {stamp}" in message
    assert "groundtruth.txt" in message


def test_both_neighbours_must_be_near(trajectory):
    poses = trajectory("10.0 0 0 0 0 0 0 1\n10.15 1 0 0 0 0 0 1\n10.30 5 0 0 0 0 0 1\n")
    assert poses.at(ns_from_seconds("10.06"))[0, 3] == pytest.approx(0.4)
    assert refusal(poses, ns_from_seconds("10.04"))[0] == "no_pose"  # 0.11 s to the one after
    reason, message = refusal(poses, ns_from_seconds("10.11"))
    assert reason == "no_pose"
    assert "0.110 s" in message


def test_exactly_the_limit_is_too_far(trajectory):
    poses = trajectory("10.0 0 0 0 0 0 0 1\n10.19 1 0 0 0 0 0 1\n")
    assert refusal(poses, ns_from_seconds("10.1"))[0] == "no_pose"
    assert poses.at(ns_from_seconds("10.099999999")) is not None


def test_order_comments_commas_and_repeated_stamps_do_not_matter(trajectory):
    first, last = TWO.splitlines()
    again = first.split()[0] + " 9 9 9 0 0 0 1"
    comma = last.replace(" ", ", ")
    messy = f"\ufeff# stamp tx ty tz qx qy qz qw\n\n{comma}  # last\n{first}\n{again}\n"
    poses, tidy = trajectory(messy), trajectory(TWO)
    assert len(poses) == len(tidy) == 2
    np.testing.assert_array_equal(poses.at(1_305_031_102_130_000_000), tidy.at(1_305_031_102_130_000_000))


def test_quaternions_need_not_have_length_one(trajectory):
    T = trajectory(f"5 0 0 0 0 0 {3 * HALF} {3 * HALF}").at(5_000_000_000)
    np.testing.assert_allclose(T[:3, :3], [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


@pytest.mark.parametrize(
    "bad", ["1 2 3 0 0 0 0", "1 2 3 0 0 0", "1 2 3 0 0 0 1 9", "1 2 x 0 0 0 1", "1 nan 3 0 0 0 1", ""]
)
def test_a_line_without_a_usable_pose_spoils_only_its_neighbourhood(trajectory, bad):
    poses = trajectory(
        f"# made\n10.00 0 0 0 0 0 0 1\n10.05 1 0 0 0 0 0 1\n10.10 {bad}\n10.15 3 0 0 0 0 0 1\n10.20 4 0 0 0 0 0 1"
    )
    assert poses.at(ns_from_seconds("10.02"))[0, 3] == pytest.approx(0.4)
    assert poses.at(ns_from_seconds("10.18"))[0, 3] == pytest.approx(3.6)
    for stamp in ("10.07", "10.10", "10.12"):
        reason, message = refusal(poses, ns_from_seconds(stamp))
        assert reason == "bad_pose_file"
        assert "groundtruth.txt:4:" in message


@pytest.mark.parametrize("text", ["hello 1 2 3 0 0 0 1", "1 0 0 0 0 0 0 1\n\nnan 0 0 0 0 0 0 1"])
def test_an_unreadable_stamp_names_file_and_line(trajectory, text):
    line = len(text.splitlines())
    with pytest.raises(SourceError, match=rf"groundtruth\.txt:{line}: "):
        trajectory(text)


def test_a_file_without_poses_is_an_error(trajectory):
    with pytest.raises(SourceError, match="holds no pose"):
        trajectory("# nothing\n")


def test_binary_rubbish_is_an_error_of_one_line(tmp_path):
    (tmp_path / "groundtruth.txt").write_bytes(bytes(range(256)))
    with pytest.raises(SourceError, match=r"groundtruth\.txt:\d+: "):
        Trajectory(tmp_path / "groundtruth.txt")
