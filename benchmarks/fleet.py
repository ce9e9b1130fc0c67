# SPDX-License-Identifier: Apache-2.0
"""Maps made by a fleet: equality with one mapper's map, and speed.

    python benchmarks/fleet.py same RECORDING... [--boxes 3.2 6.4 12.8] [--workers 1 2 4] [--kills 20] [--set KEY=VALUE]
    python benchmarks/fleet.py speed RECORDING... [--boxes 12.8] [--workers 1 2] [--set KEY=VALUE]

same: each map against the frames that each recording's own mapper trusts, put into one map in this process without
boxes. With --kills one worker after another is killed while boxes are mapped. speed: seconds of a run, without the
first for each number of workers; efficiency is against one worker. Overlap: boxes per frame, measured, and predicted by
the mean of the product of (1 + extent / side) over all axes, for views anywhere that fill their extent.
"""

from __future__ import annotations

import argparse
import random
import signal
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import psutil

import stereovox as sv
from stereovox.config import load_config, parse_value
from stereovox.files.places import Place
from stereovox.fleet import map_fleet, recordings_of
from stereovox.fleet.recordings import frames_of
from stereovox.mapping.deadline import Levels


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["same", "speed"])
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--boxes", nargs="+", type=float, default=[12.8])
    parser.add_argument("--workers", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    more = {key: parse_value(value) for key, _, value in (one.partition("=") for one in given.set)}
    recordings = [one.where for one in recordings_of(given.recordings)]
    with tempfile.TemporaryDirectory() as folder:
        (same if given.what == "same" else speed)(Path(folder), recordings, given, more)


def same(folder: Path, recordings: Sequence[str], given: argparse.Namespace, settings: dict[str, Any]) -> None:
    """Compare the maps of fleets with the map of one process."""
    started = perf_counter()
    coords, cells, frames = one_map(recordings, settings)
    print(f"one process: {frames} frames, {len(coords)} blocks, {perf_counter() - started:.1f} s", flush=True)
    for side in given.boxes:
        for workers in given.workers:
            killer = Killer(given.kills)
            out = folder / f"{side}-{workers}.svox"
            made = map_fleet(
                recordings, out, profile="default", box_m=side, workers=workers, progress=killer, **settings
            )
            ours = made.map.storage.blocks()
            there = np.array_equal(ours[0], coords)
            differ = int((ours[1] != cells).sum()) if there else -1
            print(
                f"boxes of {side:g} m, {workers} workers, {killer.killed} killed: {made.boxes[0]} boxes, overlap "
                f"{made.overlap:.2f}, {differ if there else 'blocks'} cells differ, {made.seconds[0]:.1f} s",
                flush=True,
            )


def one_map(recordings: Sequence[str], settings: dict[str, Any]) -> tuple[np.ndarray, np.ndarray, int]:
    """Return the blocks of one map from the frames that each recording's own mapper trusts, and their number."""
    config = load_config("default", **settings)
    storage, levels, count = sv.VoxelMap(config).storage, Levels(config), 0
    for one in recordings:
        mapper = sv.Mapper(config, **{"map.keep_frames": True})
        for frame in sv.open_source(one):
            mapper.add(frame)
        for frame in mapper.map.kept_frames.frames:
            image = levels(frame.quality).prepare(frame.frame()).image
            storage.history.frames = count
            storage.set_viewpoint(image.viewpoint)
            storage.add(levels(frame.quality).integrator.evidence(image))
            count += 1
    return *storage.blocks(), count


class Killer:
    """Kills busy workers a number of times while boxes are mapped."""

    def __init__(self, kills: int):
        self._left, self.killed = kills, 0

    def __call__(self, done: int, total: int, doing: str) -> None:
        if doing != "boxes" or not done or done >= total or not self._left:
            return
        workers = []
        for one in psutil.Process().children(recursive=True):
            try:
                if "spawn_main" in " ".join(one.cmdline()):
                    workers.append(one)
            except psutil.Error:
                continue
        if workers:
            random.choice(workers).send_signal(signal.SIGKILL)
            self._left, self.killed = self._left - 1, self.killed + 1


def speed(folder: Path, recordings: Sequence[str], given: argparse.Namespace, settings: dict[str, Any]) -> None:
    """Time fleets."""
    for side in given.boxes:
        single = 0.0
        for workers in given.workers:
            for n in range(2):  # the first one compiles
                out = folder / f"{side}-{workers}-{n}.svox"
                made = map_fleet(recordings, out, profile="default", box_m=side, workers=workers, **settings)
            seconds = made.seconds[0]
            single = single or seconds * workers
            print(
                f"boxes of {side:g} m, {workers} workers: {seconds:.1f} s ({made.seconds[1]:.1f} s of workers), "
                f"{made.map.frames / seconds:.1f} frames a second, efficiency {single / seconds / workers:.2f}; "
                f"{made.boxes[0]} boxes, overlap {made.overlap:.2f} (predicted {predicted(Place.of(out), made):.2f})",
                flush=True,
            )


def predicted(place: Place, made: sv.FleetMap) -> float:
    """Return the overlap predicted from the extent of views relative to a box."""
    keys, extents = {name.split("/")[1] for name in place.names("recordings/")}, []
    for key in keys:
        with frames_of(place, key, range(next(one.frames for one in made.recordings))) as frames:
            extents += [8 * (frame.blocks[1] - frame.blocks[0] - 1) for frame in frames]
    return float((1 + np.array(extents) / made.map.manifest.layout.side).prod(axis=1).mean())


if __name__ == "__main__":
    sys.exit(main())
