# SPDX-License-Identifier: Apache-2.0
"""Count, fail or kill at each thing that a piece of code does to the disk; as a script, kill a save at every one."""

import os
import signal
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
NAMES = {"os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link"}


class Disk:
    """What happens to files below `folder`: at step number `at`, and with `ever` from then on, `happens` is called."""

    def __init__(self):
        self.folder, self.steps, self.at, self.ever, self.happens = "", 0, 0, False, lambda: None

    def __call__(self, event, details):
        if not self.folder or not (event in NAMES or (event == "open" and details[2] & WRITES)):
            return
        if str(details[0]).startswith(self.folder) or str(details[0]).startswith("."):
            self.step()

    def step(self):
        """Count one more step."""
        self.steps += 1
        if self.steps == self.at or (self.ever and self.steps > self.at > 0):
            self.happens()


DISK = Disk()
sys.addaudithook(DISK)  # it cannot be removed, and does nothing without a folder
REAL_FSYNC = os.fsync


@contextmanager
def disk(folder, happens=lambda: None, at=0, ever=False):
    """Watch `folder` while the block runs, and let something happen at step `at`; 0: only count."""

    def fsync(number):
        DISK.step()
        REAL_FSYNC(number)

    DISK.__init__()
    DISK.happens, DISK.at, DISK.ever = happens, at, ever
    os.fsync, DISK.folder = fsync, str(folder)
    try:
        yield DISK
    finally:
        os.fsync, DISK.folder = REAL_FSYNC, ""


def small_map(frames):
    """Return a map that reports how many frames it holds by its cells."""
    from stereovox.config import load_config
    from stereovox.maps import VoxelMap

    one = VoxelMap.from_cells(load_config(voxel_size=0.1), [[8 * i, 0, 0] for i in range(frames)], np.ones(frames))
    one.frames = frames
    return one


def in_child(action):
    """Run `action` in a process of its own; return its wait status."""
    child = os.fork()
    if not child:
        try:
            action()
        finally:
            status = 1 if sys.exc_info()[0] else 0
            sys.stderr.flush()
            os._exit(status)
    return os.waitpid(child, 0)[1]


def kill_at_steps(folder, every):
    """Kill the second save of a map at every so many steps, and at each of the last ten; return how many there are."""
    from stereovox.maps import load_map

    small_map(1).save(folder)
    load_map(folder)  # what this loads, all children have
    with disk(folder.parent) as counted:
        small_map(2).save(folder)
    small_map(1).save(folder)
    for step in range(1, counted.steps + 1):
        if step % every and step <= counted.steps - 10:
            continue

        def killed_save(step=step):
            with disk(folder.parent, lambda: os.kill(os.getpid(), signal.SIGKILL), step):
                small_map(2).save(folder)

        def check():
            found = load_map(folder)
            assert found.frames == len(found.cells()[0])
            assert found.frames in (1, 2)
            small_map(1).save(folder)
            assert len(list(folder.iterdir())) == 2

        assert in_child(killed_save) == signal.SIGKILL, step
        assert in_child(check) == 0, step
    return counted.steps


if __name__ == "__main__":
    print(kill_at_steps(Path(sys.argv[1]), int(sys.argv[2])))
