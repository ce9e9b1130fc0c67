# SPDX-License-Identifier: Apache-2.0
"""Charts of an evaluation: by frame (Valenti 2018, Fig 8.4), threshold and distance; ROC, reliability.

Right and wrong cells of a map, seen from above. Picture of missions: the share of the air known to be free, over time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.curves import ByDistance, PrecisionRecall, Reliability, Roc
from stereovox.evaluate.decisions import Outcome, Outcomes
from stereovox.evaluate.scores import Scores
from stereovox.view.drawn import UPS, checked_up
from stereovox.view.figures import DPI, GREY, INK, blank, labels, measured, png_of, title

CHART_DPI = 140
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
    return png_of(figure, CHART_DPI)


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
    return png_of(figure, CHART_DPI)


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


RIGHT, WRONG, MISS, NEVER = "#2f7fb8", "#e59a1f", "#b3205f", "#b9bec7"
EXACT_COLOURS = {
    "right": (RIGHT, [Outcome.HIT]),
    "only in the map": (WRONG, [Outcome.NEAR, Outcome.FALSE]),
    "missed": (MISS, [Outcome.FOUND, Outcome.MISSED]),
    "never observed": (NEVER, [Outcome.UNSEEN]),
}
TOLERANT_COLOURS = {
    "right": (RIGHT, [Outcome.HIT, Outcome.NEAR, Outcome.FOUND]),
    "only in the map": (WRONG, [Outcome.FALSE]),
    "missed": (MISS, [Outcome.MISSED]),
    "never observed": (NEVER, [Outcome.UNSEEN]),
}


def outcomes_png(shown: Outcomes, up: str | None = None) -> bytes:
    """Return a PNG of two top views: exact, and with the tolerance.

    A column has the mean colour of its cells. up: the axis that points up, by default from the truth's settings. Raises
    StereovoxError for an invalid `up`.
    """
    up = checked_up(up or shown.up)
    across, away, _ = UPS[up]
    places = shown.cells[:, [across, away]]
    low = places.min(axis=0) if len(places) else np.zeros(2, int)
    size = (places.max(axis=0) - low + 1) if len(places) else np.ones(2, int)
    tall = size[1] > 0.6 * size[0]
    height = 0.8 + float(np.clip((0.46 if tall else 0.92) * WIDTH * size[1] / size[0], 2.0, 9.0))
    figure = blank(WIDTH, height if tall else 2 * height)
    panels = figure.subplots(*((1, 2) if tall else (2, 1)), squeeze=False).ravel()
    extent = np.stack([low, low + size], axis=1).ravel() * shown.voxel_size
    names = ("xyz"[across], "xyz"[away], up)
    for axis, classes, text in ((panels[0], EXACT_COLOURS, "Exact"), (panels[1], TOLERANT_COLOURS, "With tolerance")):
        image = mixed(places - low, shown.outcome, tuple(size), classes)
        axis.imshow(image, origin="lower", extent=extent, interpolation="nearest")
        title(axis, text)
        measured(axis, names)
    _legend(figure)
    return png_of(figure, CHART_DPI)


def mixed(
    places: NDArray[np.integer],
    outcome: NDArray[np.uint8],
    size: tuple[int, ...],
    classes: Mapping[str, tuple[str, list[Outcome]]],
) -> NDArray[np.float64]:
    """Return an image (rows, columns, 3): each pixel has the mean colour of its cells, white if there are none.

    places: (M, 2) column and row of each cell; cells without a class are not drawn.
    """
    from matplotlib.colors import to_rgb

    columns, rows = size
    number, colour = np.zeros(rows * columns), np.zeros((rows * columns, 3))
    for name, members in classes.values():
        x, y = places[np.isin(outcome, members)].T
        count = np.bincount(y * columns + x, minlength=rows * columns)
        number += count
        colour += count[:, None] * np.array(to_rgb(name))
    image = np.where(number[:, None] > 0, colour / np.maximum(number, 1)[:, None], 1.0)
    return image.reshape(rows, columns, 3)


def _legend(figure: Any) -> None:
    from matplotlib.patches import Patch

    patches = [Patch(fc=colour, ec="#888", label=name) for name, (colour, _) in EXACT_COLOURS.items()]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=10.5)


def coverage_figure(flights: Sequence[dict[str, Any]]) -> Any:
    """Return a figure with a panel for each scene: a grey line for each flight, the median of all in black.

    flights: with `scene`, `seconds` and `coverage` [[seconds, share], ...]. A flight that ended keeps its last share;
    a red cross marks a collision.
    """
    scenes = list(dict.fromkeys(flight["scene"] for flight in flights))
    longest = max(flight["coverage"][-1][0] for flight in flights)
    figure = blank(1.2 + 3.6 * len(scenes), 3.4)
    for axis, scene in zip(np.ravel(figure.subplots(1, len(scenes), sharey=True, squeeze=False)), scenes, strict=True):
        mine = [flight for flight in flights if flight["scene"] == scene]
        times = np.linspace(0, longest, 200)
        curves = [np.interp(times, *np.transpose(flight["coverage"])) for flight in mine]
        for flight in mine:
            axis.plot(*np.transpose(flight["coverage"]), color=GREY, linewidth=0.6, alpha=0.6)
            if flight["collided_s"] is not None:
                axis.plot(*flight["coverage"][-1], "x", color="tab:red")
        axis.plot(times, np.median(curves, axis=0), color=INK, linewidth=1.8)
        axis.set_title(f"{scene}, {len(mine)} flights", loc="left", fontsize=9)
        axis.set(ylim=(0, 1), xlim=(0, longest or 1))
        labels(axis, "seconds", "air known to be free" if scene == scenes[0] else "")
    return figure


def coverage_png(flights: Sequence[dict[str, Any]]) -> bytes:
    """Return `coverage_figure` as PNG bytes."""
    return png_of(coverage_figure(flights), DPI)
