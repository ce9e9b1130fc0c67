# SPDX-License-Identifier: Apache-2.0
"""Cost of a frame against flight length and map size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError
from stereovox.frame import AnyFrame
from stereovox.mapper import Mapper
from stereovox.maps.cells.evidence import Evidence
from stereovox.opening import open_source
from stereovox_lab.bench.frames import Progress, Recording, silent
from stereovox_lab.bench.machine import memory_left
from stereovox_lab.bench.results import Table
from stereovox_lab.bench.rows import median

CELLS = (10**4, 10**5, 10**6, 10**7, 10**8)
BLOCK_CELLS = 512
BYTES_A_CELL = 7
"""Most bytes needed while a map grows: it moves to an array half as large again, two bytes a cell, and for a moment
holds both, next to the evidence to be added."""
ROUNDS = 3
SEED = 0
FRAMES = 6000
"""A minute."""
MIN_FRAMES = 500
"""Shorter flights have no start and end to compare."""
FRAMES_A_METRE = 6
SETTINGS = {"voxel_size": 0.2, "max_range": 5.0}
WINDOW = {"window.size": [20.0, 20.0, 16.0]}
"""Contains the camera's view up to 5 m; cells that leave it are dropped."""
MAPS = {"rolling window": {**SETTINGS, **WINDOW}, "unbounded": SETTINGS}
CHUNK = 50
"""Frames per median."""


def cost_by_map_size(
    recording: Recording,
    config: Config,
    cells: Sequence[int] = CELLS,
    memory: int | None = None,
    tell: Progress = silent,
) -> dict[str, Any]:
    """Time frames in maps that already have this many `cells` out of the camera's reach.

    The cells, with random evidence, form a cube around the camera's path, without those within its range: so each map
    does the same work per frame, among different numbers of cells. Every map sees all frames once before timing, then
    the maps take turns, frame by frame. memory: bytes that may be used (None: what the system has left).

    Returns `voxel_size, integrator` and `rows` of `cells` (of them, in whole blocks), `map_bytes,
    integrate_ms_median, ratio` (to the first), `skipped` ("" or why there are no figures).
    """
    left = memory_left() if memory is None else memory
    maps: list[Mapper | str] = []
    for n, wanted in enumerate(cells):
        tell(n, len(cells), f"making a map of {wanted:,} cells")
        need = BYTES_A_CELL * wanted
        if left is not None and need > left:
            maps.append(f"needs {need / 1e9:.1f} GB of memory, {left / 1e9:.1f} GB are left")
            continue
        maps.append(_large_map(recording, config, wanted))
        left = None if left is None else left - need
    times = _flown([each for each in maps if isinstance(each, Mapper)], recording, tell)
    rows = [_size_row(wanted, each, times) for wanted, each in zip(cells, maps, strict=True)]
    first = next((row["integrate_ms_median"] for row in rows if not row["skipped"]), 0.0)
    for row in rows:
        row["ratio"] = None if row["skipped"] else round(row["integrate_ms_median"] / max(first, 1e-4), 3)
    return {"voxel_size": config.voxel_size, "integrator": config.integrator, "rows": rows}


