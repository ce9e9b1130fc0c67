# SPDX-License-Identifier: Apache-2.0
"""The error of the 2-D map against a reference while it is made (IST 2019, Eq 7), in a thread of its own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from time import monotonic
from typing import Any

from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_align import Rectangle
from stereovox.evaluate.grid_scores import CellErrors, cell_errors, differences, laid_on
from stereovox.formats.map_server import read_map_server
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.ros.background import Background
from stereovox.ros.mapping import Mapping
from stereovox.ros.options import Options, region_of

TOPIC = "map_error"
PERIOD_S = 1.0
"""Least seconds between two scores."""


def error_of(grid: OccupancyGrid, reference: OccupancyGrid, exclude: Sequence[Rectangle]) -> CellErrors:
    """Return the differences of a map from a reference in the same frame; raises StereovoxError as `score_grids`."""
    laid = laid_on(grid, reference, exclude, align=False)
    return cell_errors(laid, differences(laid))


def score_of(node: Any, mapping: Mapping, options: Options) -> Score | None:
    """Return the comparison of the map with the options' reference, None without one; raises StereovoxError."""
    file = options.reference or options.floor
    if not file:
        return None
    reference = read_map_server(file)
    if reference.note:
        node.get_logger().warning(f"{file}: {reference.note}")
    return Score(node, mapping, reference, [region_of(text) for text in options.exclude])


class Score:
    """Publishes Eq 7 in per cent on `map_error` (std_msgs/Float32) while the map changes.

    exclude: regions (x0, y0, x1, y1) in metres that do not count. clock: monotonic seconds.
    """

    def __init__(self, node: Any, mapping: Mapping, reference: OccupancyGrid, exclude: Sequence[Rectangle] = (),
                 clock: Callable[[], float] = monotonic):  # fmt: skip
        from std_msgs.msg import Float32

        self._node, self._mapping, self._reference, self._exclude = node, mapping, reference, exclude
        self._clock, self._message = clock, Float32
        self._publisher = node.create_publisher(Float32, TOPIC, 10)
        self._work: Background[CellErrors] = Background("stereovox-score")
        self._next, self._frames, self._busy = 0.0, 0, False
        self._last: CellErrors | None = None

    def counts(self) -> dict[str, object]:
        """Return the values for diagnostics."""
        return {} if self._last is None else self._values(self._last)

    def update(self) -> None:
        """Publish a finished score, and begin the next one if it is due."""
        if (ended := self._work.poll()) is not None:
            self._busy = False
            self._take(ended.result)
        now, frames = self._clock(), self._mapping.history.frames
        if self._busy or now < self._next or frames == self._frames:
            return
        if (grid := self._grid()) is not None:
            self._next, self._frames, self._busy = now + PERIOD_S, frames, True
            self._work.put(partial(error_of, grid, self._reference, self._exclude))

    def final(self) -> dict[str, object]:
        """Score the present map, and return Eq 7 and its parts in per cent; empty without a map."""
        self._work.drop()
        self._busy = False
        if (grid := self._grid(last=True)) is not None:
            self._take(lambda: error_of(grid, self._reference, self._exclude))
        return self.counts()

    def _grid(self, last: bool = False) -> OccupancyGrid | None:
        try:
            return self._mapping.grid(last)  # a copy, since the map may change
        except StereovoxError as error:
            self._node.get_logger().warning(f"no score: {error}", throttle_duration_sec=30.0)
            return None

    def _take(self, score: Callable[[], CellErrors]) -> None:
        try:
            self._last = last = score()
        except StereovoxError as error:
            self._node.get_logger().warning(f"no score: {error}", throttle_duration_sec=30.0)
            return
        self._publisher.publish(self._message(data=float(last.eq7_percent)))

    @staticmethod
    def _values(errors: CellErrors) -> dict[str, object]:
        return {
            "eq7_percent": errors.eq7_percent,
            "eq7_coverage_percent": errors.eq7_coverage_percent,
            "eq7_contradiction_percent": errors.eq7_contradiction_percent,
        }
