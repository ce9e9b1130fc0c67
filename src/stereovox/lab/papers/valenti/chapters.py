# SPDX-License-Identifier: Apache-2.0
"""Chapters of the evaluation: Table 8.1 beside ours, one chapter per drive, and the times."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from stereovox.evaluate.curves import TOLERANT
from stereovox.lab.papers.chapter import NO, YES, Chapter, Claim, Sheet, Shown
from stereovox.lab.papers.pictures import OURS, SECOND, figure_of, png
from stereovox.lab.papers.valenti.claims import CLAIMED, KINDS, TARGET_RANGE, TARGETS, claims_of, results, speed_claim
from stereovox.lab.papers.valenti.figures import AT_LEAST, STRICT, at, figures
from stereovox.lab.papers.valenti.judge import Judged
from stereovox.lab.papers.valenti.mappers import DEFAULT, OCTOMAP, THESIS, Setting
from stereovox.lab.papers.valenti.speed import Speed
from stereovox.view.evaluation import curves_png, series_png
from stereovox.view.figures import labels
from stereovox.view.outcomes import outcomes_png
from stereovox.view.panels import GREY

VERDICTS = {True: YES, False: NO, None: "-"}
COLOURS = {THESIS: "#8a8f99", DEFAULT: OURS, OCTOMAP: SECOND}
TARGET = "#5b8c5a"
TABLE = ("tp", "fp", "tn", "fn", "accuracy", "precision", "recall", "specificity", "npv", "error", "correlation")
TRUTH = (
    "Truth: a cell is occupied where one lidar point of any frame falls into it that is in the left image and on "
    "nothing annotated as an object. Cells count that some frame has in view and in range. Free are all others; "
    "beside it stands a second, kinder truth, whose free cells are only those that a lidar ray crossed. The first "
    "blames a map for every surface that the sparse lidar missed, the second asks only where the lidar knows."
)
OTHER_DATA = (
    "The thesis's rows are its own printed figures, of other drives than ours unless sequences 0000 to 0009 of the "
    "tracking data stand below them; the thesis tells neither the cell size nor the range of its table."
)
MEASURES = (
    "Exact and within one cell: a cell called occupied is right where the truth has a surface in it, or within one "
    "cell along each axis; recall likewise. The thesis's rule is p > 0.7; one hit leaves a cell of OctoMap at 0.7, so "
    "p >= 0.7 is told as well. Balanced: the threshold at which the lesser of precision and recall within one cell is "
    "largest. Cells never observed count as free; error and calibration are over observed cells, as in the thesis."
)
ALL_CELLS = (
    "The correlation over all cells of the truth has no target: cells that a map never observed stand at p = 0.5, most "
    "of them behind surfaces, so it mostly tells how much of the box was never seen, the more so the surer a map is "
    "of the free air that it did see."
)
RIVAL = (
    "OctoMap (octomap-python, its own settings, one ray for the points of a cell) gets the points of the same "
    "disparities as `default`, and pixels beyond the range clear their rays up to it. Its range is a distance, ours a "
    "depth; points in the image's corners between the two are marked occupied for it all the same."
)
FIG_8_4 = (
    "Recall and correlation rise while the drive goes on and more of the scene is seen; precision and error stay about "
    "level."
)
BETTER = (
    "Claims are made against the first truth, free is all in view. Better in every measure (f): each map is taken at "
    "the threshold that suits it best, and of precision and recall the lesser counts."
)


def points_sheet(judged: Sequence[Judged], kind: str, missing: str) -> Sheet:
    """Return precision and recall at fixed thresholds and the balanced one. missing: why there is no OctoMap."""
    heads = ("cell, range", "mapper", "p > 0.7: precision, recall", "within one cell", "p >= 0.7: precision, recall",
             "within one cell", "balanced at", "precision, recall", "within one cell")  # fmt: skip
    rows = []
    for one in judged:
        told = figures(one.scores[kind])
        fixed = [part for name in ("strict", "at_least") for part in _pairs(told[name])]
        balanced = told["balanced"]
        rows.append((str(one.setting), one.mapper, *fixed, f"p > {balanced['threshold']:.4g}", *_pairs(balanced)))
    if missing:
        rows.append(("all", OCTOMAP, missing, *["-"] * (len(heads) - 3)))
    return Sheet(f"Precision and recall of all maps; {KINDS[kind]}", heads, rows)


def probabilities_sheet(judged: Sequence[Judged]) -> Sheet:
    """Return the measures that ask no threshold, for both kinds of truth."""
    names = ("error", "correlation", "corr., observed", "ECE", "share observed")
    heads = ("cell, range", "mapper", *(f"{kind}: {name}" for kind in KINDS for name in names))
    rows = []
    for one in judged:
        values = [
            text_of(value)
            for kind in KINDS
            for s in [one.scores[kind]]
            for value in (s.error, s.correlation, s.observed.correlation, s.ece, s.coverage)
        ]
        rows.append((str(one.setting), one.mapper, *values))
    return Sheet("Probabilities of all maps; view: free is all in view, rays: what the lidar looked into", heads, rows)


def thresholds_sheet(judged: Sequence[Judged]) -> Sheet:
    """Return precision and recall within one cell at several thresholds."""
    listed = [figures(one.scores[CLAIMED])["listed"] for one in judged]
    heads = ("cell, range", "mapper", *(f"p > {point['threshold']:g}" for point in listed[0]))
    rows = [
        (str(one.setting), one.mapper, *(_pairs(point)[1] for point in points))
        for one, points in zip(judged, listed, strict=True)
    ]
    return Sheet(f"Precision, recall within one cell by threshold; {KINDS[CLAIMED]}", heads, rows)


def targets_sheet(judged: Sequence[Judged]) -> Sheet:
    """Return what each map reaches of the targets, also where nothing is claimed."""
    found = {(one.setting, one.mapper): one for one in judged}
    rows, heads = [], ()
    for (setting, mapper), kind in product(found, KINDS):
        if setting.voxel_size in TARGETS:
            told = results(found, setting, mapper, kind)
            heads = tuple(f"({one.letter}) {one.text}" for one in told)
            signs = (VERDICTS[one.holds] for one in told)
            rows.append((f"{setting}; {KINDS[kind]}", mapper, *map("{} {}".format, (o.ours for o in told), signs)))
    return Sheet(
        "What each map reaches of the targets (to 40 m none are set: those of 20 m)", ("map", "of", *heads), rows
    )


def _pairs(point: Mapping[str, float | None]) -> tuple[str, str]:
    exact = f"{text_of(point['precision'])}, {text_of(point['recall'])}"
    return exact, f"{text_of(point['tolerance_precision'])}, {text_of(point['tolerance_recall'])}"


def row_of(values: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    """Return the values of these names as text."""
    return [text_of(values[name]) for name in names]


def text_of(value: float | None) -> str:
    """Return a number for a table: whole ones with commas, others with three digits."""
    if value is None:
        return "-"
    return f"{value:,}" if isinstance(value, int) else f"{value:.3f}"


@dataclass(frozen=True)
class PrintedRow:
    """A row of Valenti 2018, Table 8.1; a cell is occupied above p = 0.7, an unobserved one counts as free."""

    sequence: str
    tp: int
    fp: int
    tn: int
    fn: int
    accuracy: float
    precision: float
    recall: float
    specificity: float
    npv: float
    error: float
    correlation: float


PRINTED = (
    PrintedRow("0000", 8476, 6341, 508263, 4920, 0.979, 0.572, 0.633, 0.988, 0.990, 0.089, 0.513),
    PrintedRow("0001", 28266, 16866, 4154740, 24128, 0.990, 0.626, 0.539, 0.996, 0.994, 0.081, 0.493),
    PrintedRow("0002", 14267, 4220, 766715, 6798, 0.986, 0.772, 0.667, 0.995, 0.991, 0.081, 0.591),
    PrintedRow("0003", 17995, 5544, 843943, 12518, 0.979, 0.764, 0.590, 0.993, 0.985, 0.084, 0.534),
    PrintedRow("0004", 35287, 9108, 5974393, 29212, 0.994, 0.795, 0.547, 0.998, 0.995, 0.076, 0.540),
    PrintedRow("0005", 32727, 12073, 2265772, 25228, 0.984, 0.758, 0.599, 0.995, 0.989, 0.080, 0.553),
    PrintedRow("0006", 7344, 2540, 902593, 2723, 0.994, 0.742, 0.730, 0.997, 0.997, 0.074, 0.633),
    PrintedRow("0007", 51549, 22196, 15274112, 52143, 0.995, 0.699, 0.497, 0.999, 0.997, 0.074, 0.521),
    PrintedRow("0008", 55472, 13000, 6488300, 43228, 0.991, 0.810, 0.562, 0.998, 0.993, 0.076, 0.560),
    PrintedRow("0009", 13759, 7172, 2368631, 10438, 0.993, 0.657, 0.569, 0.997, 0.996, 0.086, 0.505),
)
"""All ten rows as printed. By their counts 0002 has recall 0.677; 0005 fits its precision and recall with 37727 true
positives, so one digit of 32727 seems to be wrong."""


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


def table_chapter(judged: Sequence[Judged], setting: Setting, missing: str) -> Chapter:
    """Return Table 8.1 beside the same of all drives at one setting. missing: why there is no OctoMap."""
    shown = [one for one in judged if one.setting == setting]
    rows = [(f"{one.drive}, {one.mapper}", *row_of(vars(one.scores[CLAIMED]), TABLE)) for one in shown]
    thesis = [(f"thesis, {row.sequence}", *row_of(vars(row), TABLE)) for row in PRINTED]
    rows += [(f"{OCTOMAP}: {missing}", *["-"] * len(TABLE))] if missing else []
    claims = [_beside(one, name) for one in shown if one.mapper == THESIS for name in TABLE[4:]]
    return Chapter(
        "table81",
        "Table 8.1",
        f"Final results at p > 0.7, unobserved cells counted as free. Ours: {setting}. {OTHER_DATA}",
        claims,
        sheets=[Sheet("Thesis, Table 8.1, and ours", ("sequence", *TABLE), [*thesis, *rows])],
        remarks=[TRUTH],
        numbers={"thesis": [vars(row) for row in PRINTED]},
    )


def drive_chapter(name: str, judged: Sequence[Judged], counts: Mapping[str, Any], missing: str) -> Chapter:
    """Return all about one drive. counts: what became of the lidar's points, by setting; missing: as above."""
    frames = max(one.frames for one in judged)
    sheets = [points_sheet(judged, kind, missing) for kind in KINDS]
    sheets += [probabilities_sheet(judged), thresholds_sheet(judged), targets_sheet(judged)]
    method = (
        f"{frames} stereo pairs, mapped at {len({one.setting for one in judged})} settings. Truth: as in chapter 1."
    )
    return Chapter(
        f"drive_{name}",
        f"Drive {name}",
        method,
        claims_of(judged),
        list(_shown(judged)),
        sheets,
        [MEASURES, ALL_CELLS, RIVAL, BETTER],
        {"maps": [one.numbers() for one in judged], "lidar": counts, "missing": missing},
    )


