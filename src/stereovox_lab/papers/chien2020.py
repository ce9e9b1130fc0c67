# SPDX-License-Identifier: Apache-2.0
"""Reproduction of Chien 2020: its experiments, their size and order, and the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from stereovox.config import load_config
from stereovox.opening import open_source
from stereovox.simulate.simulation import SIMPLE
from stereovox_lab.papers.chapter import Chapter, Progress
from stereovox_lab.papers.chien import aisle, apartment, boxes, grid, shifting, timing, tracers
from stereovox_lab.papers.chien.aisle import compare_aisles
from stereovox_lab.papers.chien.apartment import scan_apartment
from stereovox_lab.papers.chien.boxes import Placement, find_boxes, random_placements
from stereovox_lab.papers.chien.grid import CELL_M, Extent, widths_over_grid
from stereovox_lab.papers.chien.own import map_own
from stereovox_lab.papers.chien.shifting import OUTSIDE, fly
from stereovox_lab.papers.chien.timing import FIRST, time_tables
from stereovox_lab.papers.chien.tracers import compare_tracers
from stereovox_lab.papers.formulas.audit import formulas
from stereovox_lab.papers.output import Steps, output_files, write_result

TITLE = "Reproduction of Chien 2020"
LEAD = (
    "A 3-D occupancy grid from a RealSense D435 and T265 on a drone (MSc thesis, Penn State 2020): its experiments "
    "with simulated cameras in simulated scenes, whose truth is known. The thesis's recordings were not published and "
    "its pictures are not at hand; its numbers and words stand next to ours. Claims that are expected not to hold: two "
    "cells wide at any setting (chapter 2), solid walls at 0.2 m, and cells of 0.05 m through a drifting tracker "
    "(chapter 3)."
)
NOISE = {
    SIMPLE: "The simulated cameras' noise is independent from pixel to pixel, and they say why a value is missing: "
    "kinder than real ones (--camera d435).",
    "d435": "The simulated cameras of boxes, apartment and aisle err as real ones do (--camera d435): alike in "
    "neighbouring pixels, with holes, flying pixels and mismatches, and without reasons.",
    "kinect": "Boxes, apartment and aisle are seen by a simulated Kinect (--camera kinect), which sees up to 6 m.",
}
"""Noise underlying the figures, by camera."""
APARTMENT_FRAMES = 902


@dataclass(frozen=True)
class Sizes:
    """Size of each experiment."""

    box_updates: int = 100
    placements: int = 50
    placement_updates: int = 100
    apartment_every: int = 2
    aisle_frames: int = 100
    timed_frames: int = 250
    tracer_frames: int = 40
    flight_m: float = 80.0
    grid: Extent = Extent()  # noqa: RUF009 - frozen


QUICK = Sizes(100, 6, 20, 12, 40, 25, 10, 40.0, Extent(cells=(CELL_M,), noises=(0.08,), updates=(10,)))


def reproduce(
    out: Path, data: str | Path | None, quick: bool, progress: Progress, camera: str = SIMPLE
) -> dict[str, Any]:
    """Run all experiments; see `stereovox_lab.papers.reproduce`."""
    start = perf_counter()
    source = None if data is None else open_source(str(data))
    files = output_files(out)
    sizes = QUICK if quick else Sizes()
    steps = Steps(progress, _total(sizes) + (0 if source is None else len(source)))
    own = [] if source is None else [map_own(source, steps.of("your own recording"))]  # first: it may be unusable
    found = [*experiments(sizes, steps, camera), *own, formulas("chien2020")]
    lead = f"{LEAD} {NOISE[camera]}"
    result = write_result(files, found, perf_counter() - start, paper="chien2020", title=TITLE, lead=lead, quick=quick)
    return {**result, "camera": camera}


def experiments(sizes: Sizes, steps: Steps, camera: str = SIMPLE) -> list[Chapter]:
    """Return all chapters of the thesis; camera: of boxes, apartment and aisle, as in the simulation's options."""
    at_2_m = [Placement("large", 2.0), Placement("small", 2.0)]
    two = find_boxes(at_2_m, updates=sizes.box_updates, camera=camera, step=steps.of("two boxes"))
    placed = list(random_placements(sizes.placements))
    stepping = steps.of("boxes at random places")
    many = find_boxes(placed, updates=sizes.placement_updates, camera=camera, step=stepping)
    widths = widths_over_grid(sizes.grid, camera=camera, step=steps.of("boxes at many settings"))
    where = f"sim:apartment?camera={camera}"
    scanned = scan_apartment(every=sizes.apartment_every, location=where, step=steps.of("apartment"))
    aisles, simulation = compare_aisles(frames=sizes.aisle_frames, camera=camera, step=steps.of("aisle"))
    compared = [compare_tracers(n, frames=sizes.tracer_frames, step=steps.of("ray tracers")) for n in (8, 1)]
    flights = [fly(outside, length_m=sizes.flight_m, step=steps.of("map shifting")) for outside in OUTSIDE]
    times = time_tables(frames=sizes.timed_frames, step=steps.of("time tables"))  # last, when all kernels are compiled
    found = [
        boxes.chapter(two, many, sizes.box_updates),
        grid.chapter(widths),
        apartment.chapter(scanned),
        aisle.chapter(aisles, simulation.scene),
        timing.chapter(*times),
        tracers.chapter(compared, load_config("chien2020").voxel_size),
        shifting.chapter(flights),
    ]
    for flight in flights:
        flight.voxel_map.close()
    return found


def _total(sizes: Sizes) -> int:
    flight_frames = 2 * (round(sizes.flight_m / 5 * 30) + 1)
    images = (
        -(-APARTMENT_FRAMES // sizes.apartment_every)
        + sizes.aisle_frames
        + FIRST
        + sizes.timed_frames
        + 2 * sizes.tracer_frames
    )
    return 2 + sizes.placements + sizes.grid.images + images + flight_frames
