# SPDX-License-Identifier: Apache-2.0
"""Picture of an estimated trajectory beside the true one: from above, height and errors over time."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.trajectory_score import TrajectoryScore
from stereovox.view.evaluation import PRECISION, RECALL, WIDTH, caption
from stereovox.view.figures import blank, labels, png_of
from stereovox.view.panels import GREY, INK, title

DPI = 140
TRUTH, ESTIMATE = INK, RECALL
AXES = "xyz"


def trajectory_png(score: TrajectoryScore) -> bytes:
    """Return a PNG of both trajectories from above, their heights, and the position and rotation errors over time.

    "Above" looks along the axis of the truth's frame along which the truth spreads least.
    """
    true, found = score.pairs.T_truth_body[:, :3, 3], score.aligned_positions()
    up = int(np.argmin(np.ptp(true, axis=0)))
    flat = [axis for axis in range(3) if axis != up]
    width, depth = np.ptp(np.concatenate([true, found])[:, flat], axis=0)
    tall = float(np.clip(0.93 * WIDTH * depth / max(width, 1e-9), 2.5, 9.0))
    figure = blank(WIDTH, tall + 7.4)
    above, height, error = figure.subplots(3, 1, height_ratios=[tall, 2.6, 2.6])
    _from_above(above, true[:, flat], found[:, flat], (AXES[flat[0]], AXES[flat[1]]))
    at, unit = _times(score)
    for positions, colour, name in ((true, TRUTH, "truth"), (found, ESTIMATE, "estimate")):
        height.plot(at, positions[:, up], color=colour, label=name)
    caption(height, f"{AXES[up]} over time", "Along the axis on which the truth spreads least.")
    labels(height, unit, f"{AXES[up]} [m]")
    _errors(error, at, score)
    labels(error, unit, "position error [m]")
    return png_of(figure, DPI)


def _times(score: TrajectoryScore) -> tuple[NDArray[np.float64], str]:
    """Return where each pair is drawn along a chart, and the label of that axis."""
    stamps_ns = score.pairs.stamps_ns
    if stamps_ns is None:
        return np.arange(len(score.pairs), dtype=float), "pose"
    return (stamps_ns - stamps_ns[0]) / 1e9, "seconds since the first pose"


def _from_above(axis: Any, true: NDArray[np.float64], found: NDArray[np.float64], names: tuple[str, str]) -> None:
    for points, colour, name in ((true, TRUTH, "truth"), (found, ESTIMATE, "estimate")):
        axis.plot(*points.T, color=colour, linewidth=1.6, label=name)
    axis.plot(*true[0], "o", color=TRUTH, label="start")
    axis.set_aspect("equal", adjustable="datalim")
    axis.grid(alpha=0.3)
    title(axis, "From above")
    axis.legend(frameon=False)
    labels(axis, f"{names[0]} [m]", f"{names[1]} [m]")


def _errors(axis: Any, at: NDArray[np.float64], score: TrajectoryScore) -> None:
    axis.plot(at, score.position_errors_m, color=PRECISION)
    axis.axhline(score.position_m.rmse, color=GREY, linewidth=1, linestyle="--")
    turns = axis.twinx()
    turns.plot(at, score.rotation_errors_deg, color=RECALL, linewidth=1)
    for one, errors in ((axis, score.position_errors_m), (turns, score.rotation_errors_deg)):
        one.set_ylim(0, 1.06 * max(float(errors.max()), 1e-9))
    labels(turns, "", "rotation error [deg]")
    caption(axis, "Errors over time", "Blue: position, dashed its rmse (ATE). Orange: rotation.")
