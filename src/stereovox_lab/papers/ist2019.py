# SPDX-License-Identifier: Apache-2.0
"""Reproduction of IST 2019: a Kinect maps two floors along a lidar's trajectory, scored against the lidar's map."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from stereovox.opening import open_robot
from stereovox.sources.robots.robot import Robot
from stereovox_lab.papers.chapter import Chapter, Progress
from stereovox_lab.papers.formulas.audit import formulas
from stereovox_lab.papers.ist.chapters import fans_chapter, floor_chapter, time_chapter
from stereovox_lab.papers.ist.drives import PLACES, Drive, Extent, Place, Recording, messages, record
from stereovox_lab.papers.ist.fans import DISTANCE, FEW, MANY, simulate
from stereovox_lab.papers.ist.publish import SIDE, TIMES, time_publishing
from stereovox_lab.papers.ist.survey import Survey, survey
from stereovox_lab.papers.ist.variants import VARIANTS, Variant
from stereovox_lab.papers.output import Steps, output_files, write_result

TITLE = "Reproduction of IST 2019"
LEAD = (
    "A Pioneer robot with a Kinect maps a floor in two dimensions (report, Instituto Superior T\u00e9cnico, 2019): a "
    "reference map by SLAM from its lidar, localisation in that map, then an occupancy grid from depth images. The "
    "report's bags were not published; ours are recorded in simulated floors of the same kind, whose truth is known: "
    "its figures stand next to ours and were not measured on the same data."
)
OWN = (
    "The same chain on a recording of your own: a reference map by SLAM from its lidar, localisation in that map, then "
    "occupancy grids from its depth images. The report's figures are of its own recordings."
)
HEADS = ("claim", "report, or wanted", "ours", "holds?")
FAST = "speed=1.5&scan_hz=4"
_OTHERS = 2 + TIMES


@dataclass(frozen=True)
class Sizes:
    """Size of each experiment."""

    extent: Extent = Extent()  # noqa: RUF009 - frozen
    variants: tuple[Variant, ...] = VARIANTS
    published: int = SIDE


QUICK = Sizes(Extent(f"{FAST}&depth_hz=2&image_width=320", FAST), (*VARIANTS[:3], VARIANTS[4]), 1000)
"""Whole drives, but fewer scans and images, and small ones."""


def reproduce(out: Path, data: str | Path | None, quick: bool, progress: Progress) -> dict[str, Any]:
    """Run all experiments; see `stereovox_lab.papers.reproduce`."""
    start = perf_counter()
    robot = None if data is None else open_robot(data)
    files = output_files(out)
    sizes = QUICK if quick else Sizes()
    found = own(robot, out, sizes, progress) if robot else floors(out, sizes, progress)
    found.append(formulas("ist2019"))
    lead = LEAD if robot is None else OWN
    seconds = perf_counter() - start
    result = write_result(files, found, seconds, paper="ist2019", title=TITLE, lead=lead, quick=quick, heads=HEADS)
    doubts = [{"experiment": one.name, **doubt} for one in found for doubt in one.numbers.get("doubts", ())]
    return {**result, "doubts": doubts}


def floors(out: Path, sizes: Sizes, progress: Progress, places: tuple[Place, ...] = PLACES) -> list[Chapter]:
    """Return the chapters of the report, on simulated floors."""
    drives = [Drive.through(place, sizes.extent) for place in places]
    total = sum(messages(drive) + _steps(drive.floor, drive.first) for drive in drives)
    steps = Steps(progress, total + _OTHERS)
    surveys: list[tuple[Place | None, Survey]] = []
    for drive in drives:
        name = drive.place.name
        with TemporaryDirectory() as folder:  # bags of gigabytes, if more images are requested
            recording = record(drive, Path(folder), steps.of(f"driving: {name}"))
            surveys.append((drive.place, survey(recording, sizes.variants, out, steps.of(f"mapping: {name}"))))
    return _chapters(surveys, sizes, steps.of)


def own(robot: Robot, out: Path, sizes: Sizes, progress: Progress) -> list[Chapter]:
    """Return the chapters on a user's own recording, which need no truth."""
    steps = Steps(progress, _steps(robot, robot) + _OTHERS)
    name = re.sub(r"[^\w.-]+", "_", Path(robot.name).stem)  # it becomes part of files' names
    recording = Recording(name, robot, robot)
    found = survey(recording, sizes.variants, out, steps.of(f"mapping: {recording.name}"))
    return _chapters([(None, found)], sizes, steps.of)


def _steps(robot: Any, first: Any) -> int:
    return len(first.scans) + len(robot.scans) + len(robot.frames)


def _chapters(
    surveys: list[tuple[Place | None, Survey]], sizes: Sizes, steps: Callable[[str], Callable[[], None]]
) -> list[Chapter]:
    """Return simulation, floors and times; times come last, when all kernels are compiled."""
    step = steps("synthetic beams")
    many, few = simulate([DISTANCE] * MANY, step), simulate(FEW, step)
    published = time_publishing(sizes.published, steps("publishing"))
    chapters = [floor_chapter(found, place) for place, found in surveys]
    return [fans_chapter(many, few), *chapters, time_chapter(many, surveys, published)]
