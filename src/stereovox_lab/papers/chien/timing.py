# SPDX-License-Identifier: Apache-2.0
"""Time tables 4.2 and 4.3 of Chien 2020, measured on this machine: the same steps, the same conditions."""

from __future__ import annotations

import platform
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.depth.prepare import downsample
from stereovox.evaluate.metrics import percentiles
from stereovox.frame import DepthImage, Frame
from stereovox.integrate import make_integrator
from stereovox.mapper import Mapper
from stereovox.maps import make_map
from stereovox.simulate.simulation import Simulation
from stereovox.view.figures import labels
from stereovox.view.plain import colour_depth, plan_pixels, space_pixels
from stereovox_lab.papers.chapter import Chapter, Claim, Sheet, Shown
from stereovox_lab.papers.pictures import OURS, THESIS, figure_of, png

BATCH = 25
"""Frames simulated at once; then every step runs over all of them, so that simulation is not timed."""
FIRST = 10
"""Frames at the start that are not counted: they compile kernels, allocate and fill caches."""
VIEW_EVERY = 5
"""Views are drawn only once per this many frames: they take longer than all the rest."""
STEP_HEADS = ("function", "thesis", "ours, mean", "ours, median", "ours, 99 %", "what was timed")
FRAME_HEADS = ("condition", "thesis", "thesis, fps", "ours, mean", "ours, median", "ours, fps", "times faster")
MEANS = (
    "Times are of the processor, by one thread; they are figures and no claims, because the machines differ. Means are "
    "given, as in the thesis. Its frame includes reading the cameras and extracting a point cloud, ours "
    "begins with the raw image in memory, and no point cloud is made."
)
VIEWS = (
    "With visualization: after a frame the map is turned into pixels on the same processor core. 2D is the layer at "
    "the camera's height, 3D the occupied cells as shaded cubes, 640x640, both by NumPy and without a window; the "
    "thesis's pictures come from a graphics card. Every fifth frame was timed. In practice stereovox view draws in "
    "the browser and takes nothing of the mapping's time."
)


@dataclass(frozen=True)
class Step:
    """A row of Table 4.2: its name, the thesis's milliseconds (None: not in the thesis), and our timed equivalent."""

    name: str
    thesis_ms: float | None
    timed: str


@dataclass(frozen=True)
class Condition:
    """A row of Table 4.3: one whole frame, from the raw image to the map (and the picture).

    views: pictures drawn after each frame, `2D`, `3D` or both.
    """

    name: str
    thesis_ms: float | None
    integrator: str = "line"
    downsample: int = 8
    views: tuple[str, ...] = ()


STEPS = (
    Step("Resolution downsampling (10x10)", 5.48, "block minimum of 848x480 pixels with their reasons"),
    Step("Point cloud extraction", 19.16, "none is needed; nearest equivalent: back-projecting every pixel (NumPy)"),
    Step("Colorized depth image (optional)", 21.79, "colour map by table look-up (NumPy)"),
    Step("Fast voxel traversal + map update", 10.49, "10x10: evidence of all rays, and adding it to the map"),
    Step("Line drawing + map update", 9.77, "10x10: evidence of all lines, and adding it to the map"),
    Step(
        "Check and convert the depth image", None, "raw 16-bit image to metres and reasons; not in the thesis's table"
    ),
)
CONDITIONS = (
    Condition("3D + 2D visualization", 52.075, views=("2D", "3D")),
    Condition("3D visualization only", 40.205, views=("3D",)),
    Condition("2D visualization only", 51.384, views=("2D",)),
    Condition("10x10, line drawing, no visualization", 28.475, downsample=10),
    Condition("8x8, line drawing, no visualization", 36.517),
    Condition("Full resolution, line drawing, no visualization", 665.320, downsample=1),
    Condition("8x8, voxel traversal", None, "ray"),
    Condition("Full resolution, voxel traversal", None, "ray", 1),
    Condition("Full resolution, projective (the default)", None, "projective", 1),
)


@dataclass(frozen=True)
class Timed:
    """Milliseconds of a row: median, 90 and 99 %, longest; number of frames, and the thesis's mean."""

    row: Step | Condition
    ms: dict[str, float]
    mean_ms: float
    frames: int

    def figures(self) -> dict[str, Any]:
        """Return its numbers, fit for JSON."""
        return {"name": self.row.name, "thesis_ms": self.row.thesis_ms, "ms": self.ms, "mean_ms": self.mean_ms,
                "frames": self.frames}  # fmt: skip


def time_tables(
    *, frames: int = 250, location: str = "sim:apartment?axes=optical", step: Callable[[], None] = lambda: None
) -> tuple[list[Timed], list[Timed]]:
    """Return Table 4.2 and Table 4.3, one thread, profile `chien2020`: a map of 100x30x100 cells of 0.2 m.

    The images are the first `frames` of a walk through rooms. step: called after each frame.
    """
    steps, conditions = _Steps(), [_Condition(condition) for condition in CONDITIONS]
    done = 0
    for batch in _batches(location, frames):
        steps.add(batch, counted=done >= FIRST)
        for condition in conditions:
            condition.add(batch, counted=done >= FIRST)
        done += len(batch)
        for _ in batch:
            step()
    return steps.table(), [condition.timed() for condition in conditions]


