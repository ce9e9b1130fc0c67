# SPDX-License-Identifier: Apache-2.0
"""Result of an experiment: claims that hold or not, tables and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

Progress = Callable[[int, int, str], None]
"""Called with steps done, steps in all, and the current activity."""
YES, NO, UNJUDGED = "\u2713 yes", "\u2717 no", "? cannot be judged"


@dataclass(frozen=True)
class Claim:
    """One row of "does it hold?".

    holds: None if nothing is claimed and the number is for comparison, or if the claim cannot be judged here:
    `unjudged` then says why not.
    """

    text: str
    thesis: str
    ours: str
    holds: bool | None
    unjudged: str = ""

    @property
    def verdict(self) -> str:
        """Whether it holds, in a word."""
        if self.unjudged:
            return f"{UNJUDGED}: {self.unjudged}"
        return "-" if self.holds is None else YES if self.holds else NO


def count(claims: Iterable[Claim]) -> tuple[int, int, int, int]:
    """Return the numbers of claims that hold, do not hold, cannot be judged, and are mere figures."""
    claims = list(claims)
    verdicts = [one.holds for one in claims]
    unjudged = sum(bool(one.unjudged) for one in claims)
    return verdicts.count(True), verdicts.count(False), unjudged, verdicts.count(None) - unjudged


@dataclass(frozen=True)
class Shown:
    """A picture (PNG), its place in the paper (`Fig 4.6`), the paper's description of its picture, and ours.

    A picture without a counterpart in the paper has a heading as `place`, and `said` is empty.
    """

    place: str
    said: str
    ours: str
    png: bytes


@dataclass(frozen=True)
class Sheet:
    """A table with a heading."""

    heading: str
    heads: Sequence[str]
    rows: Sequence[Sequence[Any]]


@dataclass(frozen=True)
class Chapter:
    """One experiment of a report.

    method: a short description. remarks: background for judging it, one paragraph each.
    numbers: all measurements, fit for JSON.
    """

    name: str
    title: str
    method: str
    claims: Sequence[Claim]
    shown: Sequence[Shown] = ()
    sheets: Sequence[Sheet] = ()
    remarks: Sequence[str] = ()
    numbers: dict[str, Any] = field(default_factory=dict)

    def summary(self) -> dict[str, Any]:
        """Return the chapter without its pictures, fit for JSON."""
        return {"title": self.title, "claims": [asdict(claim) for claim in self.claims], "numbers": self.numbers}


def percent(share: float) -> str:
    """Return `94.3 %` with a no-break space."""
    return f"{100 * share:.1f}\u00a0%"