def speed_chapter(speeds: Sequence[Speed]) -> Chapter:
    """Return how fast it is."""
    parts = ("read", "match", "prepare", "map")
    rows = [
        (one.profile, one.image, one.frames, one.cores, f"{one.hertz:.1f}",
         *(f"{one.ms[part]['median']:.1f} ({one.ms[part]['p90']:.1f})" for part in parts))
        for one in speeds
    ]  # fmt: skip
    heads = ("profile", "image", "frames", "cores", "frames a second", *(f"{part}, ms (90 %)" for part in parts))
    method = (
        "From image files to the updated map, two threads; files are read ahead beside the rest. Second of two passes. "
        "The claim is meant for a machine that does nothing else: fewer cores or other work make it slower."
    )
    sheets = [Sheet("Where the time goes", heads, rows)]
    numbers = {"speeds": [one.numbers() for one in speeds]}
    return Chapter("speed", "Time", method, [speed_claim(one) for one in speeds], (), sheets, numbers=numbers)


def _beside(one: Judged, name: str) -> Claim:
    printed = [getattr(row, name) for row in PRINTED]
    text = f"{one.drive}, profile {THESIS}, {one.setting}: {name}"
    return Claim(text, f"{min(printed):.3f} to {max(printed):.3f}", text_of(getattr(one.scores[CLAIMED], name)), None)


