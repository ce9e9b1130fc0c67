# SPDX-License-Identifier: Apache-2.0
"""The vehicle's pose as an autopilot in another process reads it, and silence when it is not known."""

from itertools import count
from math import cos, isnan, nan, radians, sin
from time import sleep

import numpy as np
import pytest

from stereovox import PoseSender, StereovoxError
from stereovox.geometry.se3 import rotation_matrix, rotation_vector
from stereovox.mavlink.link import dialect
from stereovox.mavlink.pose_sender import POSE_MESSAGES, upper_triangle

STEP_NS = 33_333_333
NUMBERS = ("x", "y", "z", "roll", "pitch", "yaw")
REFLECTED, STRETCHED = np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0])


class Link:
    """A connection that keeps what is sent, after a trip through bytes; its clock is set by tests."""

    def __init__(self):
        self.messages, self.url, self.ns, self.out = dialect(), "test:", 10**12, []
        self._packer, self._parser = self.messages.MAVLink(None), self.messages.MAVLink(None)

    def now_ns(self):
        return self.ns

    def send(self, message):
        [read] = self._parser.parse_buffer(message.pack(self._packer))
        self.out.append(read)
        return True


class Flight:
    """A sender, and a body that moves evenly: (3,) metres and radians a second in its own axes."""

    def __init__(self, message, velocity=(1.0, -0.4, 0.2), turn=(0.1, -0.3, 0.5), **options):
        self.link, self.told = Link(), []
        self.sender = PoseSender(self.link, message=message, tell=self.told.append, **options)
        self.velocity, self.turn = np.array(velocity), np.array(turn)
        self.T, self.stamp_ns, self.delay_ns = np.eye(4), 5_000_000_000, 10_000_000

    def on(self, frames=1, **given):
        done = []
        for _ in range(frames):
            self.T, self.stamp_ns = self.T.copy(), self.stamp_ns + STEP_NS
            seconds = STEP_NS / 1e9
            self.T[:3, :3] = self.T[:3, :3] @ rotation_matrix(self.turn * seconds)
            self.T[:3, 3] += self.T[:3, :3] @ self.velocity * seconds
            self.link.ns = 10**12 + self.stamp_ns + self.delay_ns
            done.append(self.sender.pose(self.stamp_ns, self.T, **given))
        return done

    @property
    def last(self):
        return self.link.out[-1]


@pytest.fixture(params=POSE_MESSAGES)
def flight(request):
    return Flight(request.param)


def test_another_process_reads_pose_velocity_and_time(start_autopilot):
    """Forward 1, left 2, up 3 m, turned 30 degrees to the left: ahead 1, right -2, down -3 m, and -30 degrees."""
    autopilot = start_autopilot()
    turned = np.eye(4)
    turned[:3, :3] = rotation_matrix([0, 0, radians(30)])
    with PoseSender(autopilot.url, rate_hz=200) as sender:
        before_us = sender.link.now_ns() // 1000
        for x in count(1, 0.01):
            turned[:3, 3] = x, 2, 3
            if sender.pose(sender.link.now_ns(), turned, quality=90):
                break
            sleep(0.01)  # a velocity needs two poses, and messages keep their distance
        read = autopilot.wait_for("ODOMETRY")[0]
    assert (read["frame_id"], read["child_frame_id"], read["estimator_type"], read["quality"]) == (20, 12, 2, 90)
    np.testing.assert_allclose([read["y"], read["z"]], [-2, -3], atol=1e-6)
    np.testing.assert_allclose(read["q"], [cos(radians(15)), 0, 0, -sin(radians(15))], atol=1e-6)
    assert isnan(read["pose_covariance"][0])
    assert before_us <= read["time_usec"] <= read["at"] * 1e6
    assert read["from"] == [1, 196]


def test_frames_and_velocities_are_right_to_a_millionth(flight):
    """Positions, attitudes and velocities by themselves: y and z of the world and of the body are turned round."""
    assert sum(flight.on(30)) == 30 - (flight.sender._message == "odometry")
    message, (x, y, z) = flight.last, flight.T[:3, 3]
    np.testing.assert_allclose([message.x, message.y, message.z], [x, -y, -z], atol=1e-6)
    flipped = np.diag([1, -1, -1]) @ flight.T[:3, :3] @ np.diag([1, -1, -1])
    if message.get_type() == "ODOMETRY":
        w, v = message.q[0], np.array(message.q[1:])
        vector = 2 * np.arctan2(np.linalg.norm(v), w) * v / np.linalg.norm(v)
        np.testing.assert_allclose(vector, rotation_vector(flipped), atol=1e-6)
        speed = [message.vx, message.vy, message.vz]
        np.testing.assert_allclose(speed, flight.velocity * [1, -1, -1], atol=1e-5)
        np.testing.assert_allclose(
            [message.rollspeed, message.pitchspeed, message.yawspeed], flight.turn * [1, -1, -1], atol=1e-5
        )
    else:
        by_angles = (
            rotation_matrix([0, 0, message.yaw]) @ rotation_matrix([0, message.pitch, 0])
            @ rotation_matrix([message.roll, 0, 0])
        )  # fmt: skip
        np.testing.assert_allclose(by_angles, flipped, atol=1e-6)


