# SPDX-License-Identifier: Apache-2.0
"""Run the benchmark: every library maps every recording, and all maps are judged by the same truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from stereovox.errors import FrameRefused
from stereovox.evaluate.scores import Scores, score
from stereovox.maps import VoxelMap
from stereovox_lab.bench.frames import Progress, silent
from stereovox_lab.bench.machine import machine
from stereovox_lab.benchmark.data import BUILT_IN, MOST_FRAMES, SEEDS, Task, tasks_of
from stereovox_lab.benchmark.libraries import Library, find_libraries

PROTOCOL = "1"
"""Raised with every change that could change a figure."""
SoFar = Callable[[dict[str, Any]], None]
"""Called with the result so far."""


def run_benchmark(
    data: Sequence[str] = (),
    libraries: Sequence[str] | None = None,
    *,
    voxel_size: float | None = None,
    max_range: float | None = None,
    frames: str | None = None,
    seeds: Sequence[int] = SEEDS,
    most_frames: int = MOST_FRAMES,
    command: str = "",
    tell: Progress = silent,
    so_far: SoFar = lambda result: None,
) -> dict[str, Any]:
    """Compare libraries on data sets by the protocol of docs/benchmark.md; return all figures, fit for JSON.

    data: recordings and simulations as `open_source` takes them; none: `BUILT_IN`. libraries: see `find_libraries`.
    voxel_size, max_range: in metres, for all data; None: by the kind of truth. frames: as `A:B:S`, of each recording.
    seeds: of simulated noise. command: the typed command, for the record. so_far: called after each map.
    Returns `protocol, command, machine, libraries, not_installed, data` (see `Task.about`), `rows` (one for each map)
    and `means` (over the runs of a data set): figures as `figures_of` names them.
    Raises StereovoxError, one line, for unknown libraries, unusable data, and a failing library.
    """
    found, missing = find_libraries(libraries)
    about = [{"name": one.name, "version": one.version, "settings": one.settings} for one in found]
    result: dict[str, Any] = {"protocol": PROTOCOL, "command": command, "machine": machine()}
    result |= {"libraries": about, "not_installed": missing, "data": [], "rows": [], "means": []}
    for location in dict.fromkeys(data or BUILT_IN):
        for task in tasks_of(location, voxel_size, max_range, frames, seeds, most_frames, tell):
            result["data"].append(task.about())
            for library in found:
                result["rows"].append(judged(library, task, tell))
                result["means"] = means(result["rows"])
                so_far(result)
    return result


def judged(library: Library, task: Task, tell: Progress = silent) -> dict[str, Any]:
    """Let a library map a task, and return the row of figures.

    A frame that stereovox refuses is left out of its map, and counted; every map is judged by its cells' states
    according to the library.
    """
    contestant, refused = library.make(task), 0
    for n, frame in enumerate(task.frames):
        tell(n, len(task.frames), f"{library.name}: {task.name} {task.run}")
        try:
            contestant.add(frame)
        except FrameRefused:
            refused += 1
    made = contestant.map()
    bare = VoxelMap.from_cells(made.config, *made.cells())
    scores = score(bare, task.truth)
    times = contestant.ms[1:] or contestant.ms  # the first may include compilation
    return {
        "library": library.name,
        "data": task.name,
        "run": task.run,
        **figures_of(scores),
        "ms": round(float(np.median(times)), 3),
        "map_bytes": contestant.bytes(),
        "frames_refused": refused,
        "decisions": asdict(scores.decisions),
    }


def figures_of(scores: Scores) -> dict[str, float | None]:
    """Return the figures of a table; None for a division by zero.

    wrongly_free, wrongly_free_alone: of the surface cells that the map knows, the shares called free, and free with
    nothing tentative or occupied within one cell. thin_lost: of the surface cells of lines (`Thickness`), the share
    without an occupied cell within one cell. coverage: share of the truth's cells that the map knows.
    """
    lines = [part.decisions for part in scores.parts if (part.by, part.name) == ("thickness", "line")]
    near = lines[0].surface_occupied_near if lines else None
    return {
        "auc": scores.auc,
        "average_precision": scores.average_precision,
        "iou": scores.iou,
        "f_score_1": scores.f_score_1,
        "f_score_2": scores.f_score_2,
        "ece": scores.ece,
        "ece_likely": scores.ece_likely,
        "ece_equal_mass": scores.ece_equal_mass,
        "brier": scores.brier,
        "wrongly_free": scores.decisions.known_free,
        "wrongly_free_alone": scores.decisions.known_free_alone,
        "thin_lost": None if near is None else 1 - near,
        "coverage": scores.coverage,
    }


def means(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row for each data set and library, in order: means over the runs, and `spread`, highest minus lowest."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["data"], row["library"]), []).append(row)
    return [_mean(group) for group in groups.values()]


def _mean(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    names = [name for name in rows[0] if name not in ("library", "data", "run", "decisions")]
    values = {name: [row[name] for row in rows if row[name] is not None] for name in names}
    return {
        "library": rows[0]["library"],
        "data": rows[0]["data"],
        "runs": len(rows),
        **{name: float(np.mean(some)) if some else None for name, some in values.items()},
        "spread": {name: float(max(some) - min(some)) if some else None for name, some in values.items()},
    }
