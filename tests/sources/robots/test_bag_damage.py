# SPDX-License-Identifier: Apache-2.0
"""Robots' bags that are damaged or cut off: one line each, or a fault, and no memory for what is not there."""

from __future__ import annotations

import random
import tracemalloc
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from made_robot_bags import MS, START_NS, RobotBagMaker, planar_numbers

from stereovox.errors import SourceError
from stereovox.frame import Scan
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.robots.bag import RobotBag

ENDINGS = pytest.mark.parametrize("ending", [".bag", ".db3"])
FAULTS = {None, "unreadable", "no_pose", "no_camera", "bad_dtype", "bad_shape"}
ENOUGH = 30_000_000


class Scrambler(RobotBagMaker):
    """Damages bytes of some messages, in a file that is otherwise whole."""

    def __init__(self, path: Path, seed: int):
        super().__init__(path)
        self._dice = random.Random(seed)

    def add(self, topic: str, kind: str, recorded_ns: int, message: Any) -> None:
        raw, dice = bytearray(self.raw(kind, message)), self._dice
        for _ in range(dice.choice((0, 0, 1, 3))):
            raw[dice.randrange(len(raw))] = dice.choice((0, 1, 127, 255, dice.randrange(256)))
        super().add(topic, kind, recorded_ns, bytes(raw))


def record(bag: RobotBagMaker) -> Path:
    with bag:
        bag.tf(START_NS, "base_link", "laser", planar_numbers(0.2, 0, 0), "/tf_static")
        bag.tf(START_NS, "base_link", "optical", planar_numbers(0.1, 0, 0), "/tf_static")
        for k in range(4):
            stamp_ns = START_NS + k * 100 * MS
            bag.tf(stamp_ns, "map", "odom", planar_numbers(1, 1, 1))
            bag.add("/odom", "nav_msgs/Odometry", stamp_ns, bag.odometry(stamp_ns, planar_numbers(0.1 * k, 0, 0)))
            cloud = bag.cloud(stamp_ns, np.ones((5, 3)), "laser")
            bag.add("/points", "sensor_msgs/PointCloud2", stamp_ns, cloud)
        bag.scans(3)
        bag.depth(3)
    return bag.path


def outcomes(path: Path) -> set[str | None]:
    """Open a file in two ways and take everything; also no warning may come out."""
    found: set[str | None] = set()
    for query in ("", "?scan=/points&odom=/odom"):
        try:
            robot = RobotBag(f"{path}{query}")
        except SourceError as error:
            found.add(f"{error}")
            continue
        for seen in [*robot.scans, *robot.frames]:
            assert "\n" not in seen.fault_detail
            assert (seen.fault is None) == (seen.fault_detail == "")
            assert (seen.fault is None) == bool(np.isfinite(seen.T_world_sensor).all())
            found.add(seen.fault)
    return found


def bounded(path: Path) -> set[str | None]:
    tracemalloc.start()
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = outcomes(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < ENOUGH
    said = {text for text in found if text not in FAULTS}
    assert all("\n" not in text and path.name in text for text in said)
    return {"closed" if text in said else text for text in found}


@ENDINGS
def test_a_bag_that_breaks_off(tmp_path, ending):
    data, found = record(RobotBagMaker(tmp_path / f"a{ending}")).read_bytes(), set()
    for length in range(20, len(data), len(data) // 12):
        (tmp_path / f"cut{ending}").write_bytes(data[:length])
        found |= bounded(tmp_path / f"cut{ending}")
    assert "closed" in found


@ENDINGS
@pytest.mark.parametrize("seed", range(3))
def test_damaged_bytes(tmp_path, ending, seed):
    data, dice, found = record(RobotBagMaker(tmp_path / f"a{ending}")).read_bytes(), random.Random(seed), set()
    for _ in range(12):
        damaged = bytearray(data)
        for _ in range(dice.randint(1, 40)):
            damaged[dice.randrange(len(data))] = dice.choice((0, 1, 127, 255, dice.randrange(256)))
        (tmp_path / f"damaged{ending}").write_bytes(damaged)
        found |= bounded(tmp_path / f"damaged{ending}")
    assert None in found or "closed" in found
    assert len(found) > 1


@ENDINGS
def test_damaged_messages_in_a_file_that_is_whole(tmp_path, ending):
    found: set[str | None] = set()
    for seed in range(12):
        found |= bounded(record(Scrambler(tmp_path / f"scrambled{seed}{ending}", seed)))
    assert {None, "unreadable", "no_pose"} <= found


def test_a_recording_that_was_cut_off_says_so(tmp_path):
    whole = tmp_path / "whole.mcap"
    with BagWriter(whole) as bag:
        for k in range(200):
            stamp_ns = START_NS + k * 100 * MS
            bag.odometry(stamp_ns, [0.1 * k, 0, 0])
            noise = np.random.default_rng(k).uniform(1, 4, 2000).astype(np.float32)
            bag.scan(Scan(noise, -1.0, 1e-3, 0.1, 5.0, np.eye(4), stamp_ns=stamp_ns))
    assert not any("scanned from" in note for note in RobotBag(str(whole)).notes)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 6 // 10])
    robot = RobotBag(str(cut))
    assert 0 < len(robot.scans) < 200
    assert any(note.startswith(str(cut)) and "scanned from" in note for note in robot.notes)
