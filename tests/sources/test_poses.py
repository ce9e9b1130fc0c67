# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest

from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.poses.poses import Poses

MS = 1_000_000


def at(*positions):
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, 0, 3] = positions
    return T


def test_between_two_poses_position_and_turn_are_interpolated():
    T = at(1, 3)
    T[1, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    found = Poses([0, 40 * MS], T).at(30 * MS)
    turn = np.radians(67.5)
    np.testing.assert_allclose(found[:3, 3], [2.5, 0, 0], atol=1e-12)
    np.testing.assert_allclose(found[:2, :2], [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]], atol=1e-12)


def test_order_does_not_matter_and_the_first_of_equal_stamps_counts():
    poses = Poses([80 * MS, 0, 40 * MS, 0], at(2, 0, 1, 9), [3, 0, 2, 1])
    assert len(poses) == 3
    assert poses.stamps_ns.tolist() == [0, 40 * MS, 80 * MS]
    assert poses.confidence.tolist() == [0, 2, 3]
    assert poses.at(0)[0, 3] == 0
    assert poses.at(60 * MS)[0, 3] == pytest.approx(1.5)
    assert poses.neighbours(60 * MS) == (1, 2)
    assert poses.neighbours(40 * MS) == (1, 1)


@pytest.mark.parametrize(("stamp", "said"), [(-1, "before"), (81 * MS, "after"), (200 * MS, "0.120 s")])
def test_a_missing_or_distant_neighbour_refuses(stamp, said):
    poses = Poses([0, 80 * MS] if stamp < 100 * MS else [0, 80 * MS, 320 * MS], at(0, 1, 2)[: 2 + (stamp > 100 * MS)])
    with pytest.raises(FrameRefused, match=said) as caught:
        poses.at(stamp)
    assert caught.value.reason == "no_pose"


def test_a_hundred_milliseconds_are_too_far_and_less_is_not():
    poses = Poses([0, 190 * MS], at(0, 19))
    assert poses.at(95 * MS)[0, 3] == pytest.approx(9.5)
    with pytest.raises(FrameRefused):
        poses.at(90 * MS)


def test_a_pose_that_cannot_be_used_spoils_its_neighbourhood_and_says_why():
    T = at(0, 1, 2, 3)
    T[1] = np.nan
    poses = Poses([0, 50 * MS, 90 * MS, 130 * MS], T, where="t265", faults={50 * MS: "t265:2: nonsense"})
    assert poses.at(100 * MS)[0, 3] == pytest.approx(2.25)
    for stamp in (10 * MS, 50 * MS, 70 * MS):
        with pytest.raises(FrameRefused, match="t265:2: nonsense") as caught:
            poses.at(stamp)
        assert caught.value.reason == "bad_pose_file"


def test_what_is_handed_out_is_not_the_stored_pose():
    poses = Poses([0, 50 * MS], at(0, 1))
    poses.at(0)[0, 3] = 7
    assert poses.at(0)[0, 3] == 0


@pytest.mark.parametrize(
    ("stamps", "T", "confidence"),
    [([], np.empty((0, 4, 4)), None), ([0, 1], at(0), None), ([0], np.eye(3)[None], None), ([0, 1], at(0, 1), [3])],
)
def test_arrays_that_do_not_fit_are_an_error(stamps, T, confidence):
    with pytest.raises(SourceError, match="t265"):
        Poses(stamps, T, confidence, where="t265")


def accelerated(step_ns, accel, count=7):
    """Poses of a body that accelerates along x and turns faster and faster about z."""
    t = np.arange(count) * step_ns / 1e9
    T = at(*(0.4 * t + accel * t**2 / 2))
    angle = 0.2 * t + accel * t**2 / 2
    T[:, 0, 0] = T[:, 1, 1] = np.cos(angle)
    T[:, 1, 0] = np.sin(angle)
    T[:, 0, 1] = -T[:, 1, 0]
    return Poses(np.arange(count) * step_ns, T)


@pytest.mark.parametrize(("accel", "near"), [(0.0, True), (0.5, True), (1.9, True), (2.1, False), (9.0, False)])
def test_poses_at_5_hz_are_bridged_if_the_motion_is_smooth(accel, near):
    """A parabola is off its chord by a g^2 / 8 in the middle: 1 cm at 2 m/s^2 and 0.2 s."""
    poses, stamp_ns = accelerated(200 * MS, accel), 630 * MS
    if near:
        x = 0.4 * 0.63 + accel * 0.63**2 / 2
        assert abs(poses.at(stamp_ns)[0, 3] - x) < 0.01
        assert abs(poses.at(stamp_ns)[0, 3] - x) > 0.3 * accel * 0.2**2 / 8 - 1e-12
    else:
        with pytest.raises(FrameRefused, match=r"0\.1 s"):
            poses.at(stamp_ns)
        poses.max_gap_ns = 200 * MS
        assert poses.at(stamp_ns) is not None
        poses.max_gap_ns = 199 * MS
        with pytest.raises(FrameRefused):
            poses.at(stamp_ns)


def test_a_loss_in_dense_poses_is_not_bridged():
    """Poses every 20 ms that are missing for 0.3 s: a tracker lost its world, however smooth the rest is."""
    dense = accelerated(20 * MS, 0.0, 60)
    keep = (dense.stamps_ns <= 400 * MS) | (dense.stamps_ns >= 700 * MS)
    with pytest.raises(FrameRefused):
        Poses(dense.stamps_ns[keep], dense.T_world_body[keep]).at(550 * MS)


def test_a_jump_next_to_the_gap_is_not_smooth():
    poses = accelerated(200 * MS, 0.0)
    poses.T_world_body[4:, 0, 3] += 0.3
    assert poses.at(300 * MS) is not None
    for stamp_ns in (500 * MS, 700 * MS, 900 * MS):
        with pytest.raises(FrameRefused):
            poses.at(stamp_ns)
