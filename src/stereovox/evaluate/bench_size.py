# SPDX-License-Identifier: Apache-2.0
"""Does a frame cost more the larger the map is?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.evaluate.bench import median
from stereovox.evaluate.bench_frames import Progress, Recording, silent
from stereovox.evaluate.bench_machine import memory_left
from stereovox.evaluate.bench_table import Table
from stereovox.mapper import Mapper
from stereovox.maps.evidence import Evidence

CELLS = (10**4, 10**5, 10**6, 10**7, 10**8)
BLOCK_CELLS = 512
BYTES_A_CELL = 7
"""Needed while a map grows, at most: it moves to a place half as large again, two bytes a cell, and for a moment holds
both, beside the evidence that is added."""
ROUNDS = 3
SEED = 0


def cost_by_map_size(
    recording: Recording,
    config: Config,
    cells: Sequence[int] = CELLS,
    memory: int | None = None,
    tell: Progress = silent,
) -> dict[str, Any]:
    """Time the frames where the map holds so many `cells` already, which the camera does not reach.

    The cells, of random evidence, lie in a cube about the camera's way, less those within its range: so each map does
    the same work with a frame, among so many others. Every map sees all frames once before the clock starts, then they
    take turns, frame by frame. memory: bytes that may be used (None: what the system has left).

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
    rows = [_row(wanted, each, times) for wanted, each in zip(cells, maps, strict=True)]
    first = next((row["integrate_ms_median"] for row in rows if not row["skipped"]), 0.0)
    for row in rows:
        row["ratio"] = None if row["skipped"] else round(row["integrate_ms_median"] / max(first, 1e-4), 3)
    return {"voxel_size": config.voxel_size, "integrator": config.integrator, "rows": rows}


def _large_map(recording: Recording, config: Config, cells: int) -> Mapper:
    mapper = Mapper(load_config(config, **{"trust.ordered": False}))  # it sees the same frames again and again
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
    """Return `number` block coordinates (number, 3) about `positions` (n, 3) in metres, none within the range of any.

    They fill a cube about the ball that holds all that a camera at the positions reaches.
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
    raise AssertionError("a cube that grows holds any number of blocks in the end")


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


def _row(wanted: int, filled: Mapper | str, times: dict[int, list[float]]) -> dict[str, Any]:
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
