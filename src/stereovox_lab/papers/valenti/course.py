# SPDX-License-Identifier: Apache-2.0
"""Course of measures along a drive, frame by frame (Valenti 2018, Fig 8.4), against the thesis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stereovox_lab.papers.chapter import Claim
from stereovox_lab.papers.valenti.judge import Judged
from stereovox_lab.papers.valenti.mappers import THESIS

RISING, STEADY = ("recall", "correlation"), ("precision", "error")
"""Measures that rise while the scene is explored, and those that stay about level, according to 8.4."""
RISES, LEVEL, FRAMES = 0.9, 0.05, 8
"""Least rank correlation of a rising measure with the frame; largest change of a level one; fewest frames."""


def course_claims(judged: Sequence[Judged]) -> list[Claim]:
    """Return the claims on Fig 8.4 for maps of the thesis's profile that were scored after every frame."""
    return [
        claim
        for one in judged
        if one.mapper == THESIS and one.series is not None
        for claim in (*(_rises(one, name) for name in RISING), *(_stays(one, name) for name in STEADY))
    ]


def _rises(one: Judged, name: str) -> Claim:
    text, wanted = f"Fig 8.4, {one.mapper}: {name} rises along the drive", f"rises; rank correlation {RISES:g} or more"
    values = _values(one, name)
    if values is None:
        return _too_few(text, wanted)
    rank = rank_correlation(values)
    return Claim(text, wanted, f"{values[0]:.3f} to {values[-1]:.3f}, rank correlation {rank:.2f}", rank >= RISES)


def _stays(one: Judged, name: str) -> Claim:
    text, wanted = f"Fig 8.4, {one.mapper}: {name} stays about level", f"about level; changes by {LEVEL:g} at most"
    values = _values(one, name)
    if values is None:
        return _too_few(text, wanted)
    quarter = len(values) // 4
    first, last = float(values[:quarter].mean()), float(values[-quarter:].mean())
    return Claim(text, wanted, f"{first:.3f}, first quarter; {last:.3f}, last one", abs(last - first) <= LEVEL)


def rank_correlation(values: NDArray[np.floating]) -> float:
    """Return Spearman's rank correlation of values (N,) with their order; 0 if all are equal."""
    from scipy.stats import rankdata

    if np.ptp(values) == 0:
        return 0.0
    return float(np.corrcoef(np.arange(len(values)), rankdata(values))[0, 1])


def _values(one: Judged, name: str) -> NDArray[np.float64] | None:
    """Return the measure after each frame in which it has a value; None if there are too few."""
    assert one.series is not None
    values = np.asarray(one.series.get(name, ()), float)
    values = values[np.isfinite(values)]
    return values if len(values) >= FRAMES else None


def _too_few(text: str, wanted: str) -> Claim:
    return Claim(text, wanted, "-", None, f"fewer than {FRAMES} frames")
