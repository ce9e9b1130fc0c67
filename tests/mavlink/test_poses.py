"""Poses of an autopilot in another process, and of messages made here."""

import math
import threading
from time import monotonic, monotonic_ns

import numpy as np
import pytest
from autopilot import flown

from stereovox import StereovoxError, receive_poses
from stereovox.mavlink.link import MavlinkLink
from stereovox.mavlink.poses import PoseReceiver

PATIENCE_S = 60.0


class Taken:
    """Poses that came, and when."""

    def __init__(self):
        self.poses, self.came = [], threading.Condition()

    def add(self, stamp_ns, T_world_body):
        with self.came:
            self.poses.append((stamp_ns, T_world_body, monotonic_ns()))
            self.came.notify_all()

    def wait_for(self, number):
        end = monotonic() + PATIENCE_S
        with self.came:
            while len(self.poses) < number:
                assert self.came.wait(max(end - monotonic(), 0.001)), f"{len(self.poses)} poses came"
            return list(self.poses)


def expected(seconds):
    """T_world_body at a time of the autopilot, from its own words: axes one by one."""
    n, e, d, roll, pitch, yaw = flown(seconds)
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    ned_of_front = np.array([cy * cp, sy * cp, -sp])
    ned_of_right = np.array([cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr])
    ned_of_down = np.array([cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr])
    nwu = np.array([1.0, -1, -1])
    T = np.eye(4)
    T[:3, :3] = np.column_stack([nwu * ned_of_right, nwu * ned_of_down, nwu * ned_of_front])
    T[:3, 3] = nwu * [n, e, d]
    return T


@pytest.mark.parametrize(("poses", "coarse"), [("odometry", 0.002), ("local", 0.01), ("angles", 0.01)])
def test_poses_come_in_our_frames_and_time(start_autopilot, poses, coarse):
    autopilot, taken, told = start_autopilot(ahead_s=1234.5, poses=poses), Taken(), []
    with receive_poses(autopilot.url, taken, tell=told.append) as receiver:
        found = taken.wait_for(60)[20:]
        error_ns = receiver.link.clock.error_ns
    assert error_ns is not None
    assert error_ns < 50_000_000
    for stamp_ns, T, came_ns in found:
        assert -error_ns <= came_ns - stamp_ns
        true = expected(stamp_ns / 1e9 + 1234.5)
        slack = 2.3 * error_ns / 1e9 + coarse  # it moves 2 m and turns 0.5 radians a second
        assert np.abs(T - true).max() < slack
    assert set(receiver.passed_over) <= {"clock", "no attitude"}


def test_stamps_ascend_and_are_spaced_as_sent(start_autopilot):
    autopilot, taken = start_autopilot(ahead_s=-3.0, poses="odometry"), Taken()
    with receive_poses(autopilot.url, taken, tell=lambda line: None):
        stamps = [stamp for stamp, *_ in taken.wait_for(80)]
    assert np.median(np.diff(stamps)) == pytest.approx(20e6, rel=0.5)


def test_the_autopilot_learns_our_time(start_autopilot):
    autopilot = start_autopilot(ahead_s=77.0)
    with MavlinkLink(autopilot.url):
        answer = autopilot.wait_for("answer")[0]
    assert abs(answer["tc1"] / 1e9 + 77.0 - answer["ts1"] / 1e9) < 5


class QuietLink:
    """A link without an other end; messages are put in by hand. Its clock is known: a second ahead."""

    url = "test"

    def __init__(self, now_ns=10**12):
        from stereovox.mavlink.link import RemoteClock

        self.clock, self.handlers, self.now = RemoteClock(), [], now_ns
        self.clock.answered(now_ns, now_ns + 10**9, now_ns)

    def listen(self, handler):
        self.handlers.append(handler)

    def ignore(self, handler):
        self.handlers.remove(handler)

    def put(self, message, after_ns=0):
        self.handlers[0](message, self.now + after_ns)


def odometry(seconds=1001.0, frame=1, child=12, q=(1.0, 0, 0, 0), xyz=(1.0, 2.0, 3.0), quality=0, resets=0):
    from pymavlink.dialects.v20 import ardupilotmega as m

    none = [0.0] * 21
    return m.MAVLink_odometry_message(
        round(1e6 * seconds), frame, child, *xyz, q, 0, 0, 0, 0, 0, 0, none, none, resets, 0, quality
    )


@pytest.fixture
def quiet():
    link, taken, told = QuietLink(), Taken(), []
    return link, taken, told, PoseReceiver(link, taken, tell=told.append)


