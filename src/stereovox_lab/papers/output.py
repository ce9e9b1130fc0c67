# SPDX-License-Identifier: Apache-2.0
"""Output of all reproductions: report, numbers and progress."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.view.report.page import figure, out_folder, page, section, table, tiles
from stereovox_lab.papers.chapter import Chapter, Claim, Progress, Sheet, Shown, count

HEADS = ("claim", "thesis", "ours", "holds?")
COUNTED = ("hold", "do not", "cannot be judged", "figures without a claim")


def report(
    title: str,
    lead: str,
    facts: Sequence[tuple[str, str]],
    chapters: Sequence[Chapter],
    heads: Sequence[str] = HEADS,
) -> str:
    """Return the page. facts: value and label of the boxes at the top; heads: of the four columns of claims."""
    parts = (_chapter(n, one, heads) for n, one in enumerate(chapters, 1))
    return page(title, lead, tiles(facts), _contents(chapters, heads), *parts)


def _contents(chapters: Sequence[Chapter], names: Sequence[str]) -> str:
    rows = [(f"{n}. {one.title}", *count(one.claims)) for n, one in enumerate(chapters, 1)]
    heads = ("experiment", *(f"claims that {what}" for what in COUNTED[:3]), COUNTED[3])
    broken = [(f"{n}.", *_row(claim)[:3]) for n, one in enumerate(chapters, 1) for claim in one.claims
              if claim.holds is False]  # fmt: skip
    if not broken:
        return section("What holds", "Every claim that can be judged holds.", table(heads, rows))
    failed = f"<h3>What does not hold</h3>\n{table(('', *names[:3]), broken)}"
    return section("What holds", f"{len(broken)} claims do not hold.", table(heads, rows), failed)


def _chapter(number: int, one: Chapter, heads: Sequence[str]) -> str:
    rows = [_row(claim) for claim in one.claims]
    claims = [table(heads, rows)] if rows else []
    parts = [*claims, *map(_shown, one.shown), *map(_sheet, one.sheets), *map(_paragraph, one.remarks)]
    return section(f"{number}. {one.title}", one.method, *parts)


def _row(claim: Claim) -> tuple[str, str, str, str]:
    return claim.text, claim.thesis, claim.ours, claim.verdict


def _shown(shown: Shown) -> str:
    heading, ours = f"<h3>{escape(shown.place)}</h3>\n", escape(shown.ours)
    if not shown.said:
        return f"{heading}<p>{ours}</p>\n{figure(shown.png, shown.place)}"
    said = f"<p><b>{escape(shown.place)} as published</b> (in words; the picture itself is not at hand): "
    picture = figure(shown.png, f"Ours, beside {shown.place}")
    return f"{heading}{said}{escape(shown.said)}</p>\n<p><b>Ours:</b> {ours}</p>\n{picture}"


def _sheet(sheet: Sheet) -> str:
    return f"<h3>{escape(sheet.heading)}</h3>\n{table(sheet.heads, sheet.rows)}"


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


class Steps:
    """Counts steps over all experiments."""

    def __init__(self, progress: Progress, total: int):
        self._progress, self._total, self._done = progress, total, 0

    def of(self, text: str) -> Callable[[], None]:
        """Return a function to call after each step of one experiment."""

        def step() -> None:
            self._done += 1
            self._progress(min(self._done, self._total), self._total, text)

        self._progress(self._done, self._total, text)
        return step


def output_files(out: Path) -> dict[str, Path]:
    """Return the files to be written; raises StereovoxError now, not after minutes, if they are not writable."""
    out_folder(out)
    files = {"report": out / "report.html", "numbers": out / "numbers.json"}
    for path in files.values():
        if path.is_dir() or not os.access(path if path.exists() else out, os.W_OK):
            raise StereovoxError(f"{path}: cannot be written; choose another --out")
    return files


def write_result(
    files: dict[str, Path],
    found: Sequence[Chapter],
    seconds: float,
    *,
    paper: str,
    title: str,
    lead: str,
    quick: bool,
    heads: Sequence[str] = HEADS,
) -> dict[str, Any]:
    """Write the page and the numbers of all chapters; return the result of the command.

    lead: the page's introduction; heads: of the four columns of claims.
    Raises StereovoxError if a file cannot be written.
    """
    claims = [claim for chapter in found for claim in chapter.claims]
    result = {
        "paper": paper,
        "quick": quick,
        "holds": sum(claim.holds is True for claim in claims),
        "does_not_hold": [claim.text for claim in claims if claim.holds is False],
        "cannot_be_judged": [f"{claim.text}: {claim.unjudged}" for claim in claims if claim.unjudged],
        "seconds": round(seconds, 1),
        "files": {name: str(path) for name, path in files.items()},
    }
    numbers = {chapter.name: chapter.summary() for chapter in found}
    _write(files["numbers"], json.dumps({**result, "experiments": numbers}, indent=1, allow_nan=False) + "\n")
    lead += " A quick run with few frames: do not quote it." if quick else ""
    _write(files["report"], report(title, lead, _facts(found, seconds), found, heads))
    return result


def _facts(found: Sequence[Chapter], seconds: float) -> list[tuple[str, str]]:
    counts = count(claim for chapter in found for claim in chapter.claims)
    heads = (*(f"claims {what}" for what in ("hold", "do not", "cannot be judged")), COUNTED[3])
    boxes = [(str(number), what) for number, what in zip(counts, heads, strict=True)]
    return [*boxes, (f"{seconds / 60:.1f} min", "for everything")]


def _write(path: Path, text: str) -> None:
    with replacing(path, StereovoxError) as file:
        file.write(text.encode())