def _shown(judged: Sequence[Judged]) -> list[Shown]:
    pictures = [
        Shown("Precision and recall within one cell", "",
              "Each line is one map at all thresholds, truth: free is all in view; dots: p > 0.7, rings: p >= 0.7. "
              "The green corner is the target.", tolerances_png(judged)),
        Shown("Can the probabilities be believed?", "",
              "Of all observed cells with a probability, the share that is truly occupied. Below the dashed line a map "
              "claims too much.", reliabilities_png(judged)),
    ]  # fmt: skip
    for one in judged:
        if one.series is not None and len(one.series["frame"]):
            thesis = one.mapper == THESIS
            place = "Fig 8.4" if thesis else f"Frame by frame, {one.mapper}, {one.setting}"
            ours = f"{one.mapper}, {one.setting}, after each frame, against the truth of the whole drive."
            pictures.append(Shown(place, FIG_8_4 if thesis else "", ours, series_png(one.series)))
        if one.mapper == DEFAULT and one.shown is not None and len(one.shown.cells):
            pictures.append(Shown(f"Right and wrong from above, {one.mapper}, {one.setting}", "",
                                  "Columns in the mixed colours of their cells.", outcomes_png(one.shown)))  # fmt: skip
            pictures.append(Shown(f"Thresholds, ROC and reliability, {one.mapper}, {one.setting}", "",
                                  "Truth: free is all in view.", curves_png(one.scores[CLAIMED])))  # fmt: skip
    return pictures