def test_ned_becomes_north_west_up(quiet):
    link, taken, told, _ = quiet
    link.put(odometry())
    stamp_ns, T, _ = taken.poses[0]
    assert stamp_ns == 10**12
    assert T[:3, 3].tolist() == [1, -2, -3]
    assert T[:3, :3].round(9).tolist() == [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # right is -y, down -z, ahead x
    assert not told


@pytest.mark.parametrize(
    ("message", "words", "reason"),
    [
        (odometry(frame=18), "frames 18 and 12", "frame"),
        (odometry(child=1), "frames 1 and 1", "frame"),
        (odometry(quality=-1), "has failed", "quality"),
        (odometry(xyz=(math.nan, 0, 0)), "no numbers", "not finite"),
        (odometry(q=(0.5, 0, 0, 0)), "no numbers", "not finite"),
        (odometry(seconds=1010.0), "times those of TIMESYNC", "stamp"),
        (odometry(seconds=900.0), "times those of TIMESYNC", "stamp"),
    ],
)
def test_poses_that_cannot_be_trusted_are_passed_over_and_told_once(quiet, message, words, reason):
    link, taken, told, receiver = quiet
    link.put(message)
    link.put(message)
    assert taken.poses == []
    assert receiver.taken == 0
    assert receiver.passed_over == {reason: 2}
    assert len(told) == 1
    assert words in told[0]


def test_nothing_is_taken_before_the_clock_is_known(quiet):
    from stereovox.mavlink.link import RemoteClock

    link, taken, _told, receiver = quiet
    link.clock = RemoteClock()
    link.put(odometry())
    assert taken.poses == []
    assert receiver.passed_over == {"clock": 1}


def flying(ms, start_deg=0.0, origin=(0.0, 0.0, 0.0), resets=0):
    """ODOMETRY of a vehicle that flies at 2 m/s and turns by 30 degrees a second, in a world turned and shifted."""
    along, turned_deg = 0.002 * ms, 0.03 * ms
    yaw, start = math.radians(start_deg + turned_deg), math.radians(start_deg)
    north, east = origin[0] + along * math.cos(start), origin[1] + along * math.sin(start)
    q = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
    return odometry(1001 + ms / 1000, q=q, xyz=(north, east, origin[2]), resets=resets)


def test_poses_go_on_after_a_reset(quiet):
    link, taken, told, _ = quiet
    elsewhere = {"start_deg": 70.0, "origin": (-20.0, 8.0, 1.5), "resets": 1}
    again = {"start_deg": -130.0, "origin": (3.0, 3.0, 0.0), "resets": 2}
    for ms in range(0, 200, 20):
        link.put(flying(ms, **({} if ms < 60 else elsewhere if ms < 120 else again)), ms * 1_000_000)
    plain, straight = QuietLink(), Taken()
    PoseReceiver(plain, straight)
    for ms in range(0, 200, 20):
        plain.put(flying(ms), ms * 1_000_000)
    assert len(taken.poses) == 10
    for (stamp_ns, T, *_), (expected_ns, expected, *_) in zip(taken.poses, straight.poses, strict=True):
        assert stamp_ns == expected_ns
        np.testing.assert_allclose(T, expected, atol=1e-5)
    assert [line.rpartition(": ")[2] for line in told] == ["poses go on from those before it"] * 2


@pytest.mark.parametrize("before_ms", [[400], [0, 100], [590, 600], [400, 400]])
def test_poses_jump_after_a_reset_where_nobody_knows_what_was_before(quiet, before_ms):
    link, taken, told, _ = quiet
    for ms in before_ms:
        link.put(flying(ms), ms * 1_000_000)
    link.put(flying(700, origin=(5.0, 0.0, 0.0), resets=1), 700_000_000)
    assert taken.poses[-1][1][0, 3] == pytest.approx(6.4)
    assert [line.partition(": ")[2] for line in told] == ["poses jump, and what is mapped stays where it is"]


def test_odometry_is_preferred_to_the_local_position(quiet):
    from pymavlink.dialects.v20 import ardupilotmega as m

    link, taken, _told, _ = quiet
    link.put(odometry())
    link.put(m.MAVLink_attitude_message(1_000_990, 0, 0, 0, 0, 0, 0))
    link.put(m.MAVLink_local_position_ned_message(1_001_000, 9, 9, 9, 0, 0, 0))
    link.put(m.MAVLink_attitude_message(1_001_010, 0, 0, 0, 0, 0, 0))
    assert len(taken.poses) == 1


def test_a_position_waits_for_the_attitude_after_it(quiet):
    from pymavlink.dialects.v20 import ardupilotmega as m

    link, taken, _told, receiver = quiet
    link.put(m.MAVLink_attitude_message(1_000_990, 0, 0, 0.0, 0, 0, 0))
    link.put(m.MAVLink_local_position_ned_message(1_001_000, 1, 2, 3, 0, 0, 0))
    assert taken.poses == []
    link.put(m.MAVLink_attitude_message(1_001_010, 0, 0, 0.2, 0, 0, 0))
    _, T, _ = taken.poses[0]
    assert T[:3, 2] == pytest.approx([math.cos(0.1), -math.sin(0.1), 0])  # halfway: yaw to the right is to -y
    link.put(m.MAVLink_local_position_ned_message(1_001_020, 1, 2, 3, 0, 0, 0))
    link.put(m.MAVLink_attitude_message(1_001_500, 0, 0, 0.2, 0, 0, 0))  # half a second later says nothing of it
    assert len(taken.poses) == 1
    assert receiver.passed_over == {"no attitude": 1}


def test_others_are_not_listened_to(start_autopilot):
    """A message with another system's number is not the vehicle's."""
    autopilot, taken = start_autopilot(poses="odometry"), Taken()
    with MavlinkLink(autopilot.url, system=7) as link, PoseReceiver(link, taken):
        autopilot.wait_for("HEARTBEAT", number=3)
    assert taken.poses == []


def test_one_that_raises_does_not_end_the_connection(start_autopilot):
    autopilot, told, count = start_autopilot(poses="odometry"), [], []

    class Broken:
        def add(self, stamp_ns, T_world_body):
            count.append(stamp_ns)
            raise StereovoxError("no room")

    with receive_poses(autopilot.url, Broken(), tell=told.append):
        end = monotonic() + PATIENCE_S
        while len(count) < 3 and monotonic() < end:
            autopilot.wait_for("HEARTBEAT")
    assert len(count) >= 3
    assert [line for line in told if "no room" in line] == [f"{autopilot.url}: ODOMETRY cannot be used: no room"]