def test_covariance_is_that_of_the_numbers_in_the_message():
    """NEES: poses that err as their covariance says, in roll, pitch and yaw of the message, are chi-square of 6."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * [[0.01], [0.02], [0.03], [0.05], [0.1], [0.2]]
    covariance = root @ root.T
    flight = Flight("vision_position_estimate")
    flight.T[:3, :3] = rotation_matrix([0.3, -0.6, 2.0])
    flight.on()
    truth, T = flight.last, flight.T
    squares = []
    for _ in range(2000):
        flight.sender.reset()
        error = root @ rng.normal(size=6)
        moved = T.copy()
        moved[:3, :3], moved[:3, 3] = rotation_matrix(error[:3]) @ T[:3, :3], T[:3, 3] + error[3:]
        flight.stamp_ns += STEP_NS
        flight.link.ns += STEP_NS
        assert flight.sender.pose(flight.stamp_ns, moved, covariance)
        off = np.array(
            [getattr(flight.last, name) - getattr(truth, name) for name in ["x", "y", "z", "roll", "pitch", "yaw"]]
        )
        off[3:] = (off[3:] + np.pi) % (2 * np.pi) - np.pi
        said = np.zeros((6, 6))
        said[np.triu_indices(6)] = flight.last.covariance
        said = said + np.triu(said, 1).T
        squares.append(off @ np.linalg.solve(said, off))
    assert np.mean(squares) == pytest.approx(6, rel=0.05)
    assert np.mean(np.array(squares) < 12.59) == pytest.approx(0.95, abs=0.02)


def test_what_is_not_known_of_the_covariance_is_said_with_nan():
    level = (0.0, 0.0, 0.0)
    assert not np.isnan(upper_triangle(np.eye(6), level)).any()
    for covariance, angles in ((None, level), (np.full((6, 6), np.inf), level), (np.eye(6), (0.0, radians(90), 0.0))):
        assert np.isnan(upper_triangle(covariance, angles)[0])


@pytest.mark.parametrize("unknown", [np.full((4, 4), nan), REFLECTED, STRETCHED])
def test_nothing_is_sent_of_a_lost_vehicle_and_the_reset_is_counted(flight, unknown):
    flight.on(10)
    sent = flight.sender.sent
    assert not flight.sender.pose(flight.stamp_ns + STEP_NS, unknown)
    flight.sender.lost("the camera is covered")
    assert flight.sender.sent == sent == len(flight.link.out)
    assert flight.told == ["test:: no pose is sent: the pose is not known"]
    flight.on(10)
    assert {message.reset_counter for message in flight.link.out[:sent]} == {0}
    assert {message.reset_counter for message in flight.link.out[sent:]} == {1}
    assert flight.told[1:] == ["test:: poses are sent again"]


def test_a_jump_and_a_corrected_map_are_resets_and_motion_is_none(flight):
    flight.on(10)
    flight.T[0, 3] += 3.0
    flight.on(10)
    assert flight.last.reset_counter == 1
    assert flight.told == []
    flight.sender.reset()
    flight.on(10)
    assert flight.last.reset_counter == flight.sender.reset_counter == 2
    if flight.last.get_type() == "ODOMETRY":
        assert max(abs(message.vx) for message in flight.link.out) == pytest.approx(1.0, abs=1e-3)


def test_late_repeated_and_failed_poses_are_not_sent(flight):
    flight.on(10)
    sent = flight.sender.sent
    flight.delay_ns = 300_000_000
    assert not any(flight.on(5))
    assert "0.29 s old, more than 0.2 s" in flight.told[-1]
    flight.delay_ns = 10_000_000
    flight.on(5)
    assert flight.sender.sent > sent
    sent = flight.sender.sent
    assert not flight.sender.pose(flight.stamp_ns, flight.T)
    assert not any(flight.on(3, quality=-1))
    assert flight.sender.sent == sent


def test_no_more_than_was_asked_for(flight):
    fast = Flight(flight.sender._message, rate_hz=10)
    fast.on(60)
    assert fast.sender.sent == pytest.approx(20, abs=1)


def test_poses_that_come_faster_go_out_at_the_rate_asked_for():
    sender = PoseSender(link := Link(), message="vision_position_estimate", rate_hz=30)
    for k in range(400):
        link.ns = 10**12 + 5_000_000 * k
        sender.pose(link.ns, np.eye(4))
    assert sender.sent == pytest.approx(60, abs=1)


def test_half_a_second_without_poses_is_a_reset(flight):
    flight.on(10)
    flight.stamp_ns += 600_000_000
    flight.on(10)
    assert flight.last.reset_counter == 1


def test_impossible_numbers_are_not_sent(flight):
    flight.on(2)
    assert flight.on(covariance=np.full((6, 6), 1e200)) == [True]
    away = np.eye(4)
    away[0, 3] = 1e300
    assert not flight.sender.pose(flight.stamp_ns + STEP_NS, away)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"message": "odom"}, "odometry or vision_position_estimate"),
        ({"rate_hz": 0.1}, "rate_hz"),
        ({"max_age_s": 2.0}, "max_age_s"),
    ],
)
def test_options_that_cannot_be(options, said):
    with pytest.raises(StereovoxError, match=said):
        PoseSender(Link(), **options)
