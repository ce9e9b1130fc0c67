# SPDX-License-Identifier: Apache-2.0
"""Clocks of sensors that differ from the poses' are reported; replays at any rate, pauses and loops are not."""

import made_streams
import numpy as np
import pytest
import wire

from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.frame import Cloud, Scan
from stereovox.ros.poses.clocks import Pace, SensorClocks
from stereovox.ros.poses.localization import Localization, LocalizedPoses, Localizer, LocalizingScanInput
from stereovox.ros.poses.poses import LiveEdge, PoseBuffer, SensorPoses
from stereovox.ros.subscriptions import arrived

MS, S = 1_000_000, 1_000_000_000
START = 1_700_000_000 * S
IMAGE_NS, POSE_NS = 33 * MS, 20 * MS


def at(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


class Drive:
    """Plays a robot at 1 m/s to buffer and watch, as the node hears them, for so many seconds by its true time.

    rate: of the player. step: by which stamps of images are off at a true time in seconds; pose_step: those of poses.
    hold: when, by the wall, a true time happens (pauses). late: what images take, by the wall, besides.

    Attributes: mapped: metres by which the pose of each mapped frame is wrong; refused: reasons; told: lines.
    """

    def __init__(self, seconds=6.0, rate=1.0, step=lambda s: 0.0, pose_step=lambda s: 0.0, hold=lambda s: s,
                 late=lambda s: 0.03, apart_s=0.3, loops=1, simulated=False):  # fmt: skip
        self.mapped, self.refused, self.told = [], [], []
        self.poses = PoseBuffer("odom", "", 0.1)
        self.clocks = SensorClocks(load_config("default"), apart_s, self.told.append, background=False)
        self.poses.tf.simulated = simulated
        self.random, self.queue = np.random.default_rng(0), []
        events, count_ns, last = [], round(seconds * S), {"pose": 0.0, "image": 0.0}
        for loop in range(loops):
            for kind, every_ns in (("pose", POSE_NS), ("image", IMAGE_NS)):
                for t in range(0, count_ns, every_ns):
                    wall_s = (hold(t / S) + loop * seconds) / rate
                    extra_s = (late(t / S) if kind == "image" else 0.002) + self.random.exponential(0.003)
                    last[kind] = max(last[kind], wall_s + extra_s)  # messages of a topic do not overtake each other
                    events.append((round(last[kind] * S) + 5000 * S, kind, t))
        now_ns = 0
        for now_ns, kind, t in sorted(events):
            off_ns = round((step if kind == "image" else pose_step)(t / S) * S)
            self._hear(kind, START + t + off_ns, t, now_ns)
        self._map(now_ns + S)

    def _hear(self, kind, stamp_ns, true_ns, now_ns):
        if kind == "pose":
            self.poses.tf.arrived_ns = now_ns
            told = [("odom", "eye", at(true_ns / S))]
            self.poses.on_tf(wire.packed(wire.messages().transforms(stamp_ns, told)), fixed=False)
        else:
            heard = self.clocks.heard("/eye", stamp_ns, now_ns, SensorPoses(self.poses, "eye"))
            self.queue.append((stamp_ns, true_ns, now_ns, heard))
        self._map(now_ns)

    def _map(self, now_ns):
        while self.queue:
            stamp_ns, true_ns, came_ns, heard = self.queue[0]
            ready = not heard.is_open and self.poses.is_final("eye", stamp_ns)
            if not ready and now_ns - came_ns <= S // 2:
                return
            self.queue.pop(0)
            cloud = Cloud(np.empty((0, 3), np.float32), np.eye(4), stamp_ns)
            try:
                self.clocks.check("/eye", lambda cloud=cloud: cloud, heard, now_ns)
                self.mapped.append(abs(self.poses.pose("eye", stamp_ns).T_world_sensor[0, 3] - true_ns / S))
            except FrameRefused as refused:
                self.refused.append(refused.reason)

    @property
    def doubted(self):
        return self.refused.count("clock_doubt")


def seconds_in(line: str) -> float:
    return float(line.removeprefix("/eye: images come ").split()[0])


@pytest.mark.parametrize("rate", [0.2, 0.5, 1.0, 1.05, 2.0, 10.0])
@pytest.mark.parametrize("simulated", [False, True])
def test_a_replay_at_any_rate_raises_no_doubt(rate, simulated):
    drive = Drive(rate=rate, simulated=simulated)
    assert not drive.told
    assert (drive.doubted, len(drive.mapped) > 170) == (0, True)
    assert max(drive.mapped) < 0.001


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("pause_s", [0.4, 5.0])
def test_a_pause_raises_no_doubt(rate, pause_s):
    drive = Drive(rate=rate, hold=lambda s: s + (pause_s * rate if s > 3 else 0))
    assert not drive.told
    assert drive.doubted <= 2
    assert len(drive.mapped) > 165


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
def test_a_bag_that_begins_again_raises_no_doubt(rate):
    drive = Drive(seconds=3.0, rate=rate, loops=3)
    assert not drive.told
    assert drive.doubted <= 6  # those that overtook the first poses of their round
    assert max(drive.mapped) < 0.001


def test_messages_that_come_late_now_and_then_are_mapped():
    drive = Drive(late=lambda s: 0.23 if round(s / 0.033) % 20 == 3 else 0.03)
    assert not drive.told
    assert (drive.doubted, max(drive.mapped) < 0.001) == (0, True)


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("step_s", [-0.4, -0.1, 0.3])
def test_a_clock_that_is_set_is_told_and_no_frame_mapped_at_a_wrong_pose(step_s, rate):
    drive = Drive(rate=rate, step=lambda s: step_s if s > 3 else 0)
    assert max(drive.mapped) < 0.001
    assert drive.doubted > 80
    (line,) = drive.told
    assert seconds_in(line) == pytest.approx(abs(step_s), abs=0.06)
    assert "set back" in line if step_s < 0 else "set ahead" in line
    assert "use_sim_time" in line


@pytest.mark.parametrize("off_s", [-100.0, 100.0, -1.0])
def test_a_clock_that_never_was_that_of_the_poses_is_told_once_with_by_how_much(off_s):
    drive = Drive(step=lambda s: off_s)
    assert not drive.mapped
    (line,) = drive.told
    assert seconds_in(line) == pytest.approx(abs(off_s), abs=0.06)
    assert ("ros.apart_s" in line) == (abs(off_s) < 5)


def test_sensors_that_take_long_from_the_start_are_mapped_where_that_is_allowed():
    assert not Drive(late=lambda s: 0.5).mapped
    allowed = Drive(late=lambda s: 0.5, apart_s=0.6)
    assert (allowed.told, allowed.doubted, max(allowed.mapped) < 0.001) == ([], 0, True)


@pytest.mark.parametrize("late_s", [0.0, 0.03])
@pytest.mark.parametrize("step_s", [-0.4, 0.4])
def test_poses_of_a_clock_that_is_set_do_not_mix_with_older_ones(step_s, late_s):
    drive = Drive(pose_step=lambda s: step_s if s > 3 else 0, late=lambda s: late_s)
    assert len(drive.told) == 1
    assert drive.doubted > 60
    assert max(drive.mapped) < 0.021  # across the step it lies between poses of either clock


def test_an_edge_set_back_by_little_drops_the_poses_of_the_older_clock():
    now = [0]
    edge = LiveEdge("odom", "base", lambda: now[0])
    for k in range(100):
        now[0] = START + k * POSE_NS
        edge.add(START + k * POSE_NS - (400 * MS if k >= 50 else 0), (float(k), 0, 0, 0, 0, 0, 1))
    stamps, rows = edge._in_order()
    assert (np.diff(stamps) == POSE_NS).all()
    np.testing.assert_array_equal(rows[:, 0], [*range(30), *range(50, 100)])


def test_transforms_that_come_late_all_at_once_are_put_in_their_places():
    now = [0]
    edge = LiveEdge("odom", "base", lambda: now[0])
    order = [*range(50), *range(60, 70), *range(50, 60), *range(70, 100)]
    for k in order:
        now[0] = START + max(k, 69 if 50 <= k < 70 else 0) * POSE_NS
        edge.add(START + k * POSE_NS, (float(k), 0, 0, 0, 0, 0, 1))
    np.testing.assert_array_equal(edge._in_order()[1][:, 0], range(100))


def test_a_sensor_is_compared_with_what_moves_it_not_with_a_frame_dated_ahead():
    poses = PoseBuffer("map", "", 0.1)
    poses.on_tf(wire.packed(wire.messages().transforms(0, [("base", "eye", at(0))])), fixed=True)
    for k in range(50):
        poses.tf.arrived_ns = START + k * POSE_NS
        for stamp_ns, parent, child in ((0, "odom", "base"), (S, "map", "odom")):
            told = wire.messages().transforms(START + k * POSE_NS + stamp_ns, [(parent, child, at(k))])
            poses.on_tf(wire.packed(told), fixed=False)
    pace = poses.pace("eye")
    edge = poses.tf._up("base")
    assert isinstance(edge, LiveEdge)
    assert pace is not None
    assert pace is edge.pace
    assert pace.rate == 1
    assert poses.pace("nothing") is None


def test_poses_that_come_in_bursts_say_nothing_of_clocks():
    pace = Pace()
    for k in range(20):
        pace.heard(START + k * 100 * MS, START + k // 5 * 100 * MS)
    assert np.isnan(pace.rate)


class Nowhere(Localization):
    def add(self, scan):
        raise AssertionError("it was used")

    def restart(self):
        """Nothing is there to begin again."""


def test_a_scan_in_doubt_does_not_localise():
    one = Localizer(Nowhere(), LocalizedPoses("", "", 0.1, "odom"), lambda found: None)
    scan = Scan(np.ones(3, np.float32), 0.0, 0.1, 0.1, 5.0, np.eye(4))

    def doubted(frame_id, stamp_ns):
        raise FrameRefused("clock_doubt", "in doubt")

    data = wire.packed(wire.messages().scan(scan, "laser"))
    assert LocalizingScanInput("/scan", one, mapped=False).frame(data, doubted) is None
    assert dict(one.refused) == {"clock_doubt": 1}


def test_when_a_message_was_received_counts_not_when_it_is_read(monkeypatch):
    monkeypatch.setattr("stereovox.ros.subscriptions.epoch_ns", lambda: START + 5 * S)
    monkeypatch.setattr("stereovox.ros.subscriptions.monotonic_ns", lambda: 90 * S)
    assert arrived({"received_timestamp": START + 3 * S}) == 88 * S
    assert arrived({"received_timestamp": 0}) == arrived({}) == arrived({"received_timestamp": START + 6 * S}) == 90 * S


@pytest.fixture
def domain(monkeypatch, domains):
    rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domains[1]))
    rclpy.init(args=[])
    yield
    rclpy.shutdown()


def on_time(s: float) -> float:
    return 0.0


@pytest.mark.parametrize(
    ("topics", "pose_step", "off_s"),
    [
        ({"/b": on_time, "/a": lambda s: 100.0}, on_time, 100.0),
        ({"/a": on_time}, lambda s: -0.4 if s > 0.5 else 0.0, 0.4),
    ],
    ids=["second-camera", "poses"],
)
def test_the_node_finds_clocks_by_motion_and_maps_nothing_at_a_wrong_pose(
    topics, pose_step, off_s, domain, monkeypatch
):
    told = made_streams.stream(monkeypatch, topics, pose_step, count=62)
    assert max(max(one) for one in told.wrong_m.values()) < 0.03
    assert len(told.wrong_m["/a"]) > 15
    assert max(told.taken_s["/a"]) > 1.9
    assert set(told.refused) == {"/a"}
    assert set(told.refused["/a"]) <= {"clock_doubt", "out_of_order", "no_pose", "pose_extrapolated"}
    (noticed_s, first), (found_s, then) = told.lines
    assert first.startswith("/a: images come ")
    assert noticed_s < found_s < 1.7
    assert float(then.split("its clock is ")[1].split()[0]) == pytest.approx(off_s, abs=0.02)
