# SPDX-License-Identifier: Apache-2.0
"""Demo: fly a simulated camera through the built-in room, then make and check map, picture and report."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.metrics import by_part, compare_map, find_pieces
from stereovox.evaluate.truth import Truth, exact_occupancy
from stereovox.evaluate.truth_cells import Sightings
from stereovox.frame import Frame, UpdateReport
from stereovox.maps import VoxelMap
from stereovox.runs.recording import MapResult, MapRun
from stereovox.simulate.simulation import Simulation
from stereovox.sources.base import Stream
from stereovox.view.picture import picture
from stereovox.view.report.demo import write_report
from stereovox.view.report.page import out_folder

MIN_FRAMES = 20
"""A cell must be in the map once this many frames saw it."""

BATCH = 16
"""Frames simulated at a time: some 50 MB."""

Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and the current step in words."""


def demo(
    out: str | Path,
    *,
    voxel_size: float = 0.05,
    progress: Progress | None = None,
    source: Simulation | None = None,
    min_frames: int = MIN_FRAMES,
) -> dict[str, Any]:
    """Run the whole flow on the built-in scene and write `room.svox`, `room.png` and `report.html` into folder `out`.

    A part of the scene must be in the map once `min_frames` frames saw it.
    Returns a summary fit for JSON: the keys of `map --json`, and `accuracy`, `parts`, `missing`, `files`, `seconds`.
    Raises StereovoxError if the folder cannot be written.
    """
    start = perf_counter()
    folder = out_folder(out)
    source = source or Simulation()
    show = progress or (lambda done, total, text: None)
    truth = exact_occupancy(source.scene, voxel_size)
    files = {"map": folder / "room.svox", "picture": folder / "room.png", "report": folder / "report.html"}
    flight = _Flight(source)
    with MapRun(flight, files["map"], voxel_size=voxel_size) as run:
        watch = _Watch(flight, Sightings(truth.surface, voxel_size), run.mapper.config.max_range, show)
        made = run.finish([watch])
    mapped = perf_counter()
    show(len(source), len(source), "checking and drawing the map")
    summary = {**_facts(source, made), **_quality(made.map, truth, watch.sightings.frames, min_frames)}
    picture(made.map, files["picture"], title=f"stereovox demo: {source.name}")
    write_report(files["report"], summary, files["picture"])
    end = perf_counter()
    seconds = {"simulate_and_map": mapped - start, "check_and_draw": end - mapped, "total": end - start}
    return {**summary, "files": {name: str(path) for name, path in files.items()}, "seconds": _rounded(seconds)}


class _Flight(Stream):
    """A simulated recording. depth: the exact depth of the last frame that it yielded."""

    depth: NDArray[np.float32]

    def __init__(self, source: Simulation):
        self._source, self.name, self.camera = source, source.name, source.camera

    @property
    def length(self) -> int:
        """Number of frames."""
        return len(self._source)

    def __iter__(self) -> Iterator[Frame]:
        """Two threads simulate a batch, then rest, so that mapping is timed alone."""

        def simulate(i: int) -> tuple[NDArray[np.float32], Frame]:
            depth = self._source.true_depth(i)
            return depth, self._source.observe(i, depth)

        with ThreadPoolExecutor(2) as threads:
            for start in range(0, self.length, BATCH):
                for depth, frame in list(threads.map(simulate, range(start, min(start + BATCH, self.length)))):
                    self.depth = depth
                    yield frame


class _Watch:
    """Records which cells each frame of a flight saw, and reports progress."""

    def __init__(self, flight: _Flight, sightings: Sightings, max_range: float, show: Progress):
        self.sightings = sightings
        self._flight, self._max_range, self._show, self._done = flight, max_range, show, 0

    def after(self, frame: Frame, report: UpdateReport) -> None:
        """Record a frame that was offered to the map."""
        self.sightings.add(self._flight.depth, self._flight.camera, frame.T_world_sensor, self._max_range)
        self._done += 1
        self._show(self._done, self._flight.length, "flying and mapping")


def _facts(source: Simulation, made: MapResult[VoxelMap]) -> dict[str, Any]:
    camera = source.camera
    return {
        "source": source.name,
        "camera": f"RealSense D435 ({camera.width}x{camera.height})",
        "voxel_size": made.map.voxel_size,
        "settings": made.map.config.model_dump(mode="json"),
        **made.summary(),
    }


def _rounded(numbers: dict[str, float]) -> dict[str, float]:
    return {name: round(float(number), 3) for name, number in numbers.items()}


def _quality(voxel_map: VoxelMap, truth: Truth, frames_seen: NDArray[np.int32], min_frames: int) -> dict[str, Any]:
    pieces = find_pieces(voxel_map, truth, frames_seen, min_frames)
    return {
        "accuracy": compare_map(voxel_map, truth),
        "min_frames": min_frames,
        "parts": by_part(pieces),
        "missing": [piece.name for piece in pieces if piece.missing],
    }
