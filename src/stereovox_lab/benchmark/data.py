# SPDX-License-Identifier: Apache-2.0
"""Data sets of the benchmark: frames to map, and the truth by which their maps are judged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.depth import DepthPipeline, prepare
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.evaluate.lidar_truth import lidar_truth
from stereovox.evaluate.truth import exact_occupancy
from stereovox.evaluate.truth_cells import TruthCells
from stereovox.frame import Frame, Reason
from stereovox.maps import VoxelMap
from stereovox.opening import open_source, parse_slice
from stereovox.simulate.simulation import Simulation
from stereovox.sources import parameters
from stereovox.sources.lidar import LidarSource
from stereovox_lab.bench.frames import Progress, silent
from stereovox_lab.benchmark.seen import END, FREE, Seen, truth_of, without

BUILT_IN = ("sim:room?camera=d435", "sim:apartment?camera=d435", "sim:room?camera=kinect")
"""Default data sets: everybody has these."""
SEEDS = (7001, 7002, 7003)
"""Default noise seeds of a simulated camera; no default of stereovox was chosen on them."""
MOST_FRAMES = 100
"""Most frames used of a recording, including held-out ones; longer ones are sampled evenly."""
HELD_OUT = 10
"""One in this many frames of a depth-only recording is held out, starting with the sixth."""
MARGIN = (2.0, 0.02)
"""Margin in cells, and as a share of depth, between free cells and the end of a held-out ray."""
TOLERANCE = 1
SIMULATED, LIDAR, DEPTH = "exact geometry", "lidar", "held-out frames"
"""Kinds of truth."""
SETTINGS = {SIMULATED: (0.05, 5.0), LIDAR: (0.2, 20.0), DEPTH: (0.05, 5.0)}
"""Cell size and maximum range in metres by kind of truth."""


@dataclass(frozen=True, eq=False)
class Task:
    """One recording to map and its truth.

    name: as given; run: the seed; kind: of truth. frames: depth images to map. held_out: number of others that made the
    truth; dropped: cells on which these contradict each other.
    """

    name: str
    run: str
    kind: str
    voxel_size: float
    max_range: float
    frames: Sequence[Frame]
    truth: TruthCells
    held_out: int = 0
    dropped: int = 0

    def about(self) -> dict[str, Any]:
        """Return its description for readers, fit for JSON; `truth_sha256` identifies the truth."""
        cells = self.truth.cells.astype("<i8").tobytes() + self.truth.occupied.tobytes()
        return {
            "name": self.name,
            "run": self.run,
            "truth": self.kind,
            "voxel_size": self.voxel_size,
            "max_range": self.max_range,
            "frames": len(self.frames),
            "frames_held_out": self.held_out,
            "surface_cells": int(self.truth.occupied.sum()),
            "free_cells": int((~self.truth.occupied).sum()),
            "contradictory_cells": self.dropped,
            "truth_sha256": sha256(cells).hexdigest(),
        }


def tasks_of(
    location: str,
    voxel_size: float | None = None,
    max_range: float | None = None,
    frames: str | None = None,
    seeds: Sequence[int] = SEEDS,
    most_frames: int = MOST_FRAMES,
    tell: Progress = silent,
) -> Iterator[Task]:
    """Yield the tasks of a data set: one per seed of a simulation, one per recording.

    location: what `open_source` takes. voxel_size, max_range: in metres; None: those of `SETTINGS`. frames: as `A:B:S`.
    Raises StereovoxError, one line, if data cannot be opened, frames are unusable, or too few to hold out.
    """
    source: Any = open_source(location)
    picked = _picked(len(source), source.name, frames, most_frames)
    kind = _kind_of(source)
    size, reach = (given or usual for given, usual in zip((voxel_size, max_range), SETTINGS[kind], strict=True))
    config = load_config(voxel_size=size, max_range=reach, threads=1)
    if kind == SIMULATED:
        yield from _simulated(source, location, picked, config, seeds, tell)
        return
    matched = [*_matched(source, picked, config, tell)]
    if kind == LIDAR:
        truth, _ = lidar_truth(source, size, reach, "rays", picked)
        yield _task(location, "", kind, config, [frame for _, frame in matched], truth)
    else:
        yield _held_out(location, [frame for _, frame in matched], config)


def _kind_of(source: Any) -> str:
    if isinstance(source, Simulation):
        return SIMULATED
    return LIDAR if isinstance(source, LidarSource) and source.has_lidar else DEPTH


def _held_out(name: str, frames: Sequence[Frame], config: Config) -> Task:
    """Return the task of mapping nine frames of ten, judged by the tenth ones; contradictions are dropped."""
    held, kept = frames[HELD_OUT // 2 :: HELD_OUT], [f for n, f in enumerate(frames) if n % HELD_OUT != HELD_OUT // 2]
    if not held:
        raise StereovoxError(f"{name}: {len(frames)} usable frames; give at least {HELD_OUT} to hold one out")
    seen = Seen(config.voxel_size, config.max_range, MARGIN)
    for frame in held:
        image = prepare(frame, raw(config))
        if not isinstance(image.camera, PinholeCamera):
            raise StereovoxError(f"{name}: only images of pinhole cameras can be held out; leave it out")
        seen.add(np.where(image.reason == Reason.VALID, image.depth_m, 0), image.camera, image.T_world_sensor)
    truth = truth_of(seen.cells(END), seen.cells(FREE), config.voxel_size, config.max_range)
    return _task(name, "", DEPTH, config, kept, truth, held_out=len(held), dropped=len(seen.cells(FREE | END)))


def raw(config: Config) -> Config:
    """Return the settings that give libraries the camera's raw depths."""
    return load_config(config, **{"depth.denoise": False})