def processor() -> str:
    """Return the name of this machine's processor, if known."""
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


class _Steps:
    """Times the rows of Table 4.2 on the same images."""

    def __init__(self) -> None:
        self._config = load_config("chien2020", **{"depth.downsample": 1})
        configs = [load_config(self._config, integrator=name) for name in ("ray", "line")]
        self._tracers = [(make_integrator(config), make_map(config)) for config in configs]
        self._ms: dict[str, list[float]] = defaultdict(list)

    def add(self, batch: Sequence[Frame], counted: bool) -> None:
        names = [step.name for step in STEPS]
        images = [self._time(names[5], counted, prepare, frame, self._config) for frame in batch]
        small = [self._time(names[0], counted, downsample, image, 10) for image in images]
        for image in images:
            self._time(names[1], counted, image.camera.back_project, image.depth_m)
        for image in images:
            self._time(names[2], counted, colour_depth, image.depth_m, self._config.max_range)
        for name, tracer in zip(names[3:5], self._tracers, strict=True):
            for image in small:
                self._time(name, counted, _update, *tracer, image)

    def table(self) -> list[Timed]:
        return [_timed(step, self._ms[step.name]) for step in STEPS]

    def _time(self, name: str, counted: bool, function: Callable[..., Any], *arguments: Any) -> Any:
        start = process_time()
        result = function(*arguments)
        if counted:
            self._ms[name].append(1e3 * (process_time() - start))
        return result


class _Condition:
    """Times one row of Table 4.3."""

    def __init__(self, condition: Condition):
        settings = {"integrator": condition.integrator, "depth.downsample": condition.downsample}
        self._condition = condition
        self._mapper = Mapper(load_config("chien2020", **settings))
        self._ms: list[float] = []

    def add(self, batch: Sequence[Frame], counted: bool) -> None:
        for n, frame in enumerate(batch):
            shown = not self._condition.views or n % VIEW_EVERY == 0
            start = process_time()
            self._mapper.add(frame)
            if shown:
                self._show()
            if counted and shown:
                self._ms.append(1e3 * (process_time() - start))

    def timed(self) -> Timed:
        return _timed(self._condition, self._ms)

    def _show(self) -> None:
        if "2D" in self._condition.views:
            plan_pixels(self._mapper.map)
        if "3D" in self._condition.views:
            space_pixels(self._mapper.map)


def _update(integrator: Any, voxel_map: Any, image: DepthImage) -> None:
    voxel_map.storage.set_viewpoint(image.viewpoint)
    voxel_map.add(integrator.evidence(image))


def _timed(row: Step | Condition, ms: list[float]) -> Timed:
    return Timed(row, percentiles([0.0, *ms]), float(np.mean(ms)) if ms else 0.0, len(ms))


def _batches(location: str, frames: int) -> Iterator[list[Frame]]:
    simulation = Simulation(location)
    with ThreadPoolExecutor(2) as threads:
        yield list(threads.map(simulation.frame, range(FIRST)))
        for start in range(FIRST, FIRST + frames, BATCH):
            yield list(threads.map(simulation.frame, range(start, min(start + BATCH, FIRST + frames))))


def times_png(rows: Sequence[Timed]) -> bytes:
    """Return the milliseconds of a whole frame as bars, the thesis's next to ours."""
    figure = figure_of(0.5 * len(rows) + 1.0)
    axis = figure.add_subplot()
    place = np.arange(len(rows))
    known = [(p, row.row.thesis_ms) for p, row in zip(place, rows, strict=True) if row.row.thesis_ms]
    axis.barh([p - 0.2 for p, _ in known], [ms for _, ms in known], 0.38, color=THESIS, label="thesis, i7-8550U")
    axis.barh(place + 0.2, [row.mean_ms for row in rows], 0.38, color=OURS, label="ours, this machine, one thread")
    axis.set(xscale="log", yticks=place, yticklabels=[row.row.name for row in rows])
    axis.invert_yaxis()
    axis.legend(frameon=False, loc="lower right")
    labels(axis, "milliseconds a frame, mean (logarithmic)", "")
    return png(figure)


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
    return Claim(row.row.name, f"{thesis:.2f} ms", f"{row.mean_ms:.2f} ms", None)


def _step(row: Timed) -> tuple[str, ...]:
    timed = getattr(row.row, "timed", "")
    return (row.row.name, _thesis(row), f"{row.mean_ms:.2f}", f"{row.ms['median']:.2f}", f"{row.ms['p99']:.2f}", timed)


def _frame(row: Timed) -> tuple[str, ...]:
    thesis, mean = row.row.thesis_ms, row.mean_ms
    fps, faster = (f"{1000 / thesis:.1f}", f"{thesis / mean:.1f}") if thesis else ("-", "-")
    return (row.row.name, _thesis(row), fps, f"{mean:.2f}", f"{row.ms['median']:.2f}", f"{1000 / mean:.0f}", faster)


def _thesis(row: Timed) -> str:
    return "-" if row.row.thesis_ms is None else f"{row.row.thesis_ms:.2f}"
