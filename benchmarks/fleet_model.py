# SPDX-License-Identifier: Apache-2.0
"""Scaling of a fleet: measured costs of a task for scheduler and client, and a model up to 1,000 workers.

    python benchmarks/fleet_model.py [RECORDING] [--frames 1000000] [--recordings 2000] [--box 12.8] [--tasks 2000]

Measured: seconds per frame alone and in a box, boxes per frame, bytes kept of it; the scheduler's seconds for an empty
task with a box's inputs; the client's seconds to find the boxes of frames. The model: each step takes as long as the
slowest of its work over the workers, its longest task, and the serial work of the scheduler or the client. Frames of
all recordings are assumed to be like RECORDING's. Reading and writing the store is included at the speed of a folder on
this machine; the bytes to transfer are printed.
"""

from __future__ import annotations

import argparse
import pickle
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from distributed import Client, LocalCluster

import stereovox as sv
from stereovox.files.places import Place
from stereovox.fleet import map_fleet
from stereovox.fleet.boxes import Box, boxes_of
from stereovox.fleet.recordings import boxes_seen

WORKERS = 1, 10, 100, 300, 1000


class Costs(NamedTuple):
    """Seconds and bytes, as measured; overlap: boxes a frame is in."""

    alone_s: float
    in_box_s: float
    overlap: float
    frame_bytes: float
    task_s: float
    task_bytes: float
    find_s: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", nargs="?", default="sim:town?image_width=320&drive=1")
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--recordings", type=int, default=2000)
    parser.add_argument("--box", type=float, default=12.8)
    parser.add_argument("--tasks", type=int, default=2000)
    given = parser.parse_args()
    costs, frames_in_box = measured(given.recording, given.box, given.tasks)
    print(
        f"a frame: {1e3 * costs.alone_s:.1f} ms alone, {1e3 * costs.in_box_s:.1f} ms in a box, in {costs.overlap:.2f} "
        f"boxes, {costs.frame_bytes / 1e3:.0f} kB kept"
    )
    print(
        f"a task: {1e3 * costs.task_s:.2f} ms of the scheduler, {costs.task_bytes / 1e3:.1f} kB; finding boxes: "
        f"{1e6 * costs.find_s:.1f} us a frame"
    )
    boxes = max(1, round(given.frames * costs.overlap / frames_in_box))
    stored = given.frames * costs.frame_bytes * (1 + costs.overlap) / 1e12
    print(f"{given.frames} frames of {given.recordings} recordings, {boxes} boxes; {stored:.2f} TB through the store")
    for workers in WORKERS:
        steps = model(costs, given.frames, given.recordings, boxes, workers)
        total, ideal = sum(step[1] for step in steps), sum(step[2] for step in steps)
        slowest = max(steps, key=lambda step: step[1] - step[2])
        print(
            f"{workers:5} workers: {total / 3600:8.2f} h, efficiency {ideal / total:.2f}; most is lost to {slowest[0]}"
        )


def measured(recording: str, box_m: float, tasks: int) -> tuple[Costs, float]:
    """Return the costs, and the number of frames per box."""
    with tempfile.TemporaryDirectory() as folder:
        for n in range(2):  # the first one compiles
            made = map_fleet([recording], Path(folder) / str(n), profile="default", box_m=box_m, workers=1)
        place = Place.of(Path(folder) / "1")
        (key,) = {name.split("/")[1] for name in place.names("recordings/")}
        rows, kept = boxes_seen(place, key), sum(place.sizes("recordings/").values())
    alone = made.recordings[0].seconds
    layout = made.map.manifest.layout
    frames = made.map.frames
    started = perf_counter()
    for box in boxes_of([(f"{key}{n}", rows, frames) for n in range(20)], None):
        box.inputs(layout)
    find_s = (perf_counter() - started) / (20 * frames)
    box = max(boxes_of([(key, rows, frames)], None), key=lambda box: box.frames)
    task_bytes = len(pickle.dumps((place, layout, box)))
    costs = Costs(
        alone / made.map.frames, (made.seconds[1] - alone) / made.frames_read, made.overlap, kept / made.map.frames,
        seconds_of_a_task([(place, layout, box)] * tasks), task_bytes, find_s,
    )  # fmt: skip
    return costs, made.frames_read / made.boxes[0]


def nothing(*given: object) -> None:
    """Do nothing, with the inputs of a box's task."""


def seconds_of_a_task(tasks: Sequence[tuple[Place, sv.Config, Box]]) -> float:
    """Return the seconds of an empty task."""
    with (
        LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address="127.0.0.1:0", silence_logs=50) as cluster,
        Client(cluster) as client,
    ):
        client.gather(client.map(nothing, range(10)))
        started = perf_counter()
        client.gather([client.submit(nothing, *one, key=f"task-{n}") for n, one in enumerate(tasks)])
        return (perf_counter() - started) / len(tasks)


def model(costs: Costs, frames: int, recordings: int, boxes: int, workers: int) -> list[tuple[str, float, float]]:
    """Return the bottleneck of each step, its seconds, and the ideal ones."""
    steps = []
    alone, boxed = frames * costs.alone_s, frames * costs.overlap * costs.in_box_s
    for name, work, count in (("the longest recording", alone, recordings), ("the longest box", boxed, boxes)):
        ideal, longest, served = work / workers, work / count, count * costs.task_s
        rounds = longest * -(-count // workers)  # whole tasks, all alike
        why, seconds = max((name, rounds), ("the scheduler", served), key=lambda one: one[1])
        steps.append((why, max(seconds, ideal), ideal))
        if name == "the longest recording":
            steps.append(("the client, which finds boxes", frames * costs.find_s, 0.0))
    return steps


if __name__ == "__main__":
    main()
