"""Obstacle distances as an autopilot in another process reads them."""

from threading import Event

import numpy as np
import pytest

from stereovox import Cloud, Mapper, MapRun, ObstacleSender, Range, StereovoxError, open_source
from stereovox.geometry.se3 import inverse
from stereovox.mavlink.link import MavlinkLink
from stereovox.mavlink.sectors import DirectionRules, SectorRules, obstacle_sectors
from stereovox.mavlink.sending import HIGHEST_RATE_HZ

RULES = SectorRules(max_distance=4.0)


class Clock:
    """A clock that only moves when a test sets it."""

    def __init__(self):
        self.ns = 10**12

    def __call__(self):
        return self.ns


@pytest.fixture(scope="module")
def frames():
    return list(open_source("sim:room?image_width=212", frames=":30:3"))


@pytest.fixture
def mapped(frames):
    """A mapper whose clock stands, so that its map is always fresh."""
    mapper = Mapper("default", voxel_size=0.1, clock=Clock())
    reports = [mapper.add(frame) for frame in frames]
    return mapper, frames[-1], reports[-1]


def test_an_autopilot_reads_what_the_map_says(start_autopilot, mapped):
    mapper, frame, report = mapped
    autopilot = start_autopilot()
    with ObstacleSender(mapper, autopilot.url, rate_hz=20, rules=RULES) as sender:
        sender.after(frame, report)
        message = autopilot.wait_for("OBSTACLE_DISTANCE")[0]
    said = obstacle_sectors(mapper.map, frame.T_world_sensor, RULES)
    assert message["distances"] == said.centimetres(RULES).tolist()
    assert (message["frame"], message["increment_f"], message["increment"]) == (12, 5.0, 5)
    assert (message["angle_offset"], message["min_distance"], message["max_distance"]) == (0.0, 0, 400)
    assert message["from"] == [1, 196]
    reach = np.minimum(said.free_m, 4.01)
    for i, read in enumerate(message["px4"]):
        assert read == "free" or read == pytest.approx(reach[2 * i], abs=0.01)
    for k, read in enumerate(message["ardupilot"]):
        near = min(reach[j] for j in range(72) if int((5 * j + 22.5) % 360 // 45) == k)
        assert read == (None if near > 4 else pytest.approx(near, abs=0.01))
    heartbeat = next(m for m in autopilot.told if m["is"] == "HEARTBEAT")
    assert (heartbeat["type"], heartbeat["autopilot"]) == (18, 8)  # onboard controller, no autopilot


def test_nothing_is_sent_until_a_second_frame_agrees_with_the_first(start_autopilot, frames):
    mapper = Mapper("default", voxel_size=0.1, clock=Clock())
    with ObstacleSender(mapper, start_autopilot().url, rate_hz=None, rules=RULES) as sender:
        sender.after(frames[0], mapper.add(frames[0]))
        assert (sender.send(), sender.sent) == ("", 0)
        sender.after(frames[1], mapper.add(frames[1]))
        assert (sender.send(), sender.sent) == ("", 1)


def test_the_rate_is_the_declared_one(start_autopilot, mapped):
    mapper, frame, report = mapped
    autopilot = start_autopilot()
    with ObstacleSender(mapper, autopilot.url, rate_hz=25, rules=RULES) as sender:
        sender.after(frame, report)
        came = [message["at"] for message in autopilot.wait_for("OBSTACLE_DISTANCE", number=50)]
    assert 1 / np.mean(np.diff(came)) < 30  # slower on a busy machine, never faster


def test_each_message_tells_when_its_frame_came(start_autopilot, mapped):
    mapper, frame, report = mapped
    autopilot = start_autopilot()
    with MavlinkLink(autopilot.url) as link, ObstacleSender(mapper, link, rate_hz=20, max_age_s=2.0) as sender:
        mapper._intake.monitor.now._clock.ns += 10**9  # the frame is a second old
        sender.after(frame, report)
        message = autopilot.wait_for("OBSTACLE_DISTANCE")[0]
    assert 0.9 < message["at"] - message["time_usec"] / 1e6 < 10


def test_a_stale_map_is_not_sent_and_told_once(start_autopilot, mapped, frames):
    mapper, frame, report = mapped
    autopilot, told = start_autopilot(), []
    with ObstacleSender(mapper, autopilot.url, rate_hz=50, max_age_s=0.5, tell=told.append) as sender:
        sender.after(frame, report)
        autopilot.wait_for("OBSTACLE_DISTANCE", number=3)
        mapper._intake.monitor.now._clock.ns += 600_000_000
        autopilot.wait_for("HEARTBEAT")
        autopilot.wait_for("HEARTBEAT")
        sent = sender.sent
        autopilot.drain()
        silence = [m["is"] for m in autopilot.wait_for("HEARTBEAT") + autopilot.drain()]
        assert "OBSTACLE_DISTANCE" not in silence
        assert sender.sent == sent
        assert told == ["no obstacle distances are sent: the last trusted frame of camera is 0.60 s old"]
        again = next(iter(open_source("sim:room", frames="33:34")))
        sender.after(again, mapper.add(again))
        autopilot.wait_for("OBSTACLE_DISTANCE")
    assert told[1:] == ["obstacle distances are sent again"]


def test_a_refused_frame_makes_nothing_fresh(start_autopilot, frames):
    mapper = Mapper("default", voxel_size=0.1)
    autopilot = start_autopilot()
    with ObstacleSender(mapper, autopilot.url, rate_hz=50) as sender:
        bad = frames[0].__class__(frames[0].depth, frames[0].camera, np.full((4, 4), np.nan), 5, 0.001)
        report = mapper.add(bad)
        assert report.refused
        sender.after(bad, report)
        autopilot.wait_for("HEARTBEAT")
        autopilot.wait_for("HEARTBEAT")
        assert sender.sent == 0


def test_the_sensor_that_is_silent_longest_counts(start_autopilot, frames):
    from dataclasses import replace

    clock, told = Clock(), []
    mapper = Mapper("default", voxel_size=0.1, clock=clock)
    autopilot = start_autopilot()
    with ObstacleSender(mapper, autopilot.url, rate_hz=50, tell=told.append) as sender:
        left, right = (replace(frames[0], sensor=name) for name in ("left", "right"))
        sender.after(left, mapper.add(left))
        sender.after(right, mapper.add(right))
        autopilot.wait_for("OBSTACLE_DISTANCE")
        clock.ns += 300_000_000
        newer = replace(frames[1], sensor="left")
        sender.after(newer, mapper.add(newer))
        clock.ns += 300_000_000
        autopilot.wait_for("HEARTBEAT", number=3)
    assert "frame of right is 0.60 s old" in told[0]


def test_a_mount_turns_the_sectors(start_autopilot, mapped):
    """A camera that looks to the right sees what is at 90 degrees of the vehicle."""
    mapper, frame, report = mapped
    T_body_camera = np.eye(4)
    T_body_camera[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # its z is the body's x, to the right
    autopilot = start_autopilot()
    with ObstacleSender(mapper, autopilot.url, rules=RULES, mounts={"": T_body_camera}) as sender:
        sender.after(frame, report)
        distances = autopilot.wait_for("OBSTACLE_DISTANCE")[0]["distances"]
    T_world_body = frame.T_world_sensor @ inverse(T_body_camera)
    assert distances == obstacle_sectors(mapper.map, T_world_body, RULES).centimetres(RULES).tolist()
    ahead = obstacle_sectors(mapper.map, frame.T_world_sensor, RULES).centimetres(RULES)
    assert distances == np.roll(ahead, 18).tolist()


def test_directions_come_as_one_look_round(start_autopilot, mapped):
    mapper, frame, report = mapped
    autopilot = start_autopilot()
    rules = DirectionRules(max_distance=2.0)
    with ObstacleSender(mapper, autopilot.url, rate_hz=5, directions=rules) as sender:
        sender.after(frame, report)
        first = autopilot.wait_for("OBSTACLE_DISTANCE_3D")[0]
        autopilot.wait_for("OBSTACLE_DISTANCE")
        looks = [m for m in [first, *autopilot.told] if m["is"] == "OBSTACLE_DISTANCE_3D"]
    assert {m["frame"] for m in looks} == {12}
    assert {m["obstacle_id"] for m in looks} == {65535}
    one_look = [m for m in looks if m["time_boot_ms"] == first["time_boot_ms"]]
    assert len(one_look) > 10
    assert all(0 < np.linalg.norm([m["x"], m["y"], m["z"]]) <= 2.0 + 1e-6 for m in looks)


def test_where_directions_cannot_be_told_nothing_is(start_autopilot, mapped, monkeypatch):
    def broken(*_):
        raise StereovoxError("too many cells")

    monkeypatch.setattr("stereovox.mavlink.sending.nearest_places", broken)
    mapper, frame, report = mapped
    told = Event()
    said = []

    def tell(line):
        said.append(line)
        told.set()

    with ObstacleSender(mapper, start_autopilot().url, directions=DirectionRules(), tell=tell) as sender:
        sender.after(frame, report)
        assert told.wait(30)
    assert said == ["no obstacle distances are sent: too many cells"]
    assert sender.sent == 0


def test_it_observes_a_run(start_autopilot, tmp_path):
    autopilot = start_autopilot()
    with (
        MapRun("sim:room?image_width=160", tmp_path / "room.svox", frames=":20") as run,
        ObstacleSender(run.mapper, autopilot.url, rate_hz=100, max_age_s=60) as sender,
    ):
        run.finish([sender])
        autopilot.wait_for("OBSTACLE_DISTANCE")


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"rate_hz": 0}, "rate_hz"),
        ({"rate_hz": HIGHEST_RATE_HZ + 1}, "rate_hz"),
        ({"max_age_s": 0}, "max_age_s"),
        ({"mounts": {"left": np.zeros((4, 4))}}, "mounts"),
    ],
)
def test_bad_values_are_refused(bad, words):
    with pytest.raises(StereovoxError, match=words):
        ObstacleSender(Mapper("default"), "udpout:127.0.0.1:14550", **bad)


