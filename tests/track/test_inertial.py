# SPDX-License-Identifier: Apache-2.0
"""Turns by a gyroscope against slow sums of SciPy's rotations, its bias, its doubt, whom it is trusted, and up."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from made_imu import BIAS, SIDEWAYS, imu_along, looking_round
from made_tracks import STEP_NS, aside, simulated
from naive_imu import turned
from scipy.spatial.transform import Rotation

from stereovox.frame import Frame
from stereovox.geometry.se3 import rotation_matrix, rotation_vector
from stereovox.sources.imu import ImuReadings
from stereovox.track.inertial import Gyroscope, Turn, integrate, up_by_force

SPAN = 300_000_000


def tumbling(hz=200.0, seconds=1.0, T=None):
    """An IMU that turns about all axes, faster and slower."""
    stamps = np.round(np.arange(0, seconds, 1 / hz) * 1e9).astype(np.int64)
    t = stamps / 1e9
    rates = np.column_stack([2 * np.sin(7 * t), 1.5 * np.cos(5 * t), 1 + np.sin(3 * t)])
    return ImuReadings(stamps, rates, np.zeros_like(rates), np.eye(4) if T is None else T)


def path(count=60):
    source = simulated("apartment")
    return [source.frame(i) for i in range(count)]


@pytest.mark.parametrize("span", [(103_000_000, 131_000_000), (100_000_000, 400_000_000), (111_000_001, 111_900_000)])
def test_a_turn_is_that_of_many_small_steps(span):
    readings = tumbling()
    found = integrate(readings, *span, BIAS)
    true = turned(readings.stamps_ns, readings.angular_rate, *span, BIAS)
    assert found is not None
    assert (true.inv() * Rotation.from_matrix(found.R)).magnitude() < 1e-4 * found.seconds + 1e-9
    assert found.seconds == pytest.approx((span[1] - span[0]) / 1e9)


def test_a_mount_turns_the_axes():
    T = np.eye(4)
    T[:3, :3] = SIDEWAYS
    here, there = (integrate(tumbling(T=T_), 0, SPAN, np.zeros(3)) for T_ in (np.eye(4), T))
    np.testing.assert_allclose(there.R, SIDEWAYS @ here.R @ SIDEWAYS.T, atol=1e-12)


def test_the_derivative_by_the_bias_is_that_of_differences():
    readings, step = tumbling(), 1e-5
    found = integrate(readings, 0, SPAN, np.zeros(3))
    for k in range(3):
        bias = step * np.eye(3)[k]
        change = turned(readings.stamps_ns, readings.angular_rate, 0, SPAN, 0).inv() * turned(
            readings.stamps_ns, readings.angular_rate, 0, SPAN, bias
        )
        np.testing.assert_allclose(found.by_bias[:, k], change.as_rotvec() / step, atol=2e-3)


def test_turns_one_after_the_other_are_the_whole():
    readings = tumbling()
    one, two, whole = (integrate(readings, *span, BIAS) for span in ((0, 50_000_000), (50_000_000, SPAN), (0, SPAN)))
    both = one.then(two)
    np.testing.assert_allclose(both.R, whole.R, atol=1e-9)
    np.testing.assert_allclose(both.by_bias, whole.by_bias, atol=1e-9)
    assert (both.seconds, both.noise) == (pytest.approx(whole.seconds), pytest.approx(whole.noise))


def test_a_turn_that_is_asked_for_again_or_goes_on_is_the_same():
    known = Gyroscope(tumbling())
    once, again = known.turn(0, 100_000_000), known.turn(0, 100_000_000)
    np.testing.assert_array_equal(once.R, again.R)
    np.testing.assert_allclose(known.turn(0, SPAN).R, integrate(tumbling(), 0, SPAN, np.zeros(3)).R, atol=1e-9)
    np.testing.assert_array_equal(known.turn(0, 100_000_000).R, once.R)
    assert known.turn(SPAN, SPAN) is None


@pytest.mark.parametrize("span", [(-50_000_000, 10), (900_000_000, 1_100_000_000), (5, 5), (9, 5)])
def test_what_readings_do_not_cover_is_not_known(span):
    assert integrate(tumbling(), *span, np.zeros(3)) is None


def test_a_gap_is_not_bridged():
    readings = tumbling(seconds=3.0)
    kept = (readings.stamps_ns < 500_000_000) | (readings.stamps_ns > 1_200_000_000)
    gap = ImuReadings(readings.stamps_ns[kept], readings.angular_rate[kept], readings.specific_force[kept])
    assert integrate(gap, 400_000_000, 1_300_000_000, np.zeros(3)) is None
    assert integrate(gap, 1_300_000_000, 1_500_000_000, np.zeros(3)) is not None


def learned(frames, imu, covariance=1e-7, seed=1):
    """A gyroscope that saw the true turns of a camera, with a little noise."""
    rng, gyroscope = np.random.default_rng(seed), Gyroscope(imu)
    R = [f.T_world_sensor[:3, :3] @ rotation_matrix(np.sqrt(covariance) * rng.normal(size=3)) for f in frames]
    for k in range(1, len(frames)):
        turn = gyroscope.turn(frames[k - 1].stamp_ns, frames[k].stamp_ns)
        gyroscope.learn(turn, R[k - 1], R[k], np.eye(3) * covariance)
    return gyroscope


def test_the_bias_is_found_and_its_doubt_is_honest():
    frames, squares = path(), []
    for seed in range(4):
        gyroscope = learned(frames, imu_along(frames, seed=seed), seed=seed)
        assert gyroscope.trusted
        error = gyroscope._bias - BIAS
        assert np.linalg.norm(error) < 0.3 * np.linalg.norm(BIAS)
        squares.append(error @ np.linalg.solve(gyroscope._unsure, error) / 3)
    assert 0.02 < np.mean(squares) < 2


def test_turns_are_off_by_what_their_doubt_says():
    """Before and after the bias is known."""
    frames = path()
    for known in (Gyroscope(imu_along(frames)), learned(frames, imu_along(frames))):
        squares = []
        for one, two in itertools.pairwise(frames):
            turn = known.turn(one.stamp_ns, two.stamp_ns)
            off = rotation_vector(turn.R.T @ one.T_world_sensor[:3, :3].T @ two.T_world_sensor[:3, :3])
            squares.append(off @ np.linalg.solve(known.doubt(turn), off) / 3)
        assert np.mean(squares) < 1.5
        assert np.max(np.sqrt(np.diag(known.doubt(turn)))) < 0.01


@pytest.mark.parametrize(
    "wrong",
    [{"told": np.eye(3)}, {"told": -SIDEWAYS @ np.diag([1, 1, -1])}, {"clock_s": 1.5}],
    ids=["mount", "mirrored axes", "clock"],
)
def test_a_gyroscope_whose_turns_are_not_those_of_the_images_is_left_out(wrong):
    frames = path()
    found = learned(frames[:50], imu_along(frames, **wrong))
    assert not found.trusted
    assert "differ from those of the images" in found.left_out
    assert found.turn(frames[3].stamp_ns, frames[4].stamp_ns) is None


def test_degrees_in_place_of_radians_are_left_out():
    frames = path()
    imu = imu_along(frames)
    found = learned(frames, replace(imu, angular_rate=np.degrees(imu.angular_rate)))
    assert found.left_out
    assert "left out" in found.use


def test_a_clock_that_is_a_little_off_makes_the_doubt_wider():
    poses = looking_round(60, 0, begin_s=9.0)
    frames = [Frame(np.zeros((1, 1)), None, T, k * STEP_NS) for k, T in enumerate(poses)]
    right, late = learned(frames, imu_along(frames)), learned(frames, imu_along(frames, clock_s=0.02))
    assert late.trusted
    turn = right.turn(frames[30].stamp_ns, frames[31].stamp_ns)
    assert np.trace(late.doubt(turn)) > 2 * np.trace(right.doubt(turn))


def test_without_a_turn_nothing_is_trusted():
    still = [Frame(np.zeros((1, 1)), None, T, k * STEP_NS) for k, T in enumerate(aside(60))]
    found = learned(still, imu_along(still, bias=0))
    assert not (found.trusted)
    assert not (found.left_out)
    assert "not relied on" in found.use


@pytest.mark.parametrize("mount", [np.eye(3), SIDEWAYS])
def test_up_at_rest_is_what_is_felt(mount):
    frames = path(40)
    imu = imu_along(frames, mount=mount, before_s=1.0)
    up = up_by_force(imu, frames[0].stamp_ns)
    true = frames[0].T_world_sensor[2, :3]
    assert np.arccos(up.direction @ true) < up.off
    assert up.off == np.radians(1)


def test_up_while_moving_is_right_to_what_is_said():
    frames = path(90)
    imu = imu_along(frames)
    said = [(frame, up_by_force(imu, frame.stamp_ns)) for frame in frames[10::10]]
    said = [(frame, up) for frame, up in said if up is not None]
    assert len(said) > 4
    for frame, up in said:
        assert np.arccos(up.direction @ frame.T_world_sensor[2, :3]) < up.off == np.radians(5)


@pytest.mark.parametrize("change", [lambda f: 0.1 * f, lambda f: np.nan * f, lambda f: f + 9 * np.sign(f)])
def test_forces_that_are_not_gravity_say_nothing(change):
    frames = path(40)
    imu = imu_along(frames, before_s=1.0)
    assert up_by_force(replace(imu, specific_force=change(imu.specific_force)), frames[0].stamp_ns) is None


def test_readings_of_another_time_say_nothing():
    assert up_by_force(imu_along(path(40)), 10**12) is None


def test_a_turn_that_stands_still_is_none():
    still = Turn(np.eye(3), np.zeros((3, 3)), 0.0, 0.0, 0.0)
    found = integrate(tumbling(), 0, SPAN, BIAS)
    np.testing.assert_array_equal(still.then(found).R, found.R)