def _large_map(recording: Recording, config: Config, cells: int) -> Mapper:
    mapper = Mapper(load_config(config, **{"trust.ordered": False}))  # it sees the same frames repeatedly
    random = np.random.default_rng(SEED)
    positions = np.array([frame.T_world_sensor[:3, 3] for frame in recording.frames])
    blocks = far_blocks(positions, config, -(-cells // BLOCK_CELLS))
    random.shuffle(blocks)
    for piece in np.array_split(blocks, -(-len(blocks) // 8192)):
        values = random.integers(1, 1500, (len(piece), BLOCK_CELLS), np.int16)
        values *= np.where(random.random(values.shape) < 0.8, -1, 1).astype(np.int16)  # free, mostly
        mapper.map.add(Evidence(piece, values, np.empty((0, 3), np.int32), np.empty(0, np.int16)))
    return mapper


def far_blocks(positions: NDArray[np.float64], config: Config, number: int) -> NDArray[np.int32]:
    """Return `number` block coordinates (number, 3) around `positions` (n, 3) in metres, none within range of any.

    They fill a cube around the ball of all that a camera at the positions reaches.
    """
    side = 8 * config.voxel_size
    middle = (positions.min(0) + positions.max(0)) / 2
    # a camera sees `max_range` along its axis, and up to twice as far in its corners
    reach = np.linalg.norm(positions - middle, axis=1).max() + 2 * config.max_range + side * np.sqrt(3)
    for half in _growing((reach**3 * 4.2 / side**3 + number) ** (1 / 3) / 2):
        low, high = np.floor(middle / side - half).astype(int), np.ceil(middle / side + half).astype(int)
        grid = np.stack(np.meshgrid(*map(np.arange, low, high), indexing="ij"), -1).reshape(-1, 3)
        far = grid[np.linalg.norm((grid + 0.5) * side - middle, axis=1) > reach]
        if len(far) >= number:
            nearest = np.argsort(np.linalg.norm((far + 0.5) * side - middle, axis=1), kind="stable")[:number]
            return far[nearest].astype(np.int32)
    raise AssertionError("a growing cube eventually holds any number of blocks")


def _growing(half: float) -> Iterator[float]:
    while True:
        yield half
        half *= 1.15


def _flown(maps: Sequence[Mapper], recording: Recording, tell: Progress) -> dict[int, list[float]]:
    """Return the times in milliseconds by map (its `id`)."""
    times: dict[int, list[float]] = {id(each): [] for each in maps}
    for number in range(ROUNDS + 1):
        for done, frame in enumerate(recording.frames, start=1):
            for each in maps:
                took = each.add(frame).integrate_ms
                if number:
                    times[id(each)].append(took)
            tell(done, len(recording.frames), "adding to maps of all sizes" if number else "maps see the frames")
    return times


def _size_row(wanted: int, filled: Mapper | str, times: dict[int, list[float]]) -> dict[str, Any]:
    if isinstance(filled, str):
        return {"cells": wanted, "map_bytes": None, "integrate_ms_median": None, "skipped": filled}
    cells = -(-wanted // BLOCK_CELLS) * BLOCK_CELLS
    ms = median(times[id(filled)])
    return {"cells": cells, "map_bytes": filled.map.memory_bytes, "integrate_ms_median": ms, "skipped": ""}


def size_table(result: dict[str, Any]) -> Table:
    """Return the result of `cost_by_map_size` as a table."""
    rows, notes = [], ["The cells lie out of the camera's reach, so each map does the same work with a frame."]
    for row in result["rows"]:
        if row["skipped"]:
            notes.append(f"{row['cells']:,} cells: skipped, {row['skipped']}")
            continue
        size = f"{row['map_bytes'] / 1e6:.0f}"
        rows.append((f"{row['cells']:,}", size, f"{row['integrate_ms_median']:.2f}", f"{row['ratio']:.2f}"))
    title = f"Cost against the size of the map, {result['integrator']}, {result['voxel_size']:g} m"
    return Table(title, ("cells in the map", "MB", "ms/frame", "to the first"), [rows], notes)


@dataclass
class _Flight:
    """One map along the path, and one that begins near its end and sees the same frames."""

    settings: dict[str, Any]
    mapper: Mapper = field(init=False)
    fresh: Mapper = field(init=False)
    times: list[float] = field(default_factory=list)
    fresh_times: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.mapper, self.fresh = Mapper(**self.settings), Mapper(**self.settings)

    def add(self, frame: AnyFrame, near_end: bool, fresh_first: bool) -> None:
        """Add a frame; near the end, to both maps in alternating order."""
        if near_end and fresh_first:
            self.fresh_times.append(self.fresh.add(frame).integrate_ms)
        self.times.append(self.mapper.add(frame).integrate_ms)
        if near_end and not fresh_first:
            self.fresh_times.append(self.fresh.add(frame).integrate_ms)


def cost_along_path(frames: int = FRAMES, tell: Progress = silent) -> dict[str, Any]:
    """Fly `frames` frames (at least 500) down the simulated hall `sim:flight`, straight on, always into new space.

    One map rolls with the camera, one grows without bound. Along the last tenth (at least 400 frames) each frame also
    goes into a second map that knows only these: old and new map take the same frames at the same time, so their
    difference is the cost of the flight.

    Returns `frames, metres, voxel_size` and `rows` of `map, start_ms` and `end_ms` (medians of the first and the last
    tenth, as flown; the first 100 frames do not count), `ratio` (old over new map; mean over pieces of 50 frames of the
    ratio of their medians), `ratio_error` (its standard error), `pieces, start_bytes, end_bytes`.
    Raises StereovoxError for a flight of less than 500 frames, SourceError for one that is too long.
    """
    if frames < MIN_FRAMES:
        raise StereovoxError(f"a flight of {frames} frames is too short to compare; fly at least {MIN_FRAMES}")
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
    old, new = flight.times[-last:][CHUNK * 2 :], flight.fresh_times[CHUNK * 2 :]  # a new map starts empty
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
    """Compare `old` times with `new` ones of the same frames: ratio, its standard error, pieces.

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
