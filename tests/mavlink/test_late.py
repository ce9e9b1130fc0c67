# SPDX-License-Identifier: Apache-2.0
"""Images and poses that come late: what is sent is true when it is sent, or nothing is."""

from types import SimpleNamespace

import numpy as np
import pytest

import stereovox as sv
from stereovox.mavlink.link import dialect
from stereovox.mavlink.pose_sender import Body, BodyPose
from stereovox.mavlink.sectors import SectorRules, obstacle_sectors
from stereovox_lab.flights.late import Delay, LateLoop, LateSetup, fly_late

S = 1_000_000_000
LATE = (
    LateSetup(images=(Delay("constant", 3.0),)),
    LateSetup(images=(Delay("constant", 3.0),), poses=None),
    LateSetup(images=(Delay("growing", 4.0, 0.5, 4.0),), clock="device"),
    LateSetup(images=(Delay("jumping", 2.0, 1.0, 3.0),), poses=None, clock="device"),
    LateSetup(images=(Delay(), Delay("constant", 2.0)), clock="device"),
    LateSetup(poses=Delay("growing", 2.0, 0.5, 3.0)),
)


@pytest.mark.parametrize("setup", LATE)
def test_no_distance_is_wrong_however_late_images_and_poses_come(setup):
    flight = fly_late(20_000, setup)
    assert (flight.bad_messages, flight.worst_m < 0.3) == (0, True)
    assert flight.why


def test_the_judge_sees_what_was_wrong_before_stamps_counted():
    flight = fly_late(20_004, LateSetup(images=(Delay("constant", 1.5),), arrival=True))
    assert flight.bad_messages > 5


def test_images_a_little_late_are_moved_to_the_newest_pose_and_sent():
    flight = fly_late(20_001, LateSetup(images=(Delay("constant", 0.3),)))
    assert (flight.messages > 30, flight.distances > 50, flight.bad_messages) == (True, True, 0)


class Told:
    """A sender by a clock of its own, and what it says. Frames show a wall 2 m before the camera."""

    def __init__(self, **more):
        self.now_ns, self.messages, self.lines = 10**15, [], []
        link = SimpleNamespace(url="x", messages=dialect(), now_ns=lambda: self.now_ns, send=self.take)
        self.mapper = sv.Mapper(voxel_size=0.1, max_range=4.0, clock=lambda: self.now_ns, **more)
        self.sender = sv.ObstacleSender(self.mapper, link, rate_hz=None, tell=self.lines.append)

    def take(self, message):
        self.messages.append(message)
        return True

    def frame(self, late_s=0.0, **more):
        camera = sv.PinholeCamera.from_field_of_view(48, 36, 90.0)
        depth = np.full((36, 48), 2.0, np.float32) + np.random.default_rng(self.now_ns).normal(0, 0.005, (36, 48))
        frame = sv.Frame(depth.astype(np.float32), camera, pose(0.0), self.now_ns - round(late_s * S), **more)
        report = self.mapper.add(frame)
        assert not report.refused, report.detail
        self.sender.after(frame, report)

    def said_from(self, T_world_body):
        return obstacle_sectors(self.mapper.map, T_world_body).centimetres(SectorRules()).tolist()

    def step(self, seconds=0.1):
        self.now_ns += round(seconds * S)


def pose(forward_m):
    T = np.array([[0.0, 0, 1, forward_m], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    T[0, 3] = forward_m
    return T


def test_the_distance_is_that_from_the_newest_pose_carried_on_to_now():
    told = Told()
    for k in range(9):
        told.step()
        told.frame() if k < 6 else None
        told.sender.pose(told.now_ns, pose(max(k - 5, 0) * 0.1))
    assert told.sender.send() == ""
    assert told.messages[-1].distances == told.said_from(pose(0.3))
    told.step(0.1)
    told.sender.send()
    assert told.messages[-1].distances == told.said_from(pose(0.4)) != told.said_from(pose(0.0))  # by its motion
    assert told.messages[-1].time_usec == (told.now_ns - 4 * S // 10) // 1000  # when the image was taken


def test_silence_for_old_poses_is_told_once():
    told = Told()
    for _ in range(5):
        told.frame()
        told.sender.pose(told.now_ns, pose(0.0))
        told.sender.send()
        told.step()
    assert told.lines == []
    told.sender._body._poses.clear()
    told.sender._body.take(BodyPose(told.now_ns - 4 * S // 10, told.now_ns, pose(0.0)))
    told.frame(sensor="other")  # with a pose of its own
    told.sender._body._poses.pop()
    told.sender._body.take(BodyPose(told.now_ns - 4 * S // 10, told.now_ns, pose(0.0)))
    assert "newest pose is 0.40 s old" in told.sender.send()
    told.sender.send()
    assert len(told.lines) == 1


def test_a_jump_of_the_pose_silences_until_the_map_has_seen_from_there():
    told = Told(**{"trust.max_speed_mps": 1000.0})
    for _ in range(5):
        told.frame()
        told.step()
    told.sender.pose(told.now_ns, pose(1.5))
    assert "jumped" in told.sender.send()
    told.step(0.02)
    told.sender.pose(told.now_ns, pose(1.5))
    assert "jumped" in told.sender.send()
    told.step(0.02)
    told.frame()
    assert told.sender.send() == ""


def test_frames_without_times_are_not_sent_for_long():
    told = Told()
    for _ in range(10):
        report = told.mapper.add(frame := sv.Frame(
            np.full((36, 48), 2.0, np.float32), sv.PinholeCamera.from_field_of_view(48, 36, 90.0), pose(0.0)
        ))  # fmt: skip
        told.sender.after(frame, report)
        told.step()
        told.sender.send()
    assert "old" in told.sender.send()


@pytest.mark.parametrize("wrong", [np.full((4, 4), np.nan), np.zeros((4, 4))])
def test_a_pose_that_is_none_is_left_out(wrong):
    told = Told()
    told.frame()
    told.sender.pose(told.now_ns, wrong)
    assert told.sender.send() == ""


def test_a_body_is_carried_on_by_its_last_motion_and_stands_where_none_is_known():
    body = Body()
    body.take(BodyPose(0, 0, pose(0.0)))
    np.testing.assert_array_equal(body.after(S), pose(0.0))
    body.take(BodyPose(S // 10, 0, pose(0.1)))
    np.testing.assert_allclose(body.after(S // 10), pose(0.2), atol=1e-12)
    np.testing.assert_allclose(body.after(100 * S), pose(0.4), atol=1e-12)  # at most 0.3 s
    body.take(BodyPose(S // 20, 0, pose(9.0)))  # late: a newer one is there
    np.testing.assert_array_equal(body.newest.T_world_body, pose(0.1))
    body.take(BodyPose(2 * S // 10, 0, pose(3.0)))
    assert body.jumped_ns == 2 * S // 10
    np.testing.assert_array_equal(body.after(S // 10), pose(3.0))


def test_a_camera_that_is_late_from_the_very_start_is_never_sent():
    loop = LateLoop(20_002, LateSetup(images=(Delay("constant", 4.9),)))
    assert loop.run().messages == 0
    assert loop.mapper.health().state in ("stale", "waiting", "lost")
