# SPDX-License-Identifier: Apache-2.0
"""Each door refuses each bad frame with its reason, and the map stays as it was: live, a fleet's worker, ROS 2."""

import numpy as np
import pytest
import wire
from entrance_cases import SETTINGS, good
from made_doors import FAULTS, GOOD, bad_depth, bad_points, write_faulty

import stereovox as sv
from frames import digest
from stereovox.fleet import map_fleet
from stereovox.live.run import LiveRun
from stereovox.mapping.entrance import CLOUD, IMAGE
from stereovox.sources.base import Stream

START_NS, FRAME_NS = 1_700_000_000_000_000_000, 100_000_000


class Watch:
    """What became of each frame, and the map after it."""

    def __init__(self, mapper):
        self._mapper, self.refused, self.digests = mapper, [], [digest(mapper.map)]

    def after(self, frame, report):
        self.refused.append(report.refused)
        self.digests.append(digest(self._mapper.map))
        assert not report.refused or report.detail.isprintable()

    def check(self, reason):
        assert self.refused == [*GOOD * [None], reason or None]
        assert (self.digests[-1] == self.digests[-2]) == bool(reason)


@pytest.mark.parametrize("name", FAULTS)
def test_live(name, tmp_path):
    folder = write_faulty(tmp_path / "recording", name)
    with LiveRun(str(folder), tmp_path / "map.svox", **SETTINGS) as run:
        watch = Watch(run.mapper)
        run.finish([watch])
    watch.check(FAULTS[name].reason)


class Given(Stream):
    """Images with poses, the last of which went back in time."""

    name, camera, notes, posed = "camera", good(IMAGE).camera, (), True

    def __iter__(self):
        for n in range(GOOD + 1):
            yield good(IMAGE, n, stamp_ns=START_NS + (n * FRAME_NS if n < GOOD else 1))


def test_live_stamps_that_go_back(tmp_path):
    with LiveRun(Given(), tmp_path / "map.svox", **SETTINGS) as run:
        watch = Watch(run.mapper)
        run.finish([watch])
    watch.check("stamp_backwards")


def test_fleet(tmp_path):
    distributed = pytest.importorskip("distributed")
    whole = [str(write_faulty(tmp_path / name, name)) for name in FAULTS if FAULTS[name].reason]
    without = [str(write_faulty(tmp_path / "good" / name, name, GOOD)) for name in FAULTS if FAULTS[name].reason]
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        options = {**SETTINGS, "profile": "default", "box_m": 12.8, "scheduler": cluster.scheduler_address}
        made, expected = (map_fleet(some, tmp_path / f"{len(some[0])}.svox", **options) for some in (whole, without))
    found = [one["refused"] for one in made.summary()["recordings"]]
    assert found == [{fault.reason: 1} for fault in FAULTS.values() if fault.reason]
    for ours, theirs in zip(made.map.storage.blocks(), expected.map.storage.blocks(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


ROS = {"nan-pose": "pose_extrapolated", "backwards": "stamp_backwards", "stamp": "no_pose"}
"""Faults that come otherwise, or only, in messages, and how they are refused."""


class Robot:
    """The real node. Its messages are handed to what its subscriptions call."""

    def __init__(self, rclpy):
        from stereovox.ros.mapping import Mapping
        from stereovox.ros.node import MapNode
        from stereovox.ros.options import Options, freeze

        self.node = rclpy.create_node("stereovox")
        freeze(self.node, "")
        mapping = Mapping(sv.load_config("default", **SETTINGS))
        options = Options(depth=("/eye/depth",), cloud=("/points",), out="", wait_s=0.2, late_s=60.0)
        self.watch = Watch(mapping.mapper)
        self.maker = MapNode(
            self.node, mapping, options, lambda: "", lambda report: self.watch.after(None, report)
        )  # fmt: skip

    def pose(self, stamp_ns, T):
        self.maker._poses.on_tf(wire.packed(wire.messages().transforms(stamp_ns, [("odom", "eye", T)])), fixed=False)

    def send(self, topic, data):
        count = len(self.watch.refused)
        self.maker._arrived(topic, data)
        for _ in range(1000):
            self.maker.spin_once()
            if len(self.watch.refused) > count:
                return
        raise AssertionError("nothing became of it")


@pytest.fixture
def robot(monkeypatch, domains):
    rclpy = pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domains[1]))
    monkeypatch.setattr("stereovox.ros.node.IDLE_S", 0.001)
    rclpy.init(args=[])
    robot = Robot(rclpy)
    yield robot
    robot.maker.close()
    robot.node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize("name", [*FAULTS, "backwards", "stamp"])
def test_ros(name, robot):
    fault = FAULTS.get(name, FAULTS["nothing"])
    kind, topic = fault.kind, "/eye/depth" if fault.kind == IMAGE else "/points"
    robot.maker._inputs["/eye/depth"].on_camera_info(
        wire.packed(wire.messages().camera_info(good(IMAGE).camera, 5, "eye"))
    )
    for n in range(GOOD + 1):
        T = good(kind, n).T_world_sensor.copy()
        if n == GOOD:
            T[0, 3] += {"frozen": 0.1, "nan-pose": np.nan}.get(name, 0.0)
        robot.pose(START_NS + n * FRAME_NS, T)
    for n in range(GOOD + 1):
        stamp_ns, bad = START_NS + n * FRAME_NS, n == GOOD
        if bad:
            stamp_ns -= {"backwards": FRAME_NS + 1, "no-pose": -60 * 10**9, "stamp": stamp_ns - 1}.get(name, 0)
        robot.send(topic, _message(name if bad else "nothing", kind, n, stamp_ns))
    robot.watch.check(ROS.get(name, fault.reason))


def _message(name, kind, n, stamp_ns):
    if kind == CLOUD:
        points = bad_points(name) if name.startswith("cloud") else good(CLOUD, n).points
        return wire.cloud(points, stamp_ns, "eye")
    depth = bad_depth(name) if n == GOOD and name != "units" else np.rint(5000 * good(IMAGE, n).depth).astype(np.uint16)
    metres = np.where(depth > 0, depth / np.float32(5000), np.nan).astype(np.float32)
    data = wire.image(1000 * metres if name == "units" else metres, stamp_ns, "eye")
    return data[:200] if name == "damaged" else data
