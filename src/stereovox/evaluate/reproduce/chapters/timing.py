# SPDX-License-Identifier: Apache-2.0
"""Experiment 4 told: the time tables (Chien 2020, 4.4.3)."""

from __future__ import annotations

from collections.abc import Sequence

from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Sheet, Shown
from stereovox.evaluate.reproduce.timing import FIRST, Timed, processor
from stereovox.view.reproduce.timing import times_png

STEP_HEADS = ("function", "thesis", "ours, mean", "ours, median", "ours, 99 %", "what was timed")
FRAME_HEADS = ("condition", "thesis", "thesis, fps", "ours, mean", "ours, median", "ours, fps", "times faster")
MEANS = (
    "Means are compared because the thesis gives averages; whatever else the machine does makes them larger, the "
    "median less so. The thesis's frame includes reading the cameras and extracting a point cloud; ours begins with "
    "the raw image in memory, and no point cloud is made."
)
VIEWS = (
    "With visualization: after a frame the map is turned into pixels on the same processor core. 2D is the layer at "
    "the camera's height, 3D the occupied cells as shaded cubes, 640x640, both by NumPy and without a window; the "
    "thesis's pictures come from a graphics card. Every fifth frame was timed. In practice stereovox view draws in "
    "the browser and takes nothing of the mapping's time."
)


def chapter(steps: Sequence[Timed], conditions: Sequence[Timed]) -> Chapter:
    """Return the chapter. steps: Table 4.2; conditions: Table 4.3."""
    rows = [*steps, *conditions]
    shown = Shown(
        "Table 4.3",
        "Downsampling speeds up the mapping dramatically, from 1.5 fps to 35 fps with a 10x10 ratio.",
        "One whole frame, from the raw image to the updated map.",
        times_png(conditions),
    )
    return Chapter(
        "timing",
        "Time tables",
        f"A walk through rooms, 848x480, a map of 100x30x100 cells of 0.2 m that shifts; {steps[0].frames} frames "
        f"after the first {FIRST}. One thread of this machine ({processor()}); the thesis used an i7-8550U.",
        [claim for row in rows if (claim := _claim(row))],
        [shown],
        [
            Sheet("Table 4.2: time of each function in ms", STEP_HEADS, [_step(row) for row in steps]),
            Sheet(
                "Table 4.3: a whole frame in ms, and frames a second", FRAME_HEADS, [_frame(row) for row in conditions]
            ),
        ],
        [MEANS, VIEWS],
        {"processor": processor(), "threads": 1, "rows": [row.figures() for row in rows]},
    )


def _claim(row: Timed) -> Claim | None:
    thesis = row.row.thesis_ms
    if thesis is None:
        return None
    return Claim(f"{row.row.name}: no slower than the thesis", f"{thesis:.2f} ms", f"{row.mean_ms:.2f} ms",
                 row.mean_ms <= thesis)  # fmt: skip


def _step(row: Timed) -> tuple[str, ...]:
    timed = getattr(row.row, "timed", "")
    return (row.row.name, _thesis(row), f"{row.mean_ms:.2f}", f"{row.ms['median']:.2f}", f"{row.ms['p99']:.2f}", timed)


def _frame(row: Timed) -> tuple[str, ...]:
    thesis, mean = row.row.thesis_ms, row.mean_ms
    fps, faster = (f"{1000 / thesis:.1f}", f"{thesis / mean:.1f}") if thesis else ("-", "-")
    return (row.row.name, _thesis(row), fps, f"{mean:.2f}", f"{row.ms['median']:.2f}", f"{1000 / mean:.0f}", faster)


def _thesis(row: Timed) -> str:
    return "-" if row.row.thesis_ms is None else f"{row.row.thesis_ms:.2f}"
