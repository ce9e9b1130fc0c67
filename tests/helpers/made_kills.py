# SPDX-License-Identifier: Apache-2.0
"""As a script: kill what writes maps at one step on the disk after the other, and look at what is left each time."""

import os
import signal
import sys
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from made_faults import disk, in_child, small_map

from stereovox.cli import main
from stereovox.config import load_config
from stereovox.formats.map_server import read_map_server
from stereovox.frame import Scan
from stereovox.geometry.se2 import lifted
from stereovox.localize import robot_track
from stereovox.localize.slam.pipeline import SlamResult
from stereovox.localize.track import Track
from stereovox.maps import load_map
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.ros.mapping import Mapping
from stereovox.ros.run import reserve
from stereovox.runs import engine
from stereovox.runs.engine import Checkpoints
from stereovox.sources.poses.trajectory import Trajectory

DRIVE = "sim:floor?plan=testbed&seconds=2&scan_hz=4&depth_hz=1&image_width=16"


def done(*words):
    """Run a command as its user does, but without what it says."""
    assert main([str(word) for word in words]) == 0


class Merge:
    """`merge` over an older map."""

    def __init__(self, folder):
        self.out, self.parts = folder / "out" / "m", [folder / "a", folder / "b"]
        for part, frames in zip(self.parts, (3, 4), strict=True):
            small_map(frames).save(part)

    def older(self):
        small_map(1).save(self.out)

    def newer(self):
        done("merge", *self.parts, "--out", self.out)

    def seen(self):
        found = load_map(self.out)
        return found.frames, found.storage.blocks()[1].tobytes()

    def whole(self):
        return len(list(self.out.iterdir())) == 2


class Floor:
    """A floor's map, in files next to each other; `write(n)` writes the n-th."""

    def __init__(self, folder):
        self.out = folder / "out" / "floor.yaml"
        self.out.parent.mkdir()

    def older(self):
        self.write(1)

    def newer(self):
        self.write(2)

    def seen(self):
        return read_map_server(self.out).cells.tobytes()

    def whole(self):
        return {entry.name for entry in self.out.parent.iterdir()} <= {"floor.yaml", "floor.pgm", "floor.tum"}


class FloorBySlam(Floor):
    """`slam`; what it finds is made up."""

    def write(self, n):
        grid = OccupancyGrid(np.full((2 + n, 3), 100 * (n - 1), np.int8), 0.05, (1.0, 2.0, 0.0))

        def found(robot, config, progress):
            stamps_ns = np.array([robot.scans[i].stamp_ns for i in range(n + 2)])
            return SlamResult(
                Track(stamps_ns, np.full((n + 2, 3), float(n)), np.zeros((n + 2, 3))), grid, [], [], {}, []
            )

        robot_track.slam_robot = found
        done("slam", DRIVE, "--out", self.out)

    def seen(self):
        way = self.out.with_suffix(".tum")
        assert not way.exists() or len(Trajectory(way)) in (3, 4)
        return super().seen()


class FloorByGrid(Floor):
    """`grid`, which saves after each reading."""

    def write(self, n):
        done("grid", DRIVE, "--poses", "odometry", "--use", "lidar", "--frames", f":{n}", "--out", self.out,
             "--checkpoint", "1e-9")  # fmt: skip


class FloorByNode(Floor):
    """What the node does with its disk, for a floor."""

    def write(self, n):
        with ExitStack() as stack:
            reserve(str(self.out), 2, stack)
            mapping = Mapping(load_config(dimensions=2, voxel_size=0.1))
            saves = Checkpoints(lambda: mapping.save(str(self.out)), self.out, 1e-9)
            for k in range(2 * n):
                scan = Scan(
                    np.full(90, 1.0 + k, np.float32), -3.0, 0.06, 0.1, 9.0, lifted([k, 0, 0]), stamp_ns=k * 10**9
                )
                assert mapping.add(scan).refused is None
                saves.after(k + 1)
            mapping.save(str(self.out))


class SpaceByNode(Merge):
    """What the node does with its disk, for a map in space; its frames are those of two small maps."""

    def newer(self):
        with ExitStack() as stack:
            reserve(str(self.out), 3, stack)
            mapping = Mapping(load_config(voxel_size=0.1))
            saves = Checkpoints(lambda: mapping.save(str(self.out)), self.out, 1e-9)
            for n, part in enumerate(self.parts, 1):
                mapping.load(str(part))
                saves.after(n)
            mapping.save(str(self.out))


KINDS = {
    "merge": Merge,
    "slam": FloorBySlam,
    "grid": FloorByGrid,
    "node, floor": FloorByNode,
    "node, space": SpaceByNode,
}


@contextmanager
def noted(one, known):
    """Note each map that is saved on the way."""
    save = Checkpoints.save

    def save_and_note(checkpoints, frames):
        save(checkpoints, frames)
        known.add(one.seen())

    Checkpoints.save = save_and_note
    yield
    Checkpoints.save = save


def kill_at_steps(kind, folder, kills):
    """Kill a writer about so often; return how many steps it has, and how many of its maps were found."""
    one, known, found = kind(folder), set(), set()
    one.older()
    known.add(one.seen())
    with noted(one, known):
        one.newer()
    known.add(one.seen())
    one.older()
    with disk(folder) as counted:
        one.newer()
    for step in np.unique(np.linspace(1, counted.steps, kills).round().astype(int)).tolist():
        one.older()

        def killed(step=step):
            with disk(folder, lambda: os.kill(os.getpid(), signal.SIGKILL), step):
                one.newer()

        assert in_child(killed) == signal.SIGKILL, step
        found.add(one.seen())  # it opens
        one.newer()
        assert one.whole(), (step, list(one.out.parent.iterdir()))
    assert found <= known
    assert len(found) > 1
    return counted.steps


if __name__ == "__main__":
    engine.REST = 0
    for words in sys.argv[2:]:  # in one process, which imports and compiles once for all
        kind, kills = words.rsplit(":", 1)
        place = Path(sys.argv[1]) / kind
        place.mkdir()
        print(kind, kill_at_steps(KINDS[kind], place, int(kills)), sep=":", flush=True)
