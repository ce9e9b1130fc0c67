# SPDX-License-Identifier: Apache-2.0
"""What `stereovox eval` does with two floors' maps."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.floor_map import open_grid
from stereovox.cli.terminal import say, thousands

if TYPE_CHECKING:
    from stereovox.evaluate.grid_scores import GridScores

KINDS = {
    "missed": "known to the reference only",
    "wrongly_occupied": "free in the reference",
    "wrongly_free": "occupied in the reference",
    "extra": "known to the map only",
}
ALIKE = 0.3
"""IoU of walls within a cell below which two maps may be of different places."""


def judge(arguments: Namespace) -> dict[str, Any]:
    """Load both maps, lay one on the other, compare them, tell and report."""
    from stereovox.evaluate.grid_scores import laid_on, score_laid
    from stereovox.evaluate.truth_cells import level

    if arguments.threshold is not None:
        level(arguments.threshold)
    reference, grid = open_grid(arguments.truth), open_grid(arguments.map)
    if arguments.threshold is not None:
        grid = replace(grid, occupied_above=arguments.threshold, free_below=min(grid.free_below, arguments.threshold))
    aligned = not arguments.no_align
    laid = laid_on(grid, reference, arguments.exclude, aligned)
    scores = score_laid(laid, grid.resolution, aligned, arguments.tolerance)
    result = scores.as_dict()
    _tell(scores, len(arguments.exclude))
    if arguments.report:
        from stereovox.view.grid_report import write_grid_report

        names = Path(arguments.map).name, Path(arguments.truth).name
        page = write_grid_report(arguments.report, scores, laid, *names)
        say(f"report: {page}")
        result["report"] = str(page)
    return result


def _tell(scores: GridScores, regions: int) -> None:
    errors = scores.errors
    x, y, yaw = scores.motion
    if scores.aligned:
        say(f"the map was moved by {x:.3f}, {y:.3f} m and {np.degrees(yaw):.2f} degrees to lie on the reference")
    say(f"error {errors.eq7_percent:.2f} % (IST 2019, Eq 7): cells that differ, for 100 known to the reference")
    for kind, what in KINDS.items():
        say(f"{thousands(getattr(errors, kind)):>11} {kind.replace('_', ' ')}: {what}")
    if regions:
        say(f"excluded: {thousands(errors.excluded)} cells, of which {thousands(errors.forgiven)} differ; with them "
            f"out of the number below too the error is {_percent(errors.eq7_outside_percent)}")  # fmt: skip
    if regions and not errors.excluded:
        say("no cell lies in an excluded region: are they in metres, in the reference's frame?")
    say(f"of the {thousands(errors.known_in_both)} cells known to both {_percent(errors.known_error_percent)} differ")
    if not errors.known_in_both:
        say("the maps have no known cell in common: leave --no-align out, or are they of one place?")
    walls, within = scores.occupied, f"{scores.tolerance_cells} cell" + ("" if scores.tolerance_cells == 1 else "s")
    say(f"walls: IoU {_number(walls.iou)}, within {within} {_number(walls.iou_tolerant)} (precision "
        f"{_number(walls.tolerance_precision)}, recall {_number(walls.tolerance_recall)})")  # fmt: skip
    for figures, what in ((scores.to_reference, "map to reference"), (scores.from_reference, "reference to map")):
        if figures.mean is not None:
            say(f"walls, {what}: mean {figures.mean:.3f}, median {figures.median:.3f}, 95 % {figures.p95:.3f} m")
    say(f"free cells: IoU {_number(scores.free_iou)}; the map knows {_number(scores.coverage)} of the reference")
    if walls.iou_tolerant is not None and walls.iou_tolerant < ALIKE:
        say("note: their walls hardly match: are they of one place? --report DIR shows both")


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} %"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