def _simulated(
    source: Simulation, location: str, picked: Sequence[int], config: Config, seeds: Sequence[int], tell: Progress
) -> Iterator[Task]:
    """Yield a task for each seed; the truth is what exact depth images of the same frames see."""
    size, reach = config.voxel_size, config.max_range
    exact, seen = exact_occupancy(source.scene, size), Seen(size, reach)
    for n, i in enumerate(picked):
        tell(n, len(picked), f"{location}: truth")
        seen.add(source.true_depth(i), source.camera, source.true_pose(i))
    ends, through = (np.union1d(seen.cells(mark), seen.cells(FREE | END)) for mark in (END, FREE))
    surface = np.intersect1d(ends, exact.surface, assume_unique=True)
    truth = truth_of(surface, without(through, exact.surface, exact.inside), size, reach)
    name, given = parameters.split(location)
    for seed in [given["seed"]] if "seed" in given else seeds:
        where = f"{name}?{'&'.join(f'{key}={value}' for key, value in {**given, 'seed': seed}.items())}"
        run = Simulation(where)
        frames = []
        for n, i in enumerate(picked):
            tell(n, len(picked), f"{where}: frames")
            frames.append(run.frame(i))
        yield _task(location, f"seed {seed}", SIMULATED, config, frames, truth)


def _task(
    name: str, run: str, kind: str, config: Config, frames: Sequence[Frame], truth: VoxelMap, **more: Any
) -> Task:
    return Task(name, run, kind, config.voxel_size, config.max_range, frames, TruthCells(truth, TOLERANCE), **more)


def _picked(total: int, name: str, frames: str | None, most: int) -> list[int]:
    picked = range(total) if frames is None else range(total)[parse_slice(frames)]
    if not picked:
        raise SourceError(f"frames '{frames}' selects none of the {total} frames of {name}; widen it")
    if most < 1:
        raise SourceError(f"most-frames {most}: give at least 1")
    chosen = np.unique(np.linspace(0, len(picked) - 1, most).round().astype(int))
    return [picked[int(i)] for i in chosen]


def _matched(source: Any, picked: Sequence[int], config: Config, tell: Progress) -> Iterator[tuple[int, Frame]]:
    """Yield number and depth image of each usable frame; pairs are matched as the default profile does."""
    path = DepthPipeline(config)
    refused = ""
    found = 0
    for n, i in enumerate(picked):
        tell(n, len(picked), f"{source.name}: reading")
        try:
            frame = path.matched(source.frame(i))
            prepare(frame, config)
        except FrameRefused as why:
            refused = refused or str(why)
            continue
        found += 1
        yield i, frame
    if not found:
        raise StereovoxError(f"{source.name}: not one frame can be used ({refused})")
