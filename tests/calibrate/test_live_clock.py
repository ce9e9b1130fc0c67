# SPDX-License-Identifier: Apache-2.0
"""The clock of a live camera is found from its motion; until then no image is mapped at a wrong pose."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from stereovox.calibrate.live_clock import REASON, CameraClock, MotionClock
from stereovox.config import load_config
from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.errors import FrameRefused
from stereovox.frame import Cloud
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.sources.poses.poses import Poses

MS, AT = 1_000_000, 30
SLOW_MS = 5
"""What poses take to come."""


@cache
def walk(count=75):
    return [frame for _, frame in zip(range(count), open_source("sim:room?image_width=320"), strict=False)]


class Flight:
    """Hands images and poses to a clock as they would arrive. Attributes: mapped, refused: frames; told: lines."""

    def __init__(self, frames, late_s=0.02, more_late_s=0.0, start_s=0.0, step_s=0.0, pose_step_s=0.0):
        self.mapped, self.refused, self.told, self.now = [], [], [], 0.0
        T_body = [frame.T_world_sensor @ inverse(T_BODY_OPTICAL) for frame in frames]
        truth = Poses([frame.stamp_ns for frame in frames], T_body)
        poses = LivePoses(clock=lambda: self.now)
        config = load_config("default", voxel_size=0.1)
        self.clock = CameraClock(
            "left", poses, poses.delays, T_BODY_OPTICAL, config, self.told.append,
            lambda doubt, ahead_s: f"--clock-offset {start_s + ahead_s:.3f}", background=False,
        )  # fmt: skip
        random, waiting, pose_ns = np.random.default_rng(0), [], frames[0].stamp_ns
        for k, frame in enumerate(frames):
            late_ns = round(1e9 * (late_s + random.exponential(0.005) + (more_late_s if k >= AT else 0)))
            arrived_ns = frame.stamp_ns + late_ns
            while pose_ns <= min(arrived_ns - SLOW_MS * MS, truth.stamps_ns[-1]):
                self.now = (pose_ns + SLOW_MS * MS) / 1e9
                step_ns = round(1e9 * pose_step_s) if pose_ns >= frames[AT].stamp_ns else 0
                poses.add(pose_ns + step_ns, truth.at(pose_ns))
                pose_ns += 10 * MS
            self.now = arrived_ns / 1e9
            off_ns = round(1e9 * (start_s + (step_s if k >= AT else 0)))
            stamp_ns = frame.stamp_ns + off_ns + self.clock.shift_ns
            waiting.append((replace(frame, stamp_ns=stamp_ns), self.clock.heard(stamp_ns, arrived_ns), arrived_ns))
            while waiting and (not waiting[0][1].is_open or arrived_ns - waiting[0][2] > 300 * MS):
                self._map(poses, arrived_ns, *waiting.pop(0)[:2])

    def _map(self, poses, now_ns, frame, doubt):
        try:
            self.clock.check(frame, doubt, now_ns)
            self.mapped.append((frame, poses.at(frame.stamp_ns) @ T_BODY_OPTICAL))
        except FrameRefused as refused:
            self.refused.append(refused)

    @property
    def worst_m(self):
        return max(np.linalg.norm(T[:3, 3] - frame.T_world_sensor[:3, 3]) for frame, T in self.mapped)


def test_nothing_is_said_of_clocks_that_agree():
    flight = Flight(walk())
    assert not flight.told
    assert len(flight.mapped) > 70
    assert not flight.clock.shift_ns


@pytest.mark.parametrize("step_s", [-0.4, -0.1, 0.2])
def test_a_clock_that_is_set_is_found_and_corrected(step_s):
    flight = Flight(walk(), step_s=step_s)
    assert flight.clock.shift_ns / 1e9 == pytest.approx(-step_s, abs=0.005)
    assert flight.worst_m < 0.02
    assert [refused.reason for refused in flight.refused].count(REASON) >= len(flight.refused) - 2
    assert len(flight.mapped) > 45
    first, then = flight.told
    assert first.startswith("left: images come")
    assert "--clock-offset" in first
    assert f"its clock is {'+-'[step_s < 0]}0." in then
    assert "corrected from now on" in then


def test_images_that_come_later_with_right_stamps_are_mapped_where_they_were_taken():
    flight = Flight(walk(), more_late_s=0.4)
    assert not flight.clock.shift_ns
    assert flight.worst_m < 0.01
    assert len(flight.mapped) > 40
    assert "stamps are right" in flight.told[-1]


@pytest.mark.parametrize("start_s", [100.0, -1.0])
def test_a_clock_that_was_never_that_of_the_poses_is_found(start_s):
    flight = Flight(walk(60), start_s=start_s)
    assert -flight.clock.shift_ns / 1e9 == pytest.approx(start_s, abs=0.03)
    assert flight.worst_m < 0.03
    assert "--clock-offset" in flight.told[0]
    assert len(flight.mapped) > 25


def test_a_clock_of_the_poses_that_is_set_back_is_found():
    flight = Flight(walk(), pose_step_s=-0.4)
    assert flight.clock.shift_ns / 1e9 == pytest.approx(-0.4, abs=0.02)
    assert flight.worst_m < 0.03


def test_a_body_that_rests_is_mapped_and_decides_nothing():
    still = [replace(walk(1)[0], stamp_ns=k * 33 * MS) for k in range(60)]
    flight = Flight(still, step_s=-0.4)
    assert not flight.clock.shift_ns
    assert len(flight.mapped) > 45
    assert len(flight.told) == 1


def test_clouds_cannot_be_tracked_and_are_refused_while_the_body_moves():
    clouds = [Cloud(np.zeros((1, 3)), frame.T_world_sensor, frame.stamp_ns) for frame in walk()]
    flight = Flight(clouds, step_s=-0.4)
    assert flight.worst_m < 0.02
    assert len(flight.mapped) < AT + 3
    assert {refused.reason for refused in flight.refused} <= {REASON, "no_pose"}


def test_even_motion_fits_at_every_offset_and_says_nothing():
    motion = MotionClock(load_config("default"), np.eye(4), _Even())
    motion._pairs = [(k * 33 * MS, (k + 6) * 33 * MS, _moved(6 * 0.033)) for k in range(40)]
    assert motion.shift_ns(-700 * MS, 700 * MS) is None


def _moved(seconds):
    T = np.eye(4)
    T[0, 3] = seconds
    return T


class _Even:
    """A body that goes straight on at 1 m/s."""

    def between(self, first_ns, last_ns):
        stamps = np.arange(first_ns - 100 * MS, last_ns + 100 * MS, 10 * MS)
        return Poses(stamps, [_moved(stamp / 1e9) for stamp in stamps])
