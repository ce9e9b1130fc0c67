# SPDX-License-Identifier: Apache-2.0
"""The tree of frames while it is being told: the newest transforms, and nothing that only a recording can know."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from stereovox.sources.tf import Tf
from stereovox.sources.tf_edge import Edge

MOST = 2000
"""Transforms of a frame that are kept at most; half of them go when there are more."""
RESET_NS = 1_000_000_000
"""A transform that is so much older than the newest one is of a clock that was set back: those before it are over."""


class LiveEdge(Edge):
    """Where a frame stood in its parent lately.

    A frame that has not moved so far may move at any time: unlike in a recording, it is never taken for fixed.
    """

    def add(self, stamp_ns: int, numbers: Iterable[float]) -> None:
        """Take in tx ty tz qx qy qz qw at a time."""
        if self._stamps and stamp_ns < max(self._stamps[-MOST // 8 :]) - RESET_NS:
            self._keep(0)
        elif len(self._stamps) >= MOST:
            self._keep(MOST // 2)
        super().add(stamp_ns, numbers)

    def _keep(self, newest: int) -> None:
        del self._stamps[: len(self._stamps) - newest]
        del self._rows[: len(self._rows) - 7 * newest]

    def _in_order(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        ordered = super()._in_order()
        self._still = False
        return ordered


class LiveTf(Tf):
    """Transforms between frames of a robot that is running."""

    edge: ClassVar[type[Edge]] = LiveEdge
