# SPDX-License-Identifier: Apache-2.0
"""The report of a reproduction as one page of HTML: chapter by chapter claims, pictures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from stereovox.evaluate.reproduce.chapter import Chapter, Sheet, Shown
from stereovox.view.page import figure, page, section, table, tiles

HEADS = ("claim", "thesis", "ours", "holds?")


def report(
    title: str,
    lead: str,
    facts: Sequence[tuple[str, str]],
    chapters: Sequence[Chapter],
    heads: Sequence[str] = HEADS,
) -> str:
    """Return the page. facts: value and label of the boxes at the top; heads: of the four columns of claims."""
    parts = (_chapter(n, one, heads) for n, one in enumerate(chapters, 1))
    return page(title, lead, tiles(facts), _contents(chapters), *parts)


def _contents(chapters: Sequence[Chapter]) -> str:
    rows = []
    for n, one in enumerate(chapters, 1):
        verdicts = [claim.holds for claim in one.claims]
        rows.append((f"{n}. {one.title}", *(verdicts.count(verdict) for verdict in (True, False, None))))
    heads = ("experiment", "claims that hold", "claims that do not", "figures without a claim")
    broken = [f"{n}. {claim.text}" for n, one in enumerate(chapters, 1) for claim in one.claims if claim.holds is False]
    text = f"Does not hold: {'; '.join(broken)}." if broken else "Every claim holds."
    return section("What holds", text, table(heads, rows))


def _chapter(number: int, one: Chapter, heads: Sequence[str]) -> str:
    rows = [(claim.text, claim.thesis, claim.ours, claim.verdict) for claim in one.claims]
    claims = [table(heads, rows)] if rows else []
    parts = [*claims, *map(_shown, one.shown), *map(_sheet, one.sheets), *map(_paragraph, one.remarks)]
    return section(f"{number}. {one.title}", one.method, *parts)


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
