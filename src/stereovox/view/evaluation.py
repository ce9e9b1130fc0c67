# SPDX-License-Identifier: Apache-2.0
"""Charts of an evaluation: by frame (Valenti 2018, Fig 8.4), threshold and distance; ROC, reliability."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.curves import PrecisionRecall, Roc
from stereovox.evaluate.distance import ByDistance
from stereovox.evaluate.reliability import Reliability
from stereovox.evaluate.scores import Scores
from stereovox.view.figures import blank, labels, png_of
from stereovox.view.panels import GREY, INK

DPI = 140
WIDTH = 12.0
"""Inches."""
LINE_LETTERS = 74
"""Number of letters that fit above a chart of half the width."""
PRECISION, RECALL, THIRD = "#23618c", "#d1603d", "#5b8c5a"
EXACT, TOLERANT = ":", "-"
CLASSES = (
    ("accuracy", "accuracy", "#8a8f99"),
    ("specificity", "specificity", "#b9a44c"),
    ("npv", "negative predictive value", "#a07cc0"),
    ("precision", "precision", PRECISION),
    ("recall", "recall", RECALL),
)
LIKENESS = (("correlation", "correlation", THIRD), ("error", "error", INK), ("coverage", "observed", "#b9bec7"))


def series_png(arrays: Mapping[str, NDArray[Any]]) -> bytes:
    """Return a PNG of measures by frame, `arrays` as `ScoreSeries.arrays` returns them, at least one frame."""
    figure = blank(WIDTH, 4.4)
    left, right = figure.subplots(1, 2)
    frame = arrays["frame"]
    dot = "o" if len(frame) < 60 else ""
    for axis, lines in ((left, CLASSES), (right, LIKENESS)):
        for name, label, colour in lines:
            axis.plot(frame, arrays[name], f"{dot}-", color=colour, label=label, markersize=3)
    for name, label, colour in (("precision", "precision", PRECISION), ("recall", "recall", RECALL)):
        values = arrays[f"tolerance_{name}"]
        right.plot(frame, values, "--", color=colour, label=f"{label}, with tolerance")
    for axis in (left, right):
        axis.set_ylim(-0.02, 1.02)
        legend_below(axis, 3)
        labels(axis, "frame", "")
    caption(left, "Right or wrong, all cells", "A cell counts as free until the map calls it occupied.")
    caption(right, "Likeness, and with tolerance", "Error should fall or stay level, all others should rise.")
    return png_of(figure, DPI)


def curves_png(scores: Scores) -> bytes:
    """Return a PNG: precision and recall by threshold and by distance, reliability with counts, and ROC."""
    figure = blank(WIDTH, 8.8)
    upper, lower = figure.subplots(2, 2)
    _thresholds(upper[0], scores.curve, scores.threshold, scores.tolerance_cells)
    _reliability(upper[1], scores.reliability, scores.ece)
    _roc(lower[0], scores.roc)
    if scores.distance is None:
        _both(lower[1], scores.curve, scores.threshold)
    else:
        _distance(lower[1], scores.distance)
    return png_of(figure, DPI)


def _thresholds(axis: Any, curve: PrecisionRecall, threshold: float, tolerance: int) -> None:
    within = "1 cell" if tolerance == 1 else f"{tolerance} cells"
    for name, colour in (("precision", PRECISION), ("recall", RECALL)):
        axis.plot(curve.threshold, getattr(curve, name), EXACT, color=colour, label=f"{name}, exact")
        tolerant = getattr(curve, f"tolerance_{name}")
        axis.plot(curve.threshold, tolerant, TOLERANT, color=colour, label=f"{name}, within {within}")
    axis.axvline(threshold, color=GREY, linewidth=1, linestyle="--")
    axis.set(xlim=(0, 1), ylim=(0, 1.02))
    legend_below(axis, 2)
    caption(
        axis, "Precision and recall against the threshold", "A more careful map is more often right and misses more."
    )
    labels(axis, f"threshold (dashed: {threshold:g})", "")


def _both(axis: Any, curve: PrecisionRecall, threshold: float) -> None:
    here = int(np.argmin(np.abs(curve.threshold - threshold)))
    for prefix, style, label in (("", EXACT, "exact"), ("tolerance_", TOLERANT, "with tolerance")):
        recall, precision = getattr(curve, f"{prefix}recall"), getattr(curve, f"{prefix}precision")
        axis.plot(recall, precision, style, color=PRECISION, label=label)
        axis.plot(recall[here], precision[here], "o", color=PRECISION)
    axis.set(xlim=(0, 1.02), ylim=(0, 1.02))
    legend_below(axis, 2)
    caption(
        axis, "Precision against recall", "What more recall costs in precision: the further up and right, the better."
    )
    labels(axis, f"recall (dot: threshold {curve.threshold[here]:g})", "precision")


def _reliability(axis: Any, found: Reliability, ece: float | None) -> None:
    width = found.edges[1] - found.edges[0]
    middle = found.edges[:-1] + width / 2
    counts = axis.twinx()
    counts.bar(middle, found.count, 0.9 * width, color="#dfe5ec", zorder=0)
    if found.count.any():
        counts.set_yscale("log")
        counts.set_ylim(0.5, 30 * found.count.max())
    labels(counts, "", "cells in the bin (bars)")
    axis.set_zorder(counts.get_zorder() + 1)
    axis.patch.set_visible(False)
    axis.plot([0, 1], [0, 1], "--", color=GREY, linewidth=1, label="perfect")
    axis.plot(found.mean_p, found.occupied_share, "o-", color=PRECISION, label="the map")
    axis.set(xlim=(0, 1), ylim=(0, 1.02))
    legend_below(axis, 2)
    text = "Of all cells with p = 0.8, 80 % should be occupied; below the dashed line the map claims too much."
    caption(axis, "Reliability" + ("" if ece is None else f", ECE {ece:.3f}"), text)
    labels(axis, "probability the map gives", "share that is truly occupied")


def _roc(axis: Any, curve: Roc | None) -> None:
    axis.plot([0, 1], [0, 1], "--", color=GREY, linewidth=1, label="guessing")
    if curve is not None:
        axis.plot(curve.false_positive_rate, curve.true_positive_rate, color=PRECISION, label="the map")
    axis.set(xlim=(-0.01, 1), ylim=(0, 1.02))
    legend_below(axis, 2)
    text = "What each threshold wins and what it costs: the nearer to the upper left corner, the better."
    caption(axis, "ROC" + ("" if curve is None else f", area {curve.auc:.3f}"), text)
    labels(axis, "free cells called occupied", "occupied cells called occupied")


def _distance(axis: Any, found: ByDistance) -> None:
    middle = (found.edges[:-1] + found.edges[1:]) / 2
    counts = axis.twinx()
    counts.bar(middle, found.surface, 0.9 * np.diff(found.edges), color="#dfe5ec", zorder=0)
    counts.set_ylim(0, 2.5 * max(1, int(found.surface.max())))
    labels(counts, "", "surface cells of the truth (bars)")
    axis.set_zorder(counts.get_zorder() + 1)
    axis.patch.set_visible(False)
    for name, colour in (("precision", PRECISION), ("recall", RECALL)):
        axis.plot(middle, getattr(found, name), "o" + EXACT, color=colour, label=f"{name}, exact")
        axis.plot(
            middle, getattr(found, f"tolerance_{name}"), "o" + TOLERANT, color=colour, label=f"{name}, with tolerance"
        )
    axis.set(xlim=found.edges[[0, -1]], ylim=(0, 1.02))
    legend_below(axis, 2)
    text = "Stereo knows less about what is far away; bars show how much of the truth is there."
    caption(axis, "Precision and recall by distance", text)
    labels(axis, "distance to the nearest camera position [m]", "")


def caption(axis: Any, heading: str, text: str) -> None:
    """Write a chart's title, and below it one sentence on how to read it."""
    lines = fill(text, LINE_LETTERS)
    axis.set_title(heading, loc="left", fontsize=12.5, color=INK, pad=10 + 12 * (1 + lines.count("\n")))
    place: dict[str, Any] = {"xycoords": "axes fraction", "textcoords": "offset points"}
    axis.annotate(lines, (0, 1), (0, 6), **place, color=GREY, fontsize=9.5).set_in_layout(False)


def legend_below(axis: Any, columns: int) -> None:
    """Put the legend below a chart."""
    axis.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=columns, frameon=False, fontsize=9.5, columnspacing=1.4
    )
