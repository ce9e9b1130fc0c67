# SPDX-License-Identifier: Apache-2.0
"""Reproduction of Valenti 2018, chapter 8: maps of real drives against lidar, and the claims about them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from stereovox.errors import StereovoxError
from stereovox_lab.papers.chapter import Chapter, Progress
from stereovox_lab.papers.formulas.audit import formulas
from stereovox_lab.papers.output import Steps, output_files, write_result
from stereovox_lab.papers.valenti.apart import apart
from stereovox_lab.papers.valenti.chapters import drive_chapter, speed_chapter, table_chapter
from stereovox_lab.papers.valenti.judge import Judged, judge, kinds
from stereovox_lab.papers.valenti.mappers import (
    DEFAULT,
    MAPPERS,
    OCTOMAP,
    THESIS,
    Matched,
    Setting,
    config_of,
    why_missing,
)
from stereovox_lab.papers.valenti.recordings import Drive, find_drives
from stereovox_lab.papers.valenti.speed import MAX_FRAMES, time_mapping

TITLE = "Reproduction of Valenti 2018"
LEAD = (
    "Stereo pairs of a driving car become maps, which are compared with what the car's lidar saw (PhD thesis, Parma "
    "2018, chapter 8). Three mappers on the same frames: valenti2018, which does as the thesis does; default, "
    "stereovox's own way; and OctoMap on the disparities of default. Thresholds are never chosen where they are "
    "scored: of several drives each is scored with those of the others; a single one is cut into two halves of its way."
)
HEADS = ("claim", "wanted, or thesis", "ours", "holds?")
TABLE = Setting(0.5, 20.0)
"""The setting shown frame by frame, and next to Table 8.1."""
TIMED = Setting(0.2, 20.0)


@dataclass(frozen=True)
class Extent:
    """Extent of the experiments: settings, and frames of each drive (None: all)."""

    settings: tuple[Setting, ...]
    frames: int | None = None


FULL = Extent(tuple(Setting(size, reach) for reach in (20.0, 40.0) for size in (0.5, 0.4, 0.2)))
QUICK = Extent((TABLE, Setting(0.4, 20.0)), 8)


def reproduce(out: Path, data: str | Path | None, quick: bool, progress: Progress) -> dict[str, Any]:
    """Run everything; see `stereovox_lab.papers.reproduce`."""
    if data is None:
        raise StereovoxError("valenti2018 needs recordings: --data DIR with KITTI tracking sequences or a raw drive")
    start = perf_counter()
    drives, files = find_drives(data), output_files(out)
    found = [*experiments(drives, QUICK if quick else FULL, progress), formulas("valenti2018")]
    seconds = perf_counter() - start
    return write_result(files, found, seconds, paper="valenti2018", title=TITLE, lead=LEAD, quick=quick, heads=HEADS)


def experiments(drives: list[Drive], extent: Extent, progress: Progress) -> list[Chapter]:
    """Return all chapters: Table 8.1, one for each drive, and the time of the first."""
    missing = why_missing(OCTOMAP)
    mappers = [name for name in MAPPERS if name != OCTOMAP or not missing]
    frames = {drive.name: list(range(len(drive)))[: extent.frames] for drive in drives}
    first, alone = drives[0], len(drives) == 1
    steps = Steps(progress, _total(list(frames.values()), extent))
    judged: list[Judged] = []
    of_lidar = {}
    for drive in drives:
        numbers, counts = frames[drive.name], {}
        matched = {name: Matched(drive, numbers, config_of(name, TABLE)) for name in (THESIS, DEFAULT)}
        for setting in extent.settings:
            step = steps.of(f"{drive.name}: {setting}")
            maps, counts[str(setting)] = judge(
                drive, numbers, setting, matched, mappers, every_frame=setting == TABLE, halved=alone, step=step
            )
            judged += maps
        of_lidar[drive.name] = counts
    maps = apart(judged)
    chapters = [
        drive_chapter([one for one in maps if one.judged.drive == name], counts, missing)
        for name, counts in of_lidar.items()
    ]
    step = steps.of("time")
    speeds = [time_mapping(first, frames[first.name], name, TIMED, step) for name in (DEFAULT, THESIS)]
    return [table_chapter(judged, TABLE, missing), *chapters, speed_chapter(speeds)]


def _total(frames: list[list[int]], extent: Extent) -> int:
    passes = sum(len(kinds(setting == TABLE)) + 2 for setting in extent.settings)
    return passes * sum(map(len, frames)) + 4 * min(len(frames[0]), MAX_FRAMES)
