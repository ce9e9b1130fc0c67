# SPDX-License-Identifier: Apache-2.0
"""Thresholds are never chosen and scored on the same part of a street.

With several drives each is scored at thresholds chosen on all the others. A single drive is cut in two along its path:
thresholds are chosen on the first half of the street and scored on the second, with an ignored strip between them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereovox.evaluate.curves import EXACT, TOLERANT, PrecisionRecall
from stereovox.evaluate.scores import Scores
from stereovox_lab.papers.valenti.figures import at, figures
from stereovox_lab.papers.valenti.judge import Judged
from stereovox_lab.papers.valenti.street import GAP_M

NOT_APART = "one drive alone, which cannot be cut in two; add another drive"


@dataclass(frozen=True, eq=False)
class Apart:
    """A map, and the scores for claims. All by the kind of truth, `view` and `rays`.

    chosen: precision and recall on the part for choosing thresholds, or None. scored: scores of the
    rest, on which thresholds are never chosen. where: both parts, in words.
    """

    judged: Judged
    chosen: Mapping[str, PrecisionRecall] | None
    scored: Mapping[str, Scores]
    where: str

    def point(
        self, kind: str, names: tuple[str, str], wanted: tuple[float, float] = (0.0, 0.0)
    ) -> dict[str, float | None] | None:
        """Return the scored point at the threshold that `best` picks on the other part; None if missing."""
        if self.chosen is None:
            return None
        return at(self.scored[kind].curve, self.chosen[kind].best(names, wanted)["threshold"])

    def numbers(self) -> dict[str, Any]:
        """Return all figures, fit for JSON: for the whole drive, and separately for the scored part."""
        apart = {
            kind: {
                **figures(scores),
                "balanced": self.point(kind, TOLERANT),
                "balanced_exact": self.point(kind, EXACT),
            }
            for kind, scores in self.scored.items()
        }
        return {**self.judged.numbers(), "where": self.where, "apart": apart}


def apart(judged: Sequence[Judged]) -> list[Apart]:
    """Return the maps of all drives, in order, each with its parts for choosing and scoring thresholds."""
    return [_apart(one, [other for other in judged if _same_but_drive(one, other)]) for one in judged]


def _same_but_drive(one: Judged, other: Judged) -> bool:
    return one.drive != other.drive and (one.setting, one.mapper) == (other.setting, other.mapper)


def _apart(one: Judged, others: Sequence[Judged]) -> Apart:
    if others:
        names = ", ".join(other.drive for other in others)
        curves = {kind: _mean([other.scores[kind].curve for other in others]) for kind in one.scores}
        return Apart(one, curves, one.scores, f"thresholds are chosen on {names}, and scored on all of this drive")
    if one.halves is None:
        return Apart(one, None, one.scores, f"no threshold is chosen: {NOT_APART}")
    where = (
        "thresholds are chosen on the first half of the street and scored on the second, as there is no other drive; "
        f"the two are at least {GAP_M:g} m apart, but of one street, one day and one camera"
    )
    curves = {kind: first.curve for kind, (first, _) in one.halves.items()}
    return Apart(one, curves, {kind: second for kind, (_, second) in one.halves.items()}, where)


def _mean(curves: Sequence[PrecisionRecall]) -> PrecisionRecall:
    """Return the mean over drives at each threshold; a drive without a value counts as 0."""
    names = (*EXACT, *TOLERANT)
    values = {name: np.mean([np.nan_to_num(getattr(one, name)) for one in curves], axis=0) for name in names}
    return PrecisionRecall(curves[0].threshold, **values)
