# SPDX-License-Identifier: Apache-2.0
"""Does a frame cost more the longer the flight was?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np

from stereovox.errors import StereovoxError
from stereovox.evaluate.bench import median
from stereovox.evaluate.bench_frames import Progress, silent
from stereovox.evaluate.bench_table import Table
from stereovox.frame import AnyFrame
from stereovox.mapper import Mapper
from stereovox.sources import open_source

FRAMES = 6000
"""A minute."""
LEAST_FRAMES = 500
"""Shorter flights have no start and end to compare."""
FRAMES_A_METRE = 6
SETTINGS = {"voxel_size": 0.2, "max_range": 5.0}
WINDOW = {"window.size": [20.0, 20.0, 16.0]}
"""Holds all that the camera sees up to 5 m; what leaves it is dropped."""
MAPS = {"rolling window": {**SETTINGS, **WINDOW}, "unbounded": SETTINGS}
CHUNK = 50
"""Frames whose median is one figure."""


@dataclass
class _Flight:
    """One map along the way, beside one that begins near the way's end and sees the same frames."""

    settings: dict[str, Any]
    mapper: Mapper = field(init=False)
    fresh: Mapper = field(init=False)
    times: list[float] = field(default_factory=list)
    fresh_times: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.mapper, self.fresh = Mapper(**self.settings), Mapper(**self.settings)

    def add(self, frame: AnyFrame, near_end: bool, fresh_first: bool) -> None:
        """Take in a frame, near the end both by turns."""
        if near_end and fresh_first:
            self.fresh_times.append(self.fresh.add(frame).integrate_ms)
        self.times.append(self.mapper.add(frame).integrate_ms)
        if near_end and not fresh_first:
            self.fresh_times.append(self.fresh.add(frame).integrate_ms)


def cost_along_path(frames: int = FRAMES, tell: Progress = silent) -> dict[str, Any]:
    """Fly `frames` frames (at least 500) down the simulated hall `sim:flight`, straight on, always into new space.

    Into two maps: one that rolls with the camera, one that grows without bound. Along the last tenth (at least 400
    frames) each frame also goes into a second map that knows only what came since: old and new map take the same
    frames at the same time, so what differs is what the flight has cost.

    Returns `frames, metres, voxel_size` and `rows` of `map, start_ms` and `end_ms` (medians of the first and the last
    tenth, as flown; the first 100 frames do not count), `ratio` (old over new map; mean over pieces of 50 frames of the
    ratio of their medians), `ratio_error` (its standard error), `pieces, start_bytes, end_bytes`.
    Raises StereovoxError for a flight of less than 500 frames, SourceError for one that is too long.
    """
    if frames < LEAST_FRAMES:
        raise StereovoxError(f"a flight of {frames} frames is too short to compare; fly at least {LEAST_FRAMES}")
    metres = frames / FRAMES_A_METRE
    # half of the simulated flight is out, half back: only the way out is flown
    source = open_source(f"sim:flight?length={2 * metres + 10:g}&speed=5")
    last = max(frames // 10, 400)
    flights = {name: _Flight(settings) for name, settings in MAPS.items()}
    start_bytes = {}
    tell(0, frames, "flying: compiling, if need be")
    for i, frame in enumerate(islice(source, frames)):
        for flight in flights.values():
            flight.add(frame, i >= frames - last, fresh_first=bool(i % 2))
        if i == 99:
            start_bytes = {name: flight.mapper.map.memory_bytes for name, flight in flights.items()}
        tell(i + 1, frames, "flying")
    rows = [_row(name, flight, last, start_bytes[name]) for name, flight in flights.items()]
    return {"frames": frames, "metres": round(metres), "voxel_size": SETTINGS["voxel_size"], "rows": rows}


def _row(name: str, flight: _Flight, last: int, start_bytes: int) -> dict[str, Any]:
    old, new = flight.times[-last:][CHUNK * 2 :], flight.fresh_times[CHUNK * 2 :]  # a new map begins with an empty one
    ratio, error, pieces = ratio_of(old, new)
    return {
        "map": name,
        "start_ms": median(flight.times[100 : 100 + last]),
        "end_ms": median(flight.times[-last:]),
        "ratio": ratio,
        "ratio_error": error,
        "pieces": pieces,
        "start_bytes": start_bytes,
        "end_bytes": flight.mapper.map.memory_bytes,
    }


def ratio_of(old: Sequence[float], new: Sequence[float]) -> tuple[float, float, int]:
    """Return how `old` times compare with `new` ones of the same frames: ratio, its standard error, pieces.

    The ratio of medians in pieces of 50 frames, on average; at least two pieces.
    """
    pieces = len(old) // CHUNK
    medians = [np.median(np.reshape(times[: pieces * CHUNK], (pieces, CHUNK)), axis=1) for times in (old, new)]
    ratios = medians[0] / np.maximum(medians[1], 1e-4)
    return round(float(ratios.mean()), 4), round(float(ratios.std(ddof=1) / np.sqrt(pieces)), 4), pieces


def path_table(result: dict[str, Any]) -> Table:
    """Return the result of `cost_along_path` as a table."""
    rows = [
        (
            row["map"],
            f"{row['start_ms']:.3f}",
            f"{row['end_ms']:.3f}",
            f"{row['ratio']:.3f} ± {row['ratio_error']:.3f}",
            f"{row['start_bytes'] / 1e6:.1f}",
            f"{row['end_bytes'] / 1e6:.1f}",
        )
        for row in result["rows"]
    ]
    title = f"Cost along a flight of {result['frames']:,} frames, {result['metres']:,} m, {result['voxel_size']:g} m"
    note = "Ratio: the map at the end of the flight over one that began near it, on the same frames, by turns."
    return Table(title, ("map", "ms at the start", "at the end", "ratio", "MB, start", "end"), [rows], [note])
