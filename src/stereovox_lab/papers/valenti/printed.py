# SPDX-License-Identifier: Apache-2.0
"""Valenti 2018, Table 8.1, as printed, and the verdict on each figure by rules set beforehand.

Own counts: a rate fits the four counts of its row to the last printed digit, rounded or cut off. Ours: at one setting,
over the whole box of a drive, at p > 0.7, the profile `valenti2018` is no worse than the row of the same sequence, and
on any other drive no worse than the worst of the ten rows; `default` is better than that row, or than the best of ten.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from stereovox.evaluate.metrics import Confusion
from stereovox.evaluate.scores import Scores
from stereovox_lab.papers.chapter import Claim
from stereovox_lab.papers.valenti.judge import Judged
from stereovox_lab.papers.valenti.mappers import DEFAULT, THESIS

TABLE = ("tp", "fp", "tn", "fn", "accuracy", "precision", "recall", "specificity", "npv", "error", "correlation")
RATES = TABLE[4:]
MEASURE = {"correlation": "correlation_free"}
"""Our names for the table's, where they differ: only with unobserved cells as free (Eq 8.1) can the printed values be
reached over whole boxes, most of whose cells no camera sees."""
COUNTED = TABLE[4:9]
"""Figures that also follow from the four counts of a row."""
LAST_DIGIT = 1e-3
SEQUENCE = "kitti_tracking_"
"""Prefix of the names of drives from the KITTI tracking data."""


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
"""All ten rows as printed. By their counts 0002 has recall 0.677, 0006 precision 0.743; 0005 fits its precision and
recall with 37727 true positives, so one digit of 32727 seems to be wrong."""
WORST = {name: (max if name == "error" else min)(getattr(row, name) for row in PRINTED) for name in RATES}
BEST = {name: (min if name == "error" else max)(getattr(row, name) for row in PRINTED) for name in RATES}
"""Best figures of the ten rows."""


def counted(row: PrintedRow) -> dict[str, float | None]:
    """Return the rates that follow from a row's counts."""
    return Confusion(row.tp, row.fp, row.tn, row.fn).rates()


def misprints() -> dict[tuple[str, str], float]:
    """Return sequence and name of each printed rate that its row's counts contradict, with their value."""
    found = {}
    for row in PRINTED:
        for name, value in counted(row).items():
            if value is not None and abs(value - getattr(row, name)) >= LAST_DIGIT:
                found[row.sequence, name] = value
    return found


def row_of_drive(drive: str) -> PrintedRow | None:
    """Return the printed row of a drive, None if the table has none."""
    rows = {SEQUENCE + row.sequence: row for row in PRINTED}
    return rows.get(drive)


def no_worse(name: str, ours: float, printed: float) -> bool:
    """Return whether a figure is no worse than the printed one, to half of its last digit."""
    return (printed - ours if name != "error" else ours - printed) <= LAST_DIGIT / 2


def better(name: str, ours: float, printed: float) -> bool:
    """Return whether a figure is better than the printed one."""
    return ours < printed if name == "error" else ours > printed


def drive_claims(judged: Iterable[Judged], kind: str) -> list[Claim]:
    """Return the claims on each figure of each drive; judged: at one setting. kind: of truth."""
    claims = []
    for one in judged:
        if one.mapper in (THESIS, DEFAULT):
            claims += [_claim(one, name, measured(one.scores[kind], name)) for name in RATES]
    return claims


def measured(scores: Scores, name: str) -> float | None:
    """Return our figure for one of the table's."""
    return getattr(scores, MEASURE.get(name, name))


def absent_claims(drives: Iterable[str]) -> list[Claim]:
    """Return the claims that cannot be judged: missing sequences, and counts."""
    there = {row.sequence for drive in drives if (row := row_of_drive(drive))}
    absent = [row.sequence for row in PRINTED if row.sequence not in there]
    claims = [Claim("tp, fp, tn, fn of the ten rows", "as printed", "-", None,
                    "they go with the cell size and range, which the thesis does not give")]  # fmt: skip
    if absent:
        text = f"figures of sequence{'s' * (len(absent) > 1)} {', '.join(absent)}"
        claims.append(Claim(text, "as printed", "-", None, "not among the drives of --data"))
    return claims


def judged_rows(judged: Sequence[Judged], kind: str) -> list[tuple[str, ...]]:
    """Return the printed rows as text, each figure with its verdict: own counts, and ours if available."""
    off = misprints()
    ours = {one.drive: one.scores[kind] for one in judged if one.mapper == THESIS}
    rows = list[tuple[str, ...]]()
    for row in PRINTED:
        scores = ours.get(SEQUENCE + row.sequence)
        cells = []
        for name in TABLE:
            printed = getattr(row, name)
            text = f"{printed:,}" if isinstance(printed, int) else f"{printed:.3f}"
            if (row.sequence, name) in off:
                text += f" \u2717 its counts: {off[row.sequence, name]:.3f}"
            elif name in COUNTED:
                text += " \u2713 its counts"
            value = None if scores is None or name not in RATES else measured(scores, name)
            if value is None:
                text += "; ours: ?"
            else:
                text += f"; ours: {value:.3f} {chr(0x2713) if no_worse(name, value, printed) else chr(0x2717)}"
            cells.append(text)
        rows.append((row.sequence, *cells))
    return rows


def _claim(one: Judged, name: str, value: float | None) -> Claim:
    row, theirs = row_of_drive(one.drive), one.mapper == THESIS
    goal = getattr(row, name) if row else (WORST if theirs else BEST)[name]
    which = f"of {row.sequence}" if row else f"the {'worst' if theirs else 'best'} of ten"
    text = f"{one.drive}, {one.mapper}: {name} {'no worse than' if theirs else 'better than'} printed"
    wanted = f"{goal:.3f} ({which})"
    if value is None:
        return Claim(text, wanted, "-", None, "it has no value: the map marks nothing, or the truth holds nothing")
    holds = no_worse(name, value, goal) if theirs else better(name, value, goal)
    return Claim(text, wanted, f"{value:.3f}", holds)
