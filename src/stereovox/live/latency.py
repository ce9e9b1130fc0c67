# SPDX-License-Identifier: Apache-2.0
"""The latency of images from the camera into the map, and to all outputs of the map."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from time import monotonic_ns
from typing import Any

from stereovox.evaluate.metrics import percentiles
from stereovox.frame import UpdateReport
from stereovox.frame.wall_clock import epoch_ns
from stereovox.live.stream import Moment

STAMP, ARRIVAL = "stamp", "arrival"


class Latency:
    """Milliseconds since the stamp of each mapped image, or since its arrival if the stamp is by another clock.

    Args:
        moment: Returns when the newest image was taken and arrived.
    """

    def __init__(self, moment: Callable[[], Moment]):
        self._moment = moment
        self._map_ms, self._outputs_ms = array("d"), array("d")
        self._since: set[str] = set()
        self.mapped = _Mark(self._map)
        self.sent = _Mark(self._sent)

    def summary(self) -> dict[str, Any]:
        """Return median, p90, p99 and max of `map` and `outputs`, and `since`: `stamp`, `arrival` or both."""
        return {
            "map": percentiles(self._map_ms.tolist()),
            "outputs": percentiles(self._outputs_ms.tolist()),
            "since": " and ".join(sorted(self._since, reverse=True)),
        }

    def _map(self, report: UpdateReport) -> None:
        if not report.refused:
            self._map_ms.append(self._age_ms())

    def _sent(self, report: UpdateReport) -> None:
        if not report.refused:
            self._outputs_ms.append(self._age_ms())

    def _age_ms(self) -> float:
        moment = self._moment()
        if moment.taken_ns is None:
            self._since.add(ARRIVAL)
            return (monotonic_ns() - moment.arrived_ns) / 1e6
        self._since.add(STAMP)
        return (epoch_ns() - moment.taken_ns) / 1e6


class _Mark:
    """An observer that records the time."""

    def __init__(self, note: Callable[[UpdateReport], None]):
        self._note = note

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Record a frame."""
        self._note(report)
