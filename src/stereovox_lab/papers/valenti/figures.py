# SPDX-License-Identifier: Apache-2.0
"""Figures of the claims: points on the curve of precision and recall."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.curves import PrecisionRecall
from stereovox.evaluate.scores import Scores

STRICT, AT_LEAST = 0.7, 0.6998
"""p > 0.7 as in the thesis; p >= 0.7, where one hit leaves an OctoMap cell: maps keep thousandths of log-odds."""
THRESHOLDS: NDArray[np.float64] = np.union1d(np.arange(1, 200) / 200, [AT_LEAST])
LISTED = (0.3, 0.4, 0.5, 0.6, STRICT, 0.8, 0.9)
"""Thresholds of the table on the page."""


def at(curve: PrecisionRecall, threshold: float) -> dict[str, float | None]:
    """Return threshold, precision and recall, exact and tolerant, at the nearest threshold of the curve."""
    return curve.point(int(np.argmin(np.abs(curve.threshold - threshold))))


def figures(scores: Scores) -> dict[str, Any]:
    """Return the reported figures of one map against one truth at thresholds fixed beforehand, fit for JSON."""
    numbers = scores.as_dict()
    del numbers["balanced"]  # its threshold is chosen on what it is scored on, see `Apart`
    return {
        **numbers,
        "strict": at(scores.curve, STRICT),
        "at_least": at(scores.curve, AT_LEAST),
        "listed": [at(scores.curve, threshold) for threshold in LISTED],
    }
