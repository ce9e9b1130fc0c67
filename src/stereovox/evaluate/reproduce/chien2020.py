# SPDX-License-Identifier: Apache-2.0
"""Chien 2020 made again: which experiments, how large, in which order, and the two files they end in."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.evaluate.reproduce.aisle import compare_aisles
from stereovox.evaluate.reproduce.apartment import scan_apartment
from stereovox.evaluate.reproduce.boxes import Placement, find_boxes, random_placements
from stereovox.evaluate.reproduce.chapter import Chapter, Progress
from stereovox.evaluate.reproduce.chapters import aisle, apartment, boxes, shifting, timing, tracers
from stereovox.evaluate.reproduce.own import map_own
from stereovox.evaluate.reproduce.page import report
from stereovox.evaluate.reproduce.shifting import OUTSIDE, fly
from stereovox.evaluate.reproduce.timing import FIRST, time_tables
from stereovox.evaluate.reproduce.tracers import compare_tracers
from stereovox.sources import open_source

TITLE = "Chien 2020, made again"
APARTMENT_FRAMES = 902


@dataclass(frozen=True)
class Sizes:
    """How much of each experiment is done."""

    box_updates: int = 100
    placements: int = 50
    placement_updates: int = 100
    apartment_every: int = 2
    aisle_frames: int = 100
    timed_frames: int = 250
    tracer_frames: int = 40
    flight_m: float = 80.0


QUICK = Sizes(100, 6, 20, 12, 40, 25, 10, 40.0)


def reproduce(out: Path, data: str | Path | None, quick: bool, progress: Progress) -> dict[str, Any]:
    """Run all experiments; see `stereovox.evaluate.reproduce.reproduce`."""
    start = perf_counter()
    folder = _folder(out)
    own = None if data is None else open_source(str(data))  # what cannot be opened is said at once
    sizes = QUICK if quick else Sizes()
    steps = _Steps(progress, _total(sizes))
    found = experiments(sizes, steps)
    if own is not None:
        found.append(map_own(own, steps.of("your own recording")))
    seconds = perf_counter() - start
    files = {"report": folder / "report.html", "numbers": folder / "numbers.json"}
    claims = [claim for chapter in found for claim in chapter.claims]
    result = {
        "paper": "chien2020",
        "quick": quick,
        "holds": sum(claim.holds is True for claim in claims),
        "does_not_hold": [claim.text for claim in claims if claim.holds is False],
        "seconds": round(seconds, 1),
        "files": {name: str(path) for name, path in files.items()},
    }
    numbers = {chapter.name: chapter.summary() for chapter in found}
    _write(files["numbers"], json.dumps({**result, "experiments": numbers}, indent=1, allow_nan=False) + "\n")
    _write(files["report"], report(TITLE, _lead(quick), _facts(found, seconds), found))
    return result


def experiments(sizes: Sizes, steps: _Steps) -> list[Chapter]:
    """Return all chapters of the thesis."""
    at_2_m = [Placement("large", 2.0), Placement("small", 2.0)]
    two = find_boxes(at_2_m, updates=sizes.box_updates, step=steps.of("two boxes"))
    placed = list(random_placements(sizes.placements))
    many = find_boxes(placed, updates=sizes.placement_updates, step=steps.of("boxes at random places"))
    scanned = scan_apartment(every=sizes.apartment_every, step=steps.of("apartment"))
    aisles, simulation = compare_aisles(frames=sizes.aisle_frames, step=steps.of("aisle"))
    compared = [compare_tracers(n, frames=sizes.tracer_frames, step=steps.of("ray tracers")) for n in (8, 1)]
    flights = [fly(outside, length_m=sizes.flight_m, step=steps.of("map shifting")) for outside in OUTSIDE]
    times = time_tables(frames=sizes.timed_frames, step=steps.of("time tables"))  # last: all kernels are compiled
    found = [
        boxes.chapter(two, many, sizes.box_updates),
        apartment.chapter(scanned),
        aisle.chapter(aisles, simulation.scene),
        timing.chapter(*times),
        tracers.chapter(compared, load_config("chien2020").voxel_size),
        shifting.chapter(flights),
    ]
    for flight in flights:
        flight.voxel_map.close()
    return found


class _Steps:
    """Counts what is done over all experiments."""

    def __init__(self, progress: Progress, total: int):
        self._progress, self._total, self._done = progress, total, 0

    def of(self, text: str) -> Callable[[], None]:
        """Return a function to call after each step of one experiment."""

        def step() -> None:
            self._done += 1
            self._progress(min(self._done, self._total), self._total, text)

        self._progress(self._done, self._total, text)
        return step


def _total(sizes: Sizes) -> int:
    flight_frames = 2 * (round(sizes.flight_m / 5 * 30) + 1)
    images = (
        -(-APARTMENT_FRAMES // sizes.apartment_every)
        + sizes.aisle_frames
        + FIRST
        + sizes.timed_frames
        + 2 * sizes.tracer_frames
    )
    return 2 + sizes.placements + images + flight_frames


def _lead(quick: bool) -> str:
    text = (
        "A 3-D occupancy grid from a RealSense D435 and T265 on a drone (MSc thesis, Penn State 2020): its "
        "experiments with simulated cameras in simulated scenes, whose truth is known. The thesis's recordings were "
        "not published and its pictures are not at hand; its numbers and words stand beside ours."
    )
    return text + (" A quick run with few frames: do not quote it." if quick else "")


def _facts(found: list[Chapter], seconds: float) -> list[tuple[str, str]]:
    verdicts = [claim.holds for chapter in found for claim in chapter.claims]
    return [
        (f"{verdicts.count(True)}", "claims hold"),
        (f"{verdicts.count(False)}", "claims do not"),
        (f"{verdicts.count(None)}", "figures without a claim"),
        (f"{seconds / 60:.1f} min", "for everything"),
    ]


def _folder(out: Path) -> Path:
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StereovoxError(
            f"{out}: cannot make this folder ({error.strerror or error}); choose another --out"
        ) from None
    return out


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise StereovoxError(f"{path}: cannot write ({error.strerror or error}); choose another --out") from None
