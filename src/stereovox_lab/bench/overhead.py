# SPDX-License-Identifier: Apache-2.0
"""Fixed cost of a frame, and speed-up by threads."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox_lab.bench.frames import Progress, Recording, silent
from stereovox_lab.bench.machine import cores
from stereovox_lab.bench.results import Table
from stereovox_lab.bench.rows import Variant, median

PASSES = 4
"""Passes over the frames; the first is not timed; thread counts take turns in each."""
SIZES = ((8, 6), (160, 120), (320, 240), (640, 480))
"""Width and height of the images; the field of view is the same."""
DEPTH_M = 0.5
WARM = 20
"""Warm-up rounds, not counted."""


def thread_scaling(
    recording: Recording,
    voxel_sizes: Sequence[float],
    integrator: str = "projective",
    max_range: float | None = None,
    threads: Sequence[int] | None = None,
    tell: Progress = silent,
) -> dict[str, Any]:
    """Time the frames at each voxel size on 1 to all cores (or `threads`), taking turns.

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


def overhead(
    config: Config, repeats: int = 400, sizes: Sequence[tuple[int, int]] = SIZES, tell: Progress = silent
) -> dict[str, Any]:
    """Time `Mapper.add` on images in which a single pixel has a value, with sizes taking turns.

    Small images give kernels nothing to do, so that all of it is overhead. In larger ones kernels scan the pixels, in
    time proportional to their number: the part that does not grow with it is the overhead, or slightly more.


    Returns microseconds: `rows` of `width, height, add_us` (least), `add_us_median`, `depth_us` and `integrate_us`
    (medians from the report); and `fixed_us`: the intercept at zero pixels of a straight line through the least times
    (None with a single size).
    """
    frames = [empty_frame(width, height) for width, height in sizes]
    mappers = [Mapper(load_config(config, **{"trust.min_valid_share": 0})) for _ in frames]
    times: list[list[tuple[float, float, float]]] = [[] for _ in frames]
    for number in range(repeats + WARM):
        for frame, mapper, took in zip(frames, mappers, times, strict=True):
            start = perf_counter()
            report = mapper.add(frame)
            took.append((1e3 * (perf_counter() - start), report.depth_ms, report.integrate_ms))
        tell(number + 1, repeats + WARM, "adding empty images")
    rows = [_row(*size, 1e3 * np.array(took[WARM:])) for size, took in zip(sizes, times, strict=True)]
    return {"rows": rows, "fixed_us": _at_zero(rows)}


def empty_frame(width: int, height: int) -> Frame:
    """Return a frame in millimetres (uint16) without any value, except one pixel in its middle."""
    depth = np.zeros((height, width), np.uint16)
    depth[height // 2, width // 2] = round(1000 * DEPTH_M)
    camera = PinholeCamera.from_field_of_view(width, height, 60.0, baseline=0.05)
    return Frame(depth, camera, np.eye(4), depth_scale=0.001)


def _row(width: int, height: int, times_us: NDArray[np.float64]) -> dict[str, Any]:
    add, depth, integrate = (round(float(value), 1) for value in np.median(times_us, axis=0))
    least = round(float(times_us[:, 0].min()), 1)
    parts = {"add_us_median": add, "depth_us": depth, "integrate_us": integrate}
    return {"width": width, "height": height, "add_us": least, **parts}


def _at_zero(rows: Sequence[dict[str, Any]]) -> float | None:
    if len(rows) < 2:
        return None
    pixels = [row["width"] * row["height"] for row in rows]
    _, fixed = np.polyfit(pixels, [row["add_us"] for row in rows], 1)
    return round(float(fixed), 1)


def overhead_table(result: dict[str, Any]) -> Table:
    """Return the result of `overhead` as a table."""
    rows = [
        (
            f"{row['width']}x{row['height']}",
            *(f"{row[name]:.0f}" for name in ("add_us", "add_us_median", "depth_us", "integrate_us")),
        )
        for row in result["rows"]
    ]
    notes = []
    if result["fixed_us"] is not None:
        notes.append(f"The part that does not grow with the pixels: {result['fixed_us']:.0f} us.")
    return Table(
        "Mapper.add on an image with one valid pixel", ("image", "us, least", "median", "depth", "map"), [rows], notes
    )
