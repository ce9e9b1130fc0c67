# SPDX-License-Identifier: Apache-2.0
"""Tables of all maps of one drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

from stereovox.evaluate.reproduce.chapter import NO, YES, Sheet
from stereovox.evaluate.reproduce.valenti.claims import CLAIMED, KINDS, TARGETS, results
from stereovox.evaluate.reproduce.valenti.figures import figures
from stereovox.evaluate.reproduce.valenti.judge import Judged
from stereovox.evaluate.reproduce.valenti.mappers import OCTOMAP

VERDICTS = {True: YES, False: NO, None: "-"}


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
