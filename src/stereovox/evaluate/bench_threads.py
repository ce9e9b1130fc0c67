# SPDX-License-Identifier: Apache-2.0
"""How much faster do more threads make a frame?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from stereovox.evaluate.bench import Variant, median
from stereovox.evaluate.bench_frames import Progress, Recording, silent
from stereovox.evaluate.bench_machine import cores
from stereovox.evaluate.bench_table import Table
from stereovox.mapper import Mapper

PASSES = 4
"""The first is not timed; threads take turns in each."""


def thread_scaling(
    recording: Recording,
    voxel_sizes: Sequence[float],
    integrator: str = "projective",
    max_range: float | None = None,
    threads: Sequence[int] | None = None,
    tell: Progress = silent,
) -> dict[str, Any]:
    """Time the frames at each voxel size on 1 to all cores (or `threads`), by turns.

    Returns `integrator` and `rows` of `voxel_size, threads, integrate_ms_median, faster`: the median on one thread (the
    first of `threads`) divided by this one.
    """
    rows = []
    for size in voxel_sizes:
        configs = [
            Variant(integrator, n).config(size, max_range) for n in dict.fromkeys(threads or range(1, cores() + 1))
        ]
        times: dict[int, list[float]] = {config.threads: [] for config in configs}
        for number in range(PASSES):
            for config in configs:
                text = f"{config.threads} thread{'s' * (config.threads != 1)} at {size:g} m"
                tell(number, PASSES, text if number else f"{text}: compiling, if need be")
                mapper = Mapper(config)
                took = [mapper.add(frame).integrate_ms for frame in recording.frames]
                times[config.threads] += took if number else []
                tell(number + 1, PASSES, text)
        one = median(next(iter(times.values())))
        rows += [
            {"voxel_size": size, "threads": n, "integrate_ms_median": ms, "faster": round(one / max(ms, 1e-4), 3)}
            for n, ms in ((n, median(took)) for n, took in times.items())
        ]
    return {"integrator": integrator, "rows": rows}


def thread_table(result: dict[str, Any]) -> Table:
    """Return the result of `thread_scaling` as a table."""
    sizes = dict.fromkeys(row["voxel_size"] for row in result["rows"])
    groups = [
        [
            (f"{size:g} m", str(row["threads"]), f"{row['integrate_ms_median']:.2f}", f"{row['faster']:.2f} x")
            for row in result["rows"]
            if row["voxel_size"] == size
        ]
        for size in sizes
    ]
    return Table(f"Threads, {result['integrator']}", ("voxel", "threads", "ms/frame", "faster"), groups)