def test_a_lidar_looks_along_its_own_axes(start_autopilot, mapped):
    """The same pose, told once by a camera and once by a lidar: the autopilot hears the same."""
    mapper, frame, report = mapped
    autopilot, heard = start_autopilot(), []
    T_world_lidar = frame.T_world_sensor @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    for seen in (frame, Cloud(np.ones((1, 3)), T_world_lidar)):
        with ObstacleSender(mapper, autopilot.url, rate_hz=20, rules=RULES) as sender:
            sender.after(seen, report)
            heard.append(autopilot.wait_for("OBSTACLE_DISTANCE")[0]["distances"])
        autopilot.drain()
    assert heard[0] == heard[1]


def test_a_sonar_gives_a_pose_only_if_its_mount_is_named(start_autopilot, mapped):
    """It may look to the side: the body would be turned, and its sectors with it."""
    mapper, _, report = mapped
    mount, taken = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]), []
    for mounts in ({}, {"sonar": mount}):
        with ObstacleSender(mapper, start_autopilot().url, rate_hz=None, rules=RULES, mounts=mounts) as sender:
            sender.at = lambda T, *_, **__: taken.append(T)
            sender.after(Range(1.0, mount, sensor="sonar"), report)
    np.testing.assert_allclose(taken, [np.eye(4)])


class Told(ObstacleSender):
    """A sender that only notes the poses it would tell of."""

    def __init__(self, *args, **options):
        self.poses, self.told = [], Event()
        super().__init__(*args, **options)

    def _send(self):
        self.poses.append(self._T_world_body)
        self.told.set()
        return ""


def test_a_message_waits_for_the_next_frame_and_goes_once_it_is_there(start_autopilot, mapped):
    pose = np.eye(4)
    with Told(mapped[0], start_autopilot().url, rate_hz=0.1) as sender:  # waits for up to 5 s
        sender.told.wait(0.5)
        sender.at(pose, "")
        assert sender.told.wait(4)
        assert [one is pose for one in sender.poses] == [True]
