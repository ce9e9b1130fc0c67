# SPDX-License-Identifier: Apache-2.0
"""What a frame costs before there is anything to do: Python's part of `Mapper.add`."""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.evaluate.bench_frames import Progress, silent
from stereovox.evaluate.bench_table import Table
from stereovox.frame import Frame
from stereovox.mapper import Mapper

SIZES = ((8, 6), (160, 120), (320, 240), (640, 480))
"""Width and height of the images; the field of view is the same."""
DEPTH_M = 0.5
WARM = 20
"""Rounds that do not count."""


def overhead(
    config: Config, repeats: int = 400, sizes: Sequence[tuple[int, int]] = SIZES, tell: Progress = silent
) -> dict[str, Any]:
    """Time `Mapper.add` on images in which a single pixel has a value, sizes by turns.

    With a few pixels there is nothing to do for kernels, so that all of it is overhead. With more, kernels look through
    the pixels, which takes time in proportion to their number: the part that does not grow with it is the overhead, or
    a little more than that.

    Returns microseconds: `rows` of `width, height, add_us` (least), `add_us_median`, `depth_us` and `integrate_us`
    (medians of what the report tells); and `fixed_us`: a straight line through the least times, where it meets zero
    pixels (None with a single size).
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
    """Return a frame in millimetres (uint16) without any value, but for one pixel in its middle."""
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
