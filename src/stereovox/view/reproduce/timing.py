# SPDX-License-Identifier: Apache-2.0
"""Times as bars (Chien 2020, Table 4.3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereovox.evaluate.reproduce.timing import Timed
from stereovox.view.charts import labels
from stereovox.view.reproduce.shared import OURS, THESIS, figure_of, png


def times_png(rows: Sequence[Timed]) -> bytes:
    """Return the milliseconds of a whole frame as bars, the thesis's beside ours."""
    figure = figure_of(0.5 * len(rows) + 1.0)
    axis = figure.add_subplot()
    place = np.arange(len(rows))
    known = [(p, row.row.thesis_ms) for p, row in zip(place, rows, strict=True) if row.row.thesis_ms]
    axis.barh([p - 0.2 for p, _ in known], [ms for _, ms in known], 0.38, color=THESIS, label="thesis, i7-8550U")
    axis.barh(place + 0.2, [row.mean_ms for row in rows], 0.38, color=OURS, label="ours, this machine, one thread")
    axis.set(xscale="log", yticks=place, yticklabels=[row.row.name for row in rows])
    axis.invert_yaxis()
    axis.legend(frameon=False, loc="lower right")
    labels(axis, "milliseconds a frame, mean (logarithmic)", "")
    return png(figure)
