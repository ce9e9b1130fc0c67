# SPDX-License-Identifier: Apache-2.0
"""The rolling window: cost of a shift, and a long flight out and back with constant memory and constant time.

    python benchmarks/rolling.py [METRES]

Flies METRES (2,000) of a simulated boulevard out and back three times: with cells outside dropped, kept in tiles, and
with an unbounded map, whose cells the tiles must equal.
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path
from time import perf_counter

import numpy as np

from stereovox import Mapper, PinholeCamera, VoxelMap, open_source
from stereovox.config import load_config
from stereovox.frame import Viewpoint
from stereovox.maps import make_map
from stereovox.maps.cells.evidence import Evidence

CHIEN = {"voxel_size": 0.2, "window.size": [20.0, 6.0, 20.0]}
FLIGHT = {"voxel_size": 0.2, "max_range": 5.0, "window.size": [20.0, 20.0, 16.0]}
"""The window contains the whole view up to 5 m, so that nothing is cut off and maps are comparable."""


def main() -> None:
    length = float(sys.argv[1]) if len(sys.argv) > 1 else 2000.0
    for outside in ("drop", "keep"):
        print(f"shift by one cell, 100x30x100 map full of cells, {outside}: {shift_ms(outside):.4f} ms (median)")
    source = open_source(f"sim:flight?length={length:g}")
    maps = {}
    for name, settings in (
        ("drop", {**FLIGHT, "window.outside": "drop"}),
        ("keep", {**FLIGHT, "window.outside": "keep"}),
        ("unbounded", {k: v for k, v in FLIGHT.items() if not k.startswith("window")}),
    ):
        maps[name] = fly(name, source, settings)
    same = all(
        np.array_equal(a, b)
        for a, b in zip(maps["keep"].storage.blocks(), maps["unbounded"].storage.blocks(), strict=True)
    )
    print(f"tiles and window together equal the unbounded map: {same}")


def shift_ms(outside: str) -> float:
    """Return the median time of moving a full window by one cell, with evidence restored in between."""
    rolling = make_map(load_config(**CHIEN, **{"window.outside": outside}))
    blocks = np.stack(np.meshgrid(*map(np.arange, (-8, -3, -8), (60, 4, 8)), indexing="ij"), -1).reshape(-1, 3)
    full = Evidence(np.empty((0, 3), np.int32), np.empty((0, 512), np.int16), blocks.astype(np.int32), -100)
    camera, times, T = PinholeCamera.from_field_of_view(848, 480, 91.2), [], np.eye(4)
    for i in range(200):
        T[0, 3] = 0.2 * i + 1.0
        view = Viewpoint(camera, T, i)
        start = perf_counter()
        rolling.storage.set_viewpoint(view)
        times.append(1e3 * (perf_counter() - start))
        rolling.add(full)
    rolling.close()
    return float(np.median(times[20:]))


def fly(name: str, source, settings: dict) -> VoxelMap:
    mapper = Mapper(**settings)
    times, memory, resident = [], [], []
    for i, frame in enumerate(source):
        report = mapper.add(frame)
        assert report.refused is None, report.detail
        times.append(report.integrate_ms)
        if i % 200 == 199:
            gc.collect()
            memory.append(mapper.map.memory_bytes)
            resident.append(resident_bytes())
    tell(name, np.array(times[100:]), np.array(memory), np.array(resident))
    return mapper.map


def tell(name: str, times: np.ndarray, memory: np.ndarray, resident: np.ndarray) -> None:
    hundred = times[: len(times) // 100 * 100].reshape(-1, 100)
    medians = np.median(hundred, axis=1)
    slope, error = (100 * x * len(medians) / medians.mean() for x in line(medians))
    megabytes = [f"{values.min() / 1e6:.2f} to {values.max() / 1e6:.2f} MB" for values in (memory, resident)]
    print(
        f"{name}: {len(times)} frames, median {np.median(times):.3f} ms, p99 {np.percentile(times, 99):.3f} ms, ",
        end="",
    )
    print(
        f"longest {times.max():.2f} ms; change over the flight {slope:+.1f} % (standard error {error:.1f} %); ", end=""
    )
    print(f"map {megabytes[0]}, process {megabytes[1]}")


def line(values: np.ndarray) -> tuple[float, float]:
    """Return the slope of a straight line through values at equal steps, and its standard error."""
    x = np.arange(len(values)) - (len(values) - 1) / 2
    slope = (x * values).sum() / (x * x).sum()
    rest = values - values.mean() - slope * x
    return float(slope), float(np.sqrt((rest**2).sum() / max(len(values) - 2, 1) / (x * x).sum()))


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


if __name__ == "__main__":
    main()
