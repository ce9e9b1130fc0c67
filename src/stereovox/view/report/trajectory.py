# SPDX-License-Identifier: Apache-2.0
"""Report of a trajectory against the true one: errors of poses and of motions, with a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stereovox.evaluate.trajectory_score import ErrorFigures, TrajectoryScore
from stereovox.view.report import page
from stereovox.view.trajectory import trajectory_png

OFFSET_DEG = 5.0
"""A common rotation error of all poses is noted above this."""
OTHER_AXES = "the two do not follow the same axes of the body (then the errors of motions are wrong, too)"
STRAIGHT = "the trajectory is too straight for positions to align the roll about it"
NOT_ALIGNED = "they are not in one frame (then leave --no-align out)"
FIGURES = ("rmse", "mean", "median", "max")
ERROR_HEADS = ("error", "pairs", *FIGURES, "unit")
SEGMENT_HEADS = ("segments of", "number", "translation", "rotation")
ERRORS = (
    "Positions and rotations (absolute trajectory error, ATE) are those of the poses themselves. Motions (relative "
    "pose error, RPE) are compared from one pose to the next, and to the one a second later; a trajectory's "
    "place in its world does not matter for them."
)
SEGMENTS = (
    "KITTI's rule: from every tenth pose to the first one that lies further along the true trajectory than the "
    "segment is long; the error of that motion is divided by the length."
)


def write_trajectory_report(
    folder: str | Path, score: TrajectoryScore, name: str = "The estimate", truth: str = "the truth"
) -> Path:
    """Write `evaluation.html` and `trajectory.png` into `folder`; return the page's path.

    name, truth: names of the trajectories. Raises StereovoxError if they cannot be written.
    """
    png = trajectory_png(score)
    text = page.page(
        "How good is the trajectory?",
        f"{name} compared with {truth}: {paired(score)}. {aligned(score)}",
        page.tiles(_boxes(score)),
        page.section("Both trajectories", "", page.figure(png, "Trajectories from above, heights and errors")),
        page.section("Errors", " ".join([ERRORS, *notes(score)]), page.table(ERROR_HEADS, error_rows(score))),
        page.section("By distance", SEGMENTS, page.table(SEGMENT_HEADS, segment_rows(score))) if score.segments else "",
    )
    return page.write_files(folder, {"evaluation.html": text.encode(), "trajectory.png": png})


def paired(score: TrajectoryScore) -> str:
    """Return the number of paired poses and their coverage, in words."""
    pairs = score.pairs
    lasting = "" if score.duration_s is None else f" in {score.duration_s:.2f} s"
    return (
        f"{len(pairs):,} of {pairs.estimate_poses:,} poses have one of the truth's {pairs.truth_poses:,}, along "
        f"{score.length_m:.2f} m{lasting}; they cover {pairs.coverage:.1%} of the truth"
    )


def aligned(score: TrajectoryScore) -> str:
    """Return the alignment of the estimate, in words."""
    if not score.aligned:
        return "Compared as they stand, in one frame."
    return "Aligned rigidly first." if score.scale == 1 else f"Aligned first, with the scale {score.scale:.6g}."


def notes(score: TrajectoryScore) -> list[str]:
    """Return notes for readers of the figures."""
    found = []
    if score.rotation_offset_deg > OFFSET_DEG:
        why = STRAIGHT if score.aligned else NOT_ALIGNED
        found.append(f"note: {score.rotation_offset_deg:.1f} degrees of the rotation errors are the same everywhere: "
                     f"either {OTHER_AXES}, or {why}")  # fmt: skip
    return found


def error_rows(score: TrajectoryScore) -> list[Sequence[str]]:
    """Return the rows below ERROR_HEADS."""
    number = f"{len(score.pairs):,}"
    rows = [_row("position (ATE)", number, score.position_m, "m"), _row("rotation", number, score.rotation_deg, "deg")]
    for what, steps in (("per frame", score.per_frame), ("per second", score.per_second)):
        if steps is not None:
            rows.append(_row(f"motion {what} (RPE)", f"{steps.pairs:,}", steps.translation_m, "m"))
            rows.append(_row(f"turn {what}", f"{steps.pairs:,}", steps.rotation_deg, "deg"))
    return rows


def segment_rows(score: TrajectoryScore) -> list[Sequence[str]]:
    """Return the rows below SEGMENT_HEADS, the last of them the means over all segments."""
    rows = [
        (f"{one.length_m:g} m", f"{one.segments:,}", *_shares(one.translation_percent, one.rotation_deg_per_m))
        for one in score.segments
    ]
    total = f"{sum(one.segments for one in score.segments):,}"
    return [*rows, ("all", total, *_shares(score.translation_percent, score.rotation_deg_per_m))]


def _boxes(score: TrajectoryScore) -> list[tuple[str, str]]:
    boxes = [
        (f"{score.position_m.rmse:.3f} m", "position error (ATE), rmse"),
        (f"{score.rotation_deg.rmse:.2f} deg", "rotation error, rmse"),
        (f"{score.pairs.coverage:.0%}", "of the truth covered"),
    ]
    for value, label in ((score.translation_percent, "translation error by distance (KITTI)"),
                         (score.drift_percent, "drift of the end, of the length")):  # fmt: skip
        boxes.append(("-" if value is None else f"{value:.2f} %", label))
    return boxes


def _row(what: str, number: str, figures: ErrorFigures, unit: str) -> Sequence[str]:
    return (what, number, *(f"{getattr(figures, name):.4f}" for name in FIGURES), unit)


def _shares(translation_percent: float | None, rotation_deg_per_m: float | None) -> tuple[str, str]:
    if translation_percent is None or rotation_deg_per_m is None:
        return "-", "-"
    return f"{translation_percent:.3f} %", f"{rotation_deg_per_m:.5f} deg/m"
