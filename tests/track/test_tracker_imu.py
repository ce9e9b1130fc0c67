# SPDX-License-Identifier: Apache-2.0
"""Tracking with an IMU: what it saves, what it must not spoil, and that a wrong one is left out."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from made_imu import SIDEWAYS, both, cluttered, imu_along, looking_round, tracker_with
from made_tracks import STEP_NS, covered, seen, simulated, track

from stereovox.geometry.se3 import inverse, rotation_matrix, rotation_vector
from stereovox.sources.imu import ImuReadings
from stereovox.track.tracker import LEVEL, Tracker

TILT = np.eye(4)
TILT[:3, :3] = rotation_matrix([0.3, -0.2, 0.0])


@lru_cache(maxsize=4)
def frames(scene, first=0, last=25, seed=0):
    source = simulated(scene, seed)
    return tuple(source.frame(i) for i in range(first, last))


@lru_cache(maxsize=4)
def turning(seed, rate):
    return tuple(seen(cluttered(seed), looking_round(60, rate), seed))


@pytest.mark.parametrize("scene", ["apartment", "room"])
def test_poses_are_as_good_and_as_honest_with_an_imu(scene):
    nees, errors = [], []
    for seed in range(3):
        taken = frames(scene, seed=seed)
        without, found, by = both(taken, imu_along(taken, seed=seed))
        assert by._gyroscope.trusted
        assert found.lost == [0]
        assert np.all(found.errors() < (0.02, 0.5))
        errors.append([found.errors()[:, 1].mean(), without.errors()[:, 1].mean()])
        nees.extend(found.nees())
    assert np.mean(errors, axis=0)[0] < 1.1 * np.mean(errors, axis=0)[1]
    assert 0.1 < np.mean(nees) < 2
    assert np.max(nees) < 6


@pytest.mark.parametrize("seed", [0, 3])
def test_a_turn_of_18_degrees_an_image_is_followed_by_the_gyroscope_alone(seed):
    """180 degrees a second at 10 Hz, begun at once."""
    taken = turning(seed, 180.0)
    without, found, _ = both(taken[::3], imu_along(taken))
    assert len(without.lost) > 4
    assert found.lost == [0]
    assert np.all(found.errors() < (0.02, 0.5))


def test_after_a_few_covered_images_in_a_turn_the_next_one_counts():
    taken = [covered(frame) if 32 <= i < 36 else frame for i, frame in enumerate(turning(1, 90.0))]
    without, found, _ = both(taken, imu_along(turning(1, 90.0)))
    assert found.lost == [0, 32, 33, 34, 35]
    assert len(without.lost) > 8
    assert np.all(found.errors() < (0.02, 0.5))


@pytest.mark.parametrize(
    "wrong",
    [{"told": np.eye(3)}, {"clock_s": 1.5}, {"bias": np.array([0.4, 0.3, -0.5])}],
    ids=["mount", "clock", "bias of 40 degrees a second"],
)
def test_a_wrong_imu_is_left_out_and_costs_nothing(wrong):
    taken = frames("apartment", last=40)
    without, found, by = both(taken, imu_along(taken, **wrong))
    assert "left out" in by.imu_use
    assert found.lost == without.lost
    assert np.all(found.errors()[-1] < without.errors()[-1] + (0.005, 0.1))


def test_motions_that_are_given_now_and_then_do_not_speak_against_a_gyroscope():
    taken = turning(1, 90.0)[:40]
    by = tracker_with(taken, imu_along(taken))
    for k, frame in enumerate(taken):
        motion = inverse(taken[k - 1].T_world_sensor) @ frame.T_world_sensor if k % 3 and k > 3 else None
        by.add(frame, motion)
    assert by._gyroscope.trusted


def test_an_imu_whose_clock_has_nothing_in_common_with_the_images_changes_nothing():
    taken = frames("apartment", last=12)
    without, found, by = both(taken, imu_along(taken, clock_s=500.0))
    for one, other in zip(without.found, found.found, strict=True):
        np.testing.assert_array_equal(one.T_world_sensor, other.T_world_sensor)
    assert by.imu_use.startswith("imu: not relied on: no turn to compare with that of the images; ")
    assert by.imu_use.endswith("its accelerometer did not show which way is up")


def test_one_that_is_right_is_said_to_be_used():
    taken = frames("apartment")
    found = tracker_with(taken, imu_along(taken, before_s=1.0))
    track(taken, found)
    assert "imu: turns of" in found.imu_use
    assert found.imu_use.endswith("its accelerometer gave which way is up")
    assert Tracker().imu_use == ""


def test_the_start_is_level_by_the_accelerometer():
    """A camera that is held aslant: the world's z is up, and where it looks is kept."""
    taken = [replace(frame, T_world_sensor=frame.T_world_sensor @ TILT) for frame in frames("apartment", last=12)]
    by = tracker_with(taken, imu_along(taken, before_s=1.0), LEVEL)
    track(taken, by)
    start = by._start
    up = start[:3, :3].T @ [0, 0, 1]
    assert np.degrees(np.arccos(up @ taken[0].T_world_sensor[2, :3])) < 1
    assert np.linalg.norm(rotation_vector(start[:3, :3] @ LEVEL[:3, :3].T)) > 0.3


def test_up_is_the_axis_of_the_settings():
    taken = frames("apartment", last=12)
    by = Tracker("chien2020", imu=imu_along(taken, before_s=1.0), start=np.eye(4))
    by.add(taken[0])
    up = {"-y": 1, "z": 2}[by.config.up]
    sign = -1 if by.config.up.startswith("-") else 1
    felt = by._start[:3, :3].T @ (sign * np.eye(3)[up])
    assert np.degrees(np.arccos(felt @ taken[0].T_world_sensor[2, :3])) < 1


def test_a_start_that_is_level_enough_is_not_touched():
    taken = frames("apartment", last=12)
    by = tracker_with(taken, imu_along(taken, before_s=1.0))
    track(taken, by)
    np.testing.assert_array_equal(by._start, taken[0].T_world_sensor)


def test_a_place_that_looks_alike_but_lies_elsewhere_by_the_gyroscope_is_not_taken():
    """Shown the first view again after a covered turn of half a circle: the gyroscope knows that it cannot be that."""
    around = turning(2, 90.0)
    dark = [covered(frame) for frame in around[32:]]
    last = around[-1].stamp_ns
    again = [replace(frame, stamp_ns=last + (k + 1) * STEP_NS) for k, frame in enumerate(around[10:20])]
    imu = imu_along(around)
    still = ImuReadings(
        np.append(imu.stamps_ns, last + np.arange(10, 1000, 10) * 10**6),
        np.vstack([imu.angular_rate, np.zeros((99, 3))]),
        np.vstack([imu.specific_force, np.full((99, 3), np.nan)]),
        imu.T_sensor_imu,
    )
    seen_ = [*around[:32], *dark, *again]
    without, found, _ = both(seen_, still)
    assert without.tracked[-1] > 60
    assert found.tracked[-1] < 32
    assert any("gyroscope" in one.lost for one in found.found)


def test_mounts_do_not_matter():
    taken = frames("apartment", last=15)
    poses = [
        track(taken, tracker_with(taken, imu_along(taken, noise=0, mount=R))).found[-1] for R in (np.eye(3), SIDEWAYS)
    ]
    np.testing.assert_allclose(poses[0].T_world_sensor, poses[1].T_world_sensor, atol=2e-4)
