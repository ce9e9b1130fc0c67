# SPDX-License-Identifier: Apache-2.0
"""A finished 2-D map as plain numbers, for map_server, AMCL and comparisons."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.geometry import se2
from stereovox.maps.cells.cell_format import CellRules, State
from stereovox.maps.query.queries import points_of, shape_error

UNKNOWN = -1


@dataclass(frozen=True, eq=False)
class OccupancyGrid:
    """A picture of a floor, with the meaning of `nav_msgs/OccupancyGrid`.

    Attributes:
        cells: (rows, columns) int8, probability of being occupied in per cent (0 to 100), -1 unknown. Row 0 is the
            lowest y, column 0 the lowest x.
        resolution: Side of a cell in metres.
        origin: (3,) x, y in metres and yaw in radians of the lower left corner of cell (0, 0) in the map's frame.
        free_below: Probability below which a known cell counts as free.
        occupied_above: Probability above which a known cell counts as occupied.
        note: What a reader noticed about its file, for the user; "": nothing.

    Raises:
        StereovoxError: `cells` or `origin` has another shape.
    """

    cells: NDArray[np.int8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    free_below: float = 0.3
    occupied_above: float = 0.7
    note: str = ""

    def __post_init__(self) -> None:
        if np.ndim(self.cells) != 2:
            raise shape_error("cells", self.cells, "(rows, columns) int8, per cent")
        if np.shape(self.origin) != (3,):
            raise shape_error("origin", self.origin, "(3,): x, y in metres and yaw in radians")

    @property
    def states(self) -> NDArray[np.uint8]:
        """`State` of each cell, (rows, columns) uint8."""
        percent = np.arange(256, dtype=np.uint8).view(np.int8).astype(float)
        states = np.full(256, State.TENTATIVE, np.uint8)
        states[percent < 100 * self.free_below] = State.FREE
        states[percent > 100 * self.occupied_above] = State.OCCUPIED
        states[percent < 0] = State.UNKNOWN
        return states[self.cells.view(np.uint8)]

    @property
    def message_cells(self) -> NDArray[np.int8]:
        """`cells` for `nav_msgs/OccupancyGrid`, which has no thresholds: free is below 30, occupied above 70."""
        free, occupied = 100 * self.free_below, 100 * self.occupied_above
        ends = [0, np.ceil(free) - 1, np.ceil(free), np.floor(occupied), np.floor(occupied) + 1, 100]
        ends = np.maximum.accumulate(ends)  # both thresholds may lie within one per cent
        spread = np.interp(
            np.arange(256, dtype=np.uint8).view(np.int8), ends, [0, 29, 30, 70, 71, 100], UNKNOWN, UNKNOWN
        )
        return np.rint(spread).astype(np.int8)[self.cells.view(np.uint8)]

    @property
    def known_span(self) -> tuple[slice, slice]:
        """The range of rows and columns with known cells; both empty if there are none."""
        known = self.cells != UNKNOWN
        ends = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
        rows, columns = (slice(int(n[0]), int(n[-1]) + 1) if len(n) else slice(0, 0) for n in ends)
        return rows, columns

    @property
    def known_corners(self) -> NDArray[np.float64]:
        """Corners (4, 2) x, y, in cells, of the bounding rectangle of known cells; (0, 2) if there are none."""
        rows, columns = self.known_span
        if rows.stop == rows.start:
            return np.zeros((0, 2))
        return np.array([(x, y) for x in (columns.start, columns.stop) for y in (rows.start, rows.stop)], float)

    def _repr_html_(self) -> str:
        """Return the notebook view: a small picture from above, and facts."""
        from stereovox.maps.notebook import card, facts_of, floor_from_above

        known = self.states[self.known_span]
        number = np.bincount(known.ravel(), minlength=len(State))
        counts = {state.name.lower(): int(number[state]) for state in (State.FREE, State.TENTATIVE, State.OCCUPIED)}
        extent = np.array([(0, 0), known.shape[::-1]]) * self.resolution if known.size else None
        facts = facts_of((self.resolution,), counts, extent)
        return card(type(self).__name__, facts, *floor_from_above(known.shape, lambda: known))

    def indices(self, points: ArrayLike) -> NDArray[np.int64]:
        """Return the cells that contain points.

        Args:
            points: (N, 2) x, y in metres, map frame.

        Returns:
            Row and column (N, 2) int64; they may lie outside the picture.

        Raises:
            StereovoxError: `points` has another shape.
        """
        local = se2.transform(se2.inverse(self.origin), points_of(points, axes=2))
        return np.floor(local[:, ::-1] / self.resolution).astype(np.int64)

    def centres(self, rows: ArrayLike, columns: ArrayLike) -> NDArray[np.float64]:
        """Return the centres of cells.

        Args:
            rows: (N,)
            columns: (N,)

        Returns:
            (N, 2) x, y in metres, map frame.

        Raises:
            StereovoxError: Rows and columns differ in number, or have another shape.
        """
        if np.shape(rows) != np.shape(columns) or np.ndim(rows) > 1:
            raise shape_error("rows", rows, f"(N,), as many as columns, which are {np.shape(columns)}")
        local = (np.column_stack([columns, rows]) + 0.5) * self.resolution
        return se2.transform(self.origin, local)


class Percent:
    """Stored numbers as per cent, by `rules`.

    A cell keeps its state in per cent, at the cost of rounding. The most certain cells that the rules allow are 0 and
    100 per cent, because many programs accept nothing less as occupied.
    """

    def __init__(self, rules: CellRules):
        self._rules = rules
        self._format = rules.format
        self.lowest = int(np.iinfo(self._format.dtype).min)

    @cached_property
    def free_below(self) -> float:
        """Probability below which cells are free."""
        return self._probability(self._rules.free_below)

    @cached_property
    def occupied_above(self) -> float:
        """Probability above which cells are occupied."""
        return self._probability(self._rules.occupied_above)

    def _probability(self, stored: float) -> float:
        return round(float(1 / (1 + np.exp(-(stored - self._format.unknown) / self._format.per_log_odds))), 6)

    @cached_property
    def shown(self) -> NDArray[np.int8]:
        """Per cent of each storable number, from `lowest` on; -1 unknown."""
        stored = np.arange(self.lowest, np.iinfo(self._format.dtype).max + 1)
        states = self._rules.states(stored)
        free, occupied = 100 * self.free_below, 100 * self.occupied_above
        percent = np.rint(100 / (1 + np.exp(-self._format.log_odds(stored).astype(float))))
        percent[(stored <= self._rules.lowest) & (states == State.FREE)] = 0
        percent[(stored >= self._rules.highest) & (states == State.OCCUPIED)] = 100
        for state, least, most in (
            (State.FREE, 0, np.ceil(free) - 1),
            (State.TENTATIVE, np.ceil(free), np.floor(occupied)),
            (State.OCCUPIED, np.floor(occupied) + 1, 100),
        ):
            percent = np.where(states == state, np.clip(percent, least, most), percent)
        percent[states == State.UNKNOWN] = UNKNOWN
        return percent.astype(np.int8)

    def stored(self, percent: NDArray[np.int8]) -> NDArray[np.integer]:
        """Return the stored numbers of cells given in per cent; less than 0 is unknown."""
        p = np.clip(np.arange(128) / 100, 1e-12, 1 - 1e-12)
        known = np.clip(self._format.stored(np.log(p / (1 - p))), self._rules.lowest, self._rules.highest)
        unknown = self._format.unknown
        table = np.full(256, unknown, self._format.dtype)
        table[:128] = np.where(known == unknown, unknown + 1, known)
        return table[np.ascontiguousarray(percent).view(np.uint8)]
