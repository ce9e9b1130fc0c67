# SPDX-License-Identifier: Apache-2.0
"""Compare a map with the ground truth, cell by cell: first its decisions, then its probabilities; or trajectories.

MAP and TRUTH are stereovox folders or OctoMap files (.bt, .ot) with cells of the same size; or both are floor maps
in map_server files (.yaml), of any cell size, which are aligned first; or both are files of poses (TUM lines, KITTI's
12 numbers), with the true ones in TRUTH.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.maps import dimensions, open_grid, refuse_options
from stereovox.cli.options import check_ending
from stereovox.cli.terminal import command_line, say, say_table, thousands
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.evaluate.grid_scores import GridScores
    from stereovox.evaluate.scores import Scores

DIFFERENCES = {
    "missed": "known to the reference only",
    "wrongly_occupied": "free in the reference",
    "wrongly_free": "occupied in the reference",
    "extra": "known to the map only",
}
POSE_ENDINGS = (".tum", ".txt", ".csv", ".kitti", ".freiburg", ".log", ".json", ".npy")
"""Suffixes of trajectories."""
ALIKE = 0.3
"""IoU of walls within a cell below which two maps may show different places."""
TOLERANCE = 1
"""Default of `--tolerance`, in cells."""
EXAMPLES = """stereovox eval drive.svox truth.svox --report drive-report
stereovox eval estimated.tum reference.tum --json"""
MEASURES = {
    "precision": "of the cells called occupied, hold a surface",
    "recall": "of the surface cells, are called occupied",
    "tolerance_precision": "precision, a surface within {} is enough",
    "tolerance_recall": "recall, an occupied cell within {} is enough",
    "accuracy": "of all cells, are classified correctly",
    "specificity": "of the free cells, are not called occupied",
    "npv": "of the cells not called occupied, are free",
    "iou": "intersection over union: tp / (tp + fp + fn)",
    "correlation": "of probability and truth, 1 is perfect",
}
AREAS = {
    "auc": "area under the ROC curve, 1 is perfect",
    "average_precision": "area under precision against recall, 1 is perfect",
}
F_SCORES = {
    "f_score_1": "harmonic mean of precision and recall within 1 cell",
    "f_score_2": "the same within 2 cells",
}
SINGLE = {
    "error": "mean squared error of the probabilities (Brier score), 0 is perfect",
    "ece": "how far probabilities are from the true shares (ECE), 0 is perfect",
    "ece_likely": "the same over cells with p >= 0.3",
    "ece_equal_mass": "the same in bins with equal numbers of cells",
}


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="map, or trajectory, to evaluate")
    about = "map whose occupied cells hold a surface and free cells hold none, or the true trajectory"
    parser.add_argument("truth", metavar="TRUTH", help=about)
    parser.add_argument("--report", metavar="DIR", help="folder for a page with charts")
    maps = parser.add_argument_group("maps")
    about = "a cell is called occupied above it (default: the map's own)"
    maps.add_argument("--threshold", type=float, metavar="P", help=about)
    about = f"distance that still counts as a match (default: {TOLERANCE})"
    maps.add_argument("--tolerance", type=int, metavar="CELLS", help=about)
    about = "poses of the camera, for precision, recall and decisions by distance (not for floor maps)"
    maps.add_argument("--path", metavar="FILE", help=about)
    about = "region that does not count, metres in TRUTH's frame; repeatable (only for floor maps)"
    maps.add_argument("--exclude", action="append", default=[], type=region, metavar="X0,Y0,X1,Y1", help=about)
    both = parser.add_argument_group("floor maps and trajectories")
    both.add_argument("--no-align", action="store_true", help="MAP and TRUTH share a frame: do not align MAP")
    poses = parser.add_argument_group("trajectories")
    about = "both from above, gaps of the estimate, and errors along the path and by length"
    poses.add_argument("--picture", metavar="FILE.png", help=about)
    poses.add_argument("--scale", action="store_true", help="fit the scale too, as for a single camera without scale")
    about = "poses farther apart in time are no pair (default: 0.02; not for poses without times)"
    poses.add_argument("--max-difference", type=float, metavar="S", help=about)
    about = (
        "length of a segment for errors by distance; repeatable (default: 100 to 800 m as KITTI, for trajectories of "
        "up to 100 m 1 to 50 m)"
    )
    poses.add_argument("--segment", action="append", default=[], type=float, metavar="M", help=about)


def run(arguments: Namespace) -> dict[str, Any]:
    """Load both maps or trajectories, compare them, print and report the scores."""
    from stereovox.maps.files.store import is_map

    poses = [path for path in (arguments.map, arguments.truth) if _holds_poses(path)]
    if len(poses) == 2:
        return _compare_trajectories(arguments)
    if poses:
        raise StereovoxError(f"{poses[0]}: a file of poses, but the other is not; give two maps or two files of poses")
    refuse_options(arguments, ("scale", "max_difference", "segment", "picture"), "only for trajectories")
    kinds = {dimensions(path) for path in (arguments.map, arguments.truth)}
    if len(kinds) == 2:
        space = arguments.map if dimensions(arguments.map) == 3 else arguments.truth
        command = ("export", space) if is_map(space) else ("grid", space, "--out")
        cure = command_line(*command, "floor.yaml")
        raise StereovoxError(f"{space}: is no floor map, but the other is; make one from it with: {cure}")
    return COMPARE[kinds.pop()](arguments)


def region(text: str) -> tuple[float, ...]:
    """Parse a region: four finite numbers; raises ArgumentTypeError for anything else."""
    try:
        numbers = tuple(map(float, text.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != 4 or not all(map(math.isfinite, numbers)):
        raise ArgumentTypeError(f"'{text}' is not a region; give X0,Y0,X1,Y1 in metres, two opposite corners")
    return numbers


def _holds_poses(path: str) -> bool:
    """Return whether a path names a file of poses, not a map."""
    return Path(path).suffix.lower() in POSE_ENDINGS and not Path(path).is_dir()


def _compare_trajectories(arguments: Namespace) -> dict[str, Any]:
    """Pair the poses of two files, print and report their differences."""
    from stereovox.evaluate.trajectory_score import score_trajectory
    from stereovox.view.report import trajectory as report

    refuse_options(arguments, ("threshold", "tolerance", "path", "exclude"), "only for maps")
    check_ending("--picture", arguments.picture, ".png")
    score = score_trajectory(
        arguments.map,
        arguments.truth,
        align=not arguments.no_align,
        scale=arguments.scale,
        max_difference_s=arguments.max_difference,
        segments_m=arguments.segment or None,
    )
    result = score.as_dict()
    say(f"{report.paired(score)}. {report.aligned(score)}")
    say_table(report.ERROR_HEADS, report.error_rows(score))
    if score.segments:
        say_table(report.SEGMENT_HEADS, report.segment_rows(score))
    if score.drift_percent is not None:
        say(f"drift: aligned at the start, the ends are {score.drift_percent:.3f} % of the length apart")
    for note in report.notes(score):
        say(note)
    if arguments.picture:
        from stereovox.view.trajectory import trajectory_picture

        trajectory_picture(score, arguments.picture)
        say(f"saved {arguments.picture}")
    if arguments.report:
        names = Path(arguments.map).name, Path(arguments.truth).name
        page = report.write_trajectory_report(arguments.report, score, *names)
        say(f"report: {page}")
        result["report"] = str(page)
    return result


def _compare_grids(arguments: Namespace) -> dict[str, Any]:
    """Load two floor maps, align them, compare them, print and report the scores."""
    from stereovox.evaluate.grid_scores import laid_on, score_laid
    from stereovox.evaluate.truth_cells import level

    refuse_options(arguments, ("path",), "distances from a camera do not apply to floor maps")
    if arguments.threshold is not None:
        level(arguments.threshold)
    reference, grid = open_grid(arguments.truth), open_grid(arguments.map)
    if arguments.threshold is not None:
        grid = replace(grid, occupied_above=arguments.threshold, free_below=min(grid.free_below, arguments.threshold))
    aligned = not arguments.no_align
    laid = laid_on(grid, reference, arguments.exclude, aligned)
    scores = score_laid(laid, grid.resolution, aligned, _tolerance(arguments))
    result = scores.as_dict()
    _print_grid_scores(scores, len(arguments.exclude))
    if arguments.report:
        from stereovox.view.report.grid import write_grid_report

        names = Path(arguments.map).name, Path(arguments.truth).name
        page = write_grid_report(arguments.report, scores, laid, *names)
        say(f"report: {page}")
        result["report"] = str(page)
    return result


def _compare_cells(arguments: Namespace) -> dict[str, Any]:
    from stereovox.evaluate.decisions import outcomes
    from stereovox.evaluate.inputs import path_fits, read_camera_path, read_map
    from stereovox.evaluate.scores import score
    from stereovox.evaluate.truth_cells import TruthCells, level

    refuse_options(arguments, ("exclude",), "only for floor maps (.yaml)")
    refuse_options(arguments, ("no_align",), "only for floor maps (.yaml) and trajectories")
    if arguments.threshold is not None:
        level(arguments.threshold)  # raises for a bad threshold before large maps are read
    path = None if arguments.path is None else read_camera_path(arguments.path)
    truth = TruthCells(read_map(arguments.truth), _tolerance(arguments))
    voxel_map = read_map(arguments.map)
    scores = score(voxel_map, truth, arguments.threshold, path=path)
    result = scores.as_dict()
    if scores.distance is not None:
        result["distance"] = scores.distance.rows()
    _print_decisions(scores)
    _print_scores(scores)
    if path is not None and not path_fits(path, truth, voxel_map.config.max_range):
        say("the path does not fit the map; is it in the map's world frame?")
    if arguments.report:
        from stereovox.view.report.evaluation import Evaluated, write_evaluation_report

        shown = outcomes(truth.read(voxel_map), truth, scores.threshold)
        evaluated = Evaluated(Path(arguments.map).name, scores, outcomes=shown)
        page = write_evaluation_report(arguments.report, [evaluated], Path(arguments.truth).name)
        say(f"report: {page}")
        result["report"] = str(page)
    return result


def _tolerance(arguments: Namespace) -> int:
    return TOLERANCE if arguments.tolerance is None else arguments.tolerance


COMPARE = {2: _compare_grids, 3: _compare_cells}


def _print_decisions(scores: Scores) -> None:
    from stereovox.evaluate import decisions

    say_table(decisions.HEADS, decisions.state_rows(scores.decisions))
    say_table(decisions.ERROR_HEADS, decisions.error_rows(scores.decisions, scores.tolerance_cells))
    say_table(decisions.PART_HEADS, decisions.part_rows(scores.parts))


def _print_scores(scores: Scores) -> None:
    observed = scores.observed
    say(f"{thousands(scores.cells)} cells of the truth, {scores.coverage:.1%} of them observed by the map")
    if not observed.cells:
        say("the map knows none of these; are both in the same world frame?")
    say(f"occupied: p > {scores.threshold:g}")
    say(f"{'':20}  {'all cells':>11}  {'observed':>11}")
    for name in ("tp", "fp", "tn", "fn"):
        say(f"{name:20}  {thousands(getattr(scores, name)):>11}  {thousands(getattr(observed, name)):>11}")
    within = "1 cell" if scores.tolerance_cells == 1 else f"{scores.tolerance_cells} cells"
    for name, text in MEASURES.items():
        values = (_number(getattr(one, name)) for one in (scores, observed))
        say(f"{name:20}  {next(values):>11}  {next(values):>11}  {text.format(within)}")
    for name, text in AREAS.items():
        values = _number(getattr(scores, name)), _number(getattr(scores, f"observed_{name}"))
        say(f"{name:20}  {values[0]:>11}  {values[1]:>11}  {text}")
    for name, text in F_SCORES.items():
        say(f"{name:20}  {_number(getattr(scores, name)):>11}  {'':>11}  {text}")
    best = scores.balanced
    say(f"balanced: at p > {best['threshold']:.2f} precision and recall within {within} are "
        f"{_number(best['tolerance_precision'])} and {_number(best['tolerance_recall'])}")  # fmt: skip
    for name, text in SINGLE.items():
        say(f"{name:20}  {'':>11}  {_number(getattr(scores, name)):>11}  {text}")


def _print_grid_scores(scores: GridScores, regions: int) -> None:
    errors = scores.errors
    x, y, yaw = scores.motion
    if scores.aligned:
        say(f"the map was aligned with the reference by {x:.3f}, {y:.3f} m and {np.degrees(yaw):.2f} degrees")
    say(f"error {errors.eq7_percent:.2f} % (IST 2019, Eq 7): cells that differ, per 100 known to the reference")
    say(f"  of it {errors.eq7_coverage_percent:.2f} % coverage (only one map knows the cell) and "
        f"{errors.eq7_contradiction_percent:.2f} % contradiction (free in one, occupied in the other)")  # fmt: skip
    for kind, what in DIFFERENCES.items():
        say(f"{thousands(getattr(errors, kind)):>11} {kind.replace('_', ' ')}: {what}")
    if regions:
        say(f"excluded: {thousands(errors.excluded)} cells, of which {thousands(errors.forgiven)} differ; without them "
            f"in the denominator too, the error is {_percent(errors.eq7_outside_percent)}")  # fmt: skip
    if regions and not errors.excluded:
        say("no cell is in an excluded region; are the regions in metres, in the reference's frame?")
    say(f"of the {thousands(errors.known_in_both)} cells known to both {_percent(errors.known_error_percent)} differ")
    if not errors.known_in_both:
        say("the maps have no known cell in common; leave --no-align out, or check that they show one place")
    walls, within = scores.occupied, f"{scores.tolerance_cells} cell" + ("" if scores.tolerance_cells == 1 else "s")
    say(f"walls: IoU {_number(walls.iou)}, within {within} {_number(walls.iou_tolerant)} (precision "
        f"{_number(walls.tolerance_precision)}, recall {_number(walls.tolerance_recall)})")  # fmt: skip
    for figures, what in ((scores.to_reference, "map to reference"), (scores.from_reference, "reference to map")):
        if figures.mean is not None:
            say(f"walls, {what}: mean {figures.mean:.3f}, median {figures.median:.3f}, 95 % {figures.p95:.3f} m")
    say(f"free cells: IoU {_number(scores.free_iou)}; the map knows {_number(scores.coverage)} of the reference")
    if walls.iou_tolerant is not None and walls.iou_tolerant < ALIKE:
        say("note: their walls hardly match; do they show the same place? --report DIR shows both")


def _percent(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f} %"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"
