# SPDX-License-Identifier: Apache-2.0
"""Charts that hold several maps of one drive side by side: precision against recall, and reliability."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from stereovox.evaluate.reproduce.valenti.claims import TARGET_RANGE, TARGETS
from stereovox.evaluate.reproduce.valenti.figures import AT_LEAST, STRICT, TOLERANT, at
from stereovox.evaluate.reproduce.valenti.judge import Judged
from stereovox.evaluate.reproduce.valenti.mappers import DEFAULT, OCTOMAP, THESIS
from stereovox.view.charts import labels
from stereovox.view.panels import GREY
from stereovox.view.reproduce.shared import OURS, SECOND, figure_of, png

COLOURS = {THESIS: "#8a8f99", DEFAULT: OURS, OCTOMAP: SECOND}
TARGET = "#5b8c5a"


def tolerances_png(judged: Sequence[Judged]) -> bytes:
    """Return precision against recall within one cell: a row a range, a column a cell size, a line a map."""
    return _charts(judged, _tolerance, ("recall within one cell", "precision within one cell"))


def reliabilities_png(judged: Sequence[Judged]) -> bytes:
    """Return the share of truly occupied cells against the probability, laid out as `tolerances_png`."""
    return _charts(judged, _reliability, ("probability the map gives", "share truly occupied"))


def _charts(judged: Sequence[Judged], draw: Callable[[Any, Judged], None], names: tuple[str, str]) -> bytes:
    sizes = sorted({one.setting.voxel_size for one in judged}, reverse=True)
    ranges = sorted({one.setting.max_range for one in judged})
    figure = figure_of(4.2 * len(ranges) + 0.4)
    axes = figure.subplots(len(ranges), len(sizes), squeeze=False)
    for one in judged:
        axis = axes[ranges.index(one.setting.max_range), sizes.index(one.setting.voxel_size)]
        draw(axis, one)
        axis.set_title(str(one.setting), fontsize=11, color=GREY)
    for axis in axes.ravel():
        labels(axis, *names)
    handles, texts = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=len(texts) or 1, frameon=False)
    return png(figure)


def _tolerance(axis: Any, one: Judged) -> None:
    curve, colour = one.scores["view"].curve, COLOURS[one.mapper]
    axis.plot(curve.tolerance_recall, curve.tolerance_precision, color=colour, label=one.mapper)
    for threshold, face in ((STRICT, colour), (AT_LEAST, "white")):
        point = at(curve, threshold)
        precision, recall = (np.nan if point[name] is None else point[name] for name in TOLERANT)
        axis.plot(recall, precision, "o", color=colour, markerfacecolor=face)
    target = TARGETS.get(one.setting.voxel_size) if one.setting.max_range == TARGET_RANGE else None
    if target is not None and one.mapper == DEFAULT:
        corner = ([target.recall, 1], [target.precision] * 2)
        axis.fill_between(*corner, 1, color=TARGET, alpha=0.35, linewidth=0)
    axis.set(xlim=(0.4, 1.01), ylim=(0.4, 1.01))


def _reliability(axis: Any, one: Judged) -> None:
    found = one.scores["view"].reliability
    axis.plot([0, 1], [0, 1], "--", color=GREY, linewidth=1)
    axis.plot(found.mean_p, found.occupied_share, "o-", markersize=4, color=COLOURS[one.mapper], label=one.mapper)
    axis.set(xlim=(0, 1), ylim=(0, 1.02))
