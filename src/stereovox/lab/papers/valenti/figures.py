# SPDX-License-Identifier: Apache-2.0
"""From scores to the figures that are claimed: points on the curve of precision and recall."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.curves import PrecisionRecall
from stereovox.evaluate.scores import Scores

STRICT, AT_LEAST = 0.7, 0.6998
"""p > 0.7 as in the thesis; p >= 0.7, as one hit leaves a cell of OctoMap: maps keep thousandths of log-odds."""
THRESHOLDS: NDArray[np.float64] = np.union1d(np.arange(1, 200) / 200, [AT_LEAST])
LISTED = (0.3, 0.4, 0.5, 0.6, STRICT, 0.8, 0.9)
"""Thresholds of the table on the page."""
EXACT, TOLERANT = ("precision", "recall"), ("tolerance_precision", "tolerance_recall")


def at(curve: PrecisionRecall, threshold: float) -> dict[str, float | None]:
    """Return threshold, precision and recall, exact and tolerant, at the nearest threshold of the curve."""
    return _point(curve, int(np.argmin(np.abs(curve.threshold - threshold))))


def best(curve: PrecisionRecall, names: tuple[str, str], wanted: tuple[float, float] = (0.0, 0.0)) -> dict[str, Any]:
    """Return the point where the lesser of the two measures, each less what is wanted of it, is largest."""
    margins = [np.nan_to_num(getattr(curve, name), nan=-1.0) - goal for name, goal in zip(names, wanted, strict=True)]
    return _point(curve, int(np.argmax(np.minimum(*margins))))


def figures(scores: Scores) -> dict[str, Any]:
    """Return all that is reported of one map against one truth at thresholds named beforehand, fit for JSON."""
    return {
        **scores.as_dict(),
        "strict": at(scores.curve, STRICT),
        "at_least": at(scores.curve, AT_LEAST),
        "listed": [at(scores.curve, threshold) for threshold in LISTED],
    }


def _point(curve: PrecisionRecall, i: int) -> dict[str, float | None]:
    names = ("threshold", *EXACT, *TOLERANT)
    values = {name: float(getattr(curve, name)[i]) for name in names}
    return {name: value if np.isfinite(value) else None for name, value in values.items()}
