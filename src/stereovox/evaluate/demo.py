# SPDX-License-Identifier: Apache-2.0
"""The demo: a simulated camera flies through the built-in room; map, picture and report are made and checked."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.metrics import by_part, compare_map, find_pieces
from stereovox.evaluate.out_folder import out_folder
from stereovox.evaluate.report import write_report
from stereovox.evaluate.sightings import Sightings
from stereovox.evaluate.summary import summarise
from stereovox.evaluate.truth import Truth, exact_occupancy
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.sources.simulation import Simulation
from stereovox.update_report import UpdateReport
from stereovox.view.picture import picture

MIN_FRAMES = 20
"""A cell must stand in the map once so many frames saw it."""

BATCH = 16
"""Frames simulated at a time: some 50 MB."""

Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and what is being done."""


def demo(
    out: str | Path,
    *,
    voxel_size: float = 0.05,
    progress: Progress | None = None,
    source: Simulation | None = None,
    min_frames: int = MIN_FRAMES,
) -> dict[str, Any]:
    """Run the whole flow on the built-in scene and write `room.svox`, `room.png` and `report.html` into folder `out`.

    A part of the scene must stand in the map once `min_frames` frames saw it.
    Returns a summary fit for JSON: the keys of `map --json`, and `accuracy`, `parts`, `missing`, `files`, `seconds`.
    Raises StereovoxError when the folder cannot be written.
    """
    start = perf_counter()
    folder = out_folder(out)
    source = source or Simulation()
    tell = progress or (lambda done, total, text: None)
    mapper = Mapper(voxel_size=voxel_size)
    mapper.map.recording = source.name
    truth = exact_occupancy(source.scene, voxel_size)
    sightings = Sightings(truth.surface, voxel_size)
    reports = _map(mapper, source, sightings, tell)
    mapped = perf_counter()
    tell(len(source), len(source), "checking the map and drawing it")
    files = {"map": folder / "room.svox", "picture": folder / "room.png", "report": folder / "report.html"}
    mapper.map.save(files["map"])
    summary = {**_facts(source, mapper, reports), **_quality(mapper, truth, sightings.frames, min_frames)}
    trajectory = [source.pose(i)[:3, 3] for i in range(len(source))]
    picture(mapper.map, files["picture"], title=f"stereovox demo: {source.name}", trajectory=trajectory)
    write_report(files["report"], summary, files["picture"])
    end = perf_counter()
    seconds = {"simulate_and_map": mapped - start, "check_and_draw": end - mapped, "total": end - start}
    return {**summary, "files": {name: str(path) for name, path in files.items()}, "seconds": _rounded(seconds)}


def _map(mapper: Mapper, source: Simulation, sightings: Sightings, tell: Progress) -> list[UpdateReport]:
    reports = []
    for i, (depth, frame) in enumerate(_simulated(source)):
        reports.append(mapper.add(frame))
        sightings.add(depth, source.camera, frame.T_world_sensor, mapper.config.max_range)
        tell(i + 1, len(source), "flying and mapping")
    return reports


def _simulated(source: Simulation) -> Iterator[tuple[NDArray[np.float32], Frame]]:
    """Yield exact depth and frame in order. Two threads simulate a batch, then rest, so that mapping is timed alone."""

    def simulate(i: int) -> tuple[NDArray[np.float32], Frame]:
        depth = source.true_depth(i)
        return depth, source.observe(i, depth)

    with ThreadPoolExecutor(2) as threads:
        for start in range(0, len(source), BATCH):
            yield from list(threads.map(simulate, range(start, min(start + BATCH, len(source)))))


def _facts(source: Simulation, mapper: Mapper, reports: list[UpdateReport]) -> dict[str, Any]:
    camera = source.camera
    return {
        "source": source.name,
        "camera": f"RealSense D435 ({camera.width}x{camera.height})",
        "voxel_size": mapper.map.voxel_size,
        "settings": mapper.config.model_dump(mode="json"),
        **summarise(mapper.map, reports),
    }


def _rounded(numbers: dict[str, float]) -> dict[str, float]:
    return {name: round(float(number), 3) for name, number in numbers.items()}


def _quality(mapper: Mapper, truth: Truth, frames_seen: NDArray[np.int32], min_frames: int) -> dict[str, Any]:
    pieces = find_pieces(mapper.map, truth, frames_seen, min_frames)
    return {
        "accuracy": compare_map(mapper.map, truth),
        "min_frames": min_frames,
        "parts": by_part(pieces),
        "missing": [piece.name for piece in pieces if piece.missing],
    }
