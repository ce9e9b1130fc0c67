# SPDX-License-Identifier: Apache-2.0
"""Pictures of trajectories: from above, height, errors along the path and by length, and gaps without a pose."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.trajectory import MAX_GAP_INTERVALS
from stereovox.evaluate.trajectory_score import MIN_EXTENT_M, SegmentErrors, TrajectoryScore, travelled_m
from stereovox.view.evaluation import PRECISION, RECALL, WIDTH, caption
from stereovox.view.figures import GREY, INK, blank, labels, png_of, save, title

DPI = 140
TRUTH, ESTIMATE, LOST = INK, RECALL, "#c2185b"
AXES = "xyz"
HEIGHT_IN, ERROR_IN, SEGMENTS_IN = 2.6, 2.6, 3.0
"""Heights of the charts in inches."""
FEW = 4
"""Fewest bars that a chart has room for."""
NO_POSE = "no pose"

Spans = list[tuple[int, int]]
"""Indices of the poses before and after each span without a pose."""


def trajectory_picture(score: TrajectoryScore, file: str | Path) -> None:
    """Draw an estimated trajectory next to the true one, and its errors.

    From above, along the axis of the truth's frame along which it spreads least; height; position and rotation errors
    along the path; errors of motions by length (KITTI's rule). If the estimate has no pose for longer than three of
    its usual intervals the truth is drawn in red.

    Args:
        score: From `score_trajectory`.
        file: The picture to write: .png, .pdf or .svg.

    Raises:
        StereovoxError: Another suffix, or a file that cannot be written.
    """
    save(score_figure(score), file, DPI)


def trajectory_png(score: TrajectoryScore) -> bytes:
    """Return the picture of `trajectory_picture` as a PNG."""
    return png_of(score_figure(score), DPI)


def score_figure(score: TrajectoryScore) -> Any:
    """Return the figure of `trajectory_picture`."""
    pairs, found = score.pairs, score.aligned_positions()
    true, all_true = pairs.T_truth_body[:, :3, 3], pairs.truth_positions
    flat, up = _axes(true)
    rows = [("above", _tall(np.concatenate([true, found])[:, flat])), ("height", HEIGHT_IN), ("errors", ERROR_IN)]
    figure, charts = _charts(rows, by_length=bool(score.segments))
    lost = _gaps(score)
    _from_above(charts["above"], flat)
    charts["above"].plot(*all_true[:, flat].T, color=TRUTH, linewidth=1.6, label="truth")
    _in_pieces(charts["above"], found[:, flat], lost, color=ESTIMATE, linewidth=1.6, label="estimate")
    _missed(charts["above"], all_true[:, flat], _runs(pairs.truth_missed))
    _ends(charts["above"], all_true[:, flat])
    at, unit = _along(score)
    charts["height"].plot(at, true[:, up], color=TRUTH)
    _in_pieces(charts["height"], np.column_stack([at, found[:, up]]), lost, color=ESTIMATE)
    caption(charts["height"], f"{AXES[up]} along the path", "Along the axis on which the truth spreads least.")
    labels(charts["height"], unit, f"{AXES[up]} [m]")
    _errors(charts["errors"], at, score, lost)
    labels(charts["errors"], unit, "position error [m]")
    for name in ("height", "errors"):
        _shade(charts[name], at, lost)
    if score.segments:
        _by_length(charts, score.segments)
    return figure


def way_figure(positions: NDArray[np.float64], tracked: NDArray[np.bool_], heading: str) -> Any:
    """Return a figure of a trajectory without the true one: from above, and its height.

    Args:
        positions: (N, 3) metres, z up.
        tracked: (N,) which of them are known, at least one.
        heading: Title at the top.
    """
    known = positions[tracked]
    spans = _between_known(tracked)
    figure, charts = _charts([("above", _tall(known[:, :2])), ("height", HEIGHT_IN)], by_length=False)
    _from_above(charts["above"], [0, 1])
    title(charts["above"], heading)
    _in_pieces(charts["above"], known[:, :2], spans, color=ESTIMATE, linewidth=1.6, label="tracked")
    for number, (before, after) in enumerate(spans):
        name = f"{NO_POSE} (straight)" if number == 0 else None
        charts["above"].plot(*known[[before, after], :2].T, ":", color=LOST, linewidth=2.0, label=name)
    _ends(charts["above"], known[:, :2])
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(known, axis=0), axis=1))])
    _in_pieces(charts["height"], np.column_stack([at, known[:, 2]]), spans, color=ESTIMATE)
    _shade(charts["height"], at, spans)
    ends = (
        "" if tracked[-1] else f" The last {len(tracked) - 1 - int(np.flatnonzero(tracked)[-1])} frames have no pose."
    )
    caption(charts["height"], "Height along the path", (f"Red: {NO_POSE}." if spans else "") + ends)
    labels(charts["height"], "metres travelled", "z [m]")
    return figure


def _charts(rows: Sequence[tuple[str, float]], by_length: bool) -> tuple[Any, dict[str, Any]]:
    """Return a figure, and its charts by name: full-width rows, and two for errors by length."""
    mosaic = [[name, name] for name, _ in rows] + [["shift", "turn"]] * by_length
    heights = [height for _, height in rows] + [SEGMENTS_IN] * by_length
    figure = blank(WIDTH, sum(heights) + 0.75 * len(heights))
    return figure, figure.subplot_mosaic(mosaic, height_ratios=heights)


def _axes(true: NDArray[np.float64]) -> tuple[list[int], int]:
    """Return the two axes of the ground, and the one along which a trajectory spreads least."""
    up = int(np.argmin(np.ptp(true, axis=0)))
    return [axis for axis in range(3) if axis != up], up


def _tall(ground: NDArray[np.float64]) -> float:
    """Return the height in inches of a map of positions (N, 2)."""
    width, depth = np.ptp(ground, axis=0)
    return float(np.clip(0.93 * WIDTH * depth / max(width, 1e-9), 2.5, 9.0))


def _gaps(score: TrajectoryScore) -> Spans:
    """Return the spans between pairs in which the estimate has no pose."""
    missed = np.concatenate([[0], np.cumsum(score.pairs.truth_missed)])
    ends = score.pairs.truth_index
    return [(k, k + 1) for k, (a, b) in enumerate(pairwise(ends.tolist())) if missed[b] > missed[a + 1]]


def _between_known(tracked: NDArray[np.bool_]) -> Spans:
    """Return the spans with unknown poses, as indices among the known ones."""
    return [(k, k + 1) for k, (a, b) in enumerate(pairwise(np.flatnonzero(tracked).tolist())) if b > a + 1]


def _runs(flags: NDArray[np.bool_]) -> Iterator[slice]:
    """Yield the runs of true flags, each with its neighbours."""
    first = 0
    for flag, run in groupby(flags.tolist()):
        last = first + len(list(run))
        if flag:
            yield slice(max(first - 1, 0), last + 1)
        first = last


def _along(score: TrajectoryScore) -> tuple[NDArray[np.float64], str]:
    """Return each pair's position along a chart, and that axis's label."""
    if score.length_m > MIN_EXTENT_M:
        return travelled_m(score.pairs.T_truth_body), "metres travelled"
    return np.arange(len(score.pairs), dtype=float), "pose"


def _from_above(axis: Any, flat: Sequence[int]) -> None:
    axis.set_aspect("equal", adjustable="datalim")
    axis.grid(alpha=0.3)
    title(axis, "From above")
    labels(axis, f"{AXES[flat[0]]} [m]", f"{AXES[flat[1]]} [m]")


def _in_pieces(axis: Any, points: NDArray[np.float64], lost: Spans, label: str = "", **style: Any) -> None:
    """Draw a line through points (N, 2) that is interrupted at gaps."""
    broken = np.insert(points, [after for _, after in lost], np.nan, axis=0)
    axis.plot(*broken.T, label=label or None, **style)


def _missed(axis: Any, true: NDArray[np.float64], runs: Iterator[slice]) -> None:
    for number, run in enumerate(runs):
        axis.plot(*true[run].T, color=LOST, linewidth=3.5, label=None if number else f"{NO_POSE}, truth")


def _ends(axis: Any, points: NDArray[np.float64]) -> None:
    axis.plot(*points[0], "o", color=TRUTH, label="start")
    axis.plot(*points[-1], "s", color=TRUTH, label="end")
    axis.legend(frameon=False)


def _shade(axis: Any, at: NDArray[np.float64], lost: Spans) -> None:
    """Mark the spans without a pose along a chart."""
    for before, after in lost:
        axis.axvspan(at[before], at[after], color=LOST, alpha=0.18, linewidth=0.5)


def _errors(axis: Any, at: NDArray[np.float64], score: TrajectoryScore, lost: Spans) -> None:
    turns = axis.twinx()
    for one, errors, colour in (
        (axis, score.position_errors_m, PRECISION),
        (turns, score.rotation_errors_deg, RECALL),
    ):
        _in_pieces(one, np.column_stack([at, errors]), lost, color=colour, linewidth=1.5)
        one.set_ylim(0, 1.06 * max(float(errors.max()), 1e-9))
    axis.axhline(score.position_m.rmse, color=GREY, linewidth=1, linestyle="--")
    labels(turns, "", "rotation error [deg]")
    text = f"Blue: position, dashed its rmse (ATE, {score.position_m.rmse:.3g} m). Orange: rotation."
    text += f" Red: {NO_POSE} for longer than {MAX_GAP_INTERVALS:g} of the usual intervals." if lost else ""
    caption(axis, f"Errors along the path, {'aligned' if score.aligned else 'as they stand'}", text)


def _by_length(charts: dict[str, Any], segments: Sequence[SegmentErrors]) -> None:
    """Draw the mean errors of motions by the length of the segments."""
    at = np.arange(len(segments))
    names = [f"{one.length_m:g} m\n{one.segments:,} x" for one in segments]
    for chart, name, colour, unit, what in (
        ("shift", "translation_percent", PRECISION, "% of the length", "Position errors by length"),
        ("turn", "rotation_deg_per_m", RECALL, "deg / m", "Rotation errors by length"),
    ):
        axis = charts[chart]
        bars = axis.bar(at, [getattr(one, name) for one in segments], 0.6, color=colour)
        axis.bar_label(bars, fmt="{:.2g}", color=GREY, fontsize=9)
        axis.margins(y=0.15)
        axis.set_xticks(at, names)
        axis.set_xlim(-0.6, max(len(segments), FEW) - 0.4)
        caption(axis, what, "Mean over all segments of a length (KITTI's rule); below it their number.")
        labels(axis, "", unit)
