# SPDX-License-Identifier: Apache-2.0
"""A graphics card against the processor: equality of the maps, and time per frame on each.

    python benchmarks/gpu.py [SOURCE] [FRAMES] [--voxel-sizes 0.05 0.02] [--threads 1 2]

Both get the same frames, in one run; the first ten, which may compile, do not count. Differences are counted over
all cells known to either.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numba import cuda

import stereovox as sv
from stereovox.maps.cells.cell_format import CellRules
from stereovox.products.blocks import block_pairs

FIRST = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", nargs="?", default="sim:apartment?image_width=640")
    parser.add_argument("frames", nargs="?", default=":200")
    parser.add_argument("--voxel-sizes", nargs="+", type=float, default=[0.1, 0.05, 0.02])
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    wanted = parser.parse_args()
    frames = list(sv.open_source(wanted.source, wanted.frames))
    print(f"{len(frames)} frames of {wanted.source}, on {cuda.get_current_device().name}")
    for size in wanted.voxel_sizes:
        for cell in ("int16", "int8"):
            compare(frames, wanted.threads, {"voxel_size": size, "map.cell": cell})


def compare(frames: Sequence[sv.Frame], threads: Sequence[int], settings: dict[str, Any]) -> None:
    """Map frames on both, and print the times per frame and the number of differing cells."""
    card, on_card = mapped(frames, {**settings, "device": "cuda"})
    told = [f"card {milliseconds(on_card)}"]
    for number in threads:
        processor, times = mapped(frames, {**settings, "threads": number})
        told.append(f"{number} threads {milliseconds(times)}")
    print(f"{settings}: {', '.join(told)}; {differing(card, processor)}", flush=True)


def mapped(frames: Sequence[sv.Frame], settings: dict[str, Any]) -> tuple[sv.VoxelMap, list[float]]:
    """Return the map of frames, and the seconds per frame."""
    mapper, times = sv.Mapper(**settings), []
    for frame in frames:
        start = perf_counter()
        mapper.add(frame)
        times.append(perf_counter() - start)
    return mapper.map, times[FIRST:]


def milliseconds(times: Sequence[float]) -> str:
    """Describe the times of frames."""
    median, nearly_all = 1e3 * np.quantile(times, [0.5, 0.95])
    return f"{median:.2f} ms (95 %: {nearly_all:.2f})"


def differing(a: sv.VoxelMap, b: sv.VoxelMap) -> str:
    """Describe how many cells of two maps differ, and how many of them in their state."""
    states, unknown = CellRules(a.config.map).states, a.storage.cell_format.unknown
    known = numbers = other = 0
    for _, ours, theirs in block_pairs(a, b):
        known += int(((ours != unknown) | (theirs != unknown)).sum())
        numbers += int((ours != theirs).sum())
        other += int((states(ours) != states(theirs)).sum())
    return f"{numbers} of {known} cells differ, {other} in their state"


if __name__ == "__main__":
    main()
