# SPDX-License-Identifier: Apache-2.0
"""The box of cells a rolling map covers, and how it follows the camera (Chien 2020, 3.6)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil, exp, floor, hypot, isfinite
from typing import Any

from stereovox.config import Config

Cell = tuple[int, int, int]
Box = tuple[Cell, Cell]
"""Lowest cell, and the first cell beyond the highest, on each axis."""
GROWTH = 8
"""Step in cells by which the window grows and shrinks, so that jitter in speed does not resize it."""
SMOOTHING_S = 0.3
"""Time over which the camera's velocity is averaged."""
FURTHEST = 1 << 30
"""No cell is farther out."""
JUMP_MPS = 60.0
"""Nothing flies faster: the camera was carried, or its poses jumped; it then counts as standing still."""


class Window:
    """A box that moves by whole cells so that the camera stays within the trigger box around its centre, or stays
    fixed.

    The centre runs `lead_s` seconds of flight ahead of the camera, and the box is longer by `grow_s` seconds of flight
    along each axis, up to `largest`. A trigger box smaller than a cell counts as one cell: the centre cannot get nearer
    to the camera than half a cell, and would oscillate.
    """

    def __init__(self, config: Config):
        window, self._cell = config.window, config.cell
        assert window.size is not None
        self._trigger = max(window.trigger, max(self._cell) / 2)
        self._lead_s, self._grow_s = window.lead_s, window.grow_s
        self._fixed = window.centre
        self._size = size_in_cells(window.size, self._cell)
        self.largest = size_in_cells(window.largest or window.size, self._cell)
        self._extent = self._size
        self._velocity = (0.0, 0.0, 0.0)
        self._last: tuple[Sequence[float], int] | None = None
        self.box: Box | None = None

    def follow(self, position: Sequence[float], stamp_ns: int) -> Box:
        """Return the box (also as `box`) for a camera at `position` (3,) in metres at this time."""
        self._track(position, stamp_ns)
        self._extent = self._wanted_extent()
        centre = [self._centre(axis, position[axis]) for axis in range(3)]
        low = _three((c - n // 2 for c, n in zip(centre, self._extent, strict=True)), int)
        self.box = box = low, _three((a + n for a, n in zip(low, self._extent, strict=True)), int)
        return box

    @property
    def state(self) -> dict[str, Any] | None:
        """The state for `restore`, as plain numbers; None before the first frame."""
        if self.box is None or self._last is None:
            return None
        (position, stamp_ns), velocity = self._last, list(self._velocity)
        return {"box": [list(c) for c in self.box], "velocity": velocity, "position": position, "stamp_ns": stamp_ns}

    def restore(self, state: dict[str, Any]) -> None:
        """Continue where another run ended.

        Raises KeyError, TypeError, ValueError or OverflowError for an invalid `state`, and then changes nothing.
        """
        low, high = (_three(corner, int, FURTHEST) for corner in state["box"])
        extent = _three((b - a for a, b in zip(low, high, strict=True)), int)
        if any(n < least or n > most for n, least, most in zip(extent, self._size, self.largest, strict=True)):
            raise ValueError(f"a box of {extent} cells")
        velocity = _three(state["velocity"], float, JUMP_MPS)
        last = list(_three(state["position"], float)), int(state["stamp_ns"])
        self.box, self._extent, self._velocity, self._last = (low, high), extent, velocity, last

    def _track(self, position: Sequence[float], stamp_ns: int) -> None:
        last, self._last = self._last, (list(map(float, position)), stamp_ns)
        if last is None or stamp_ns <= last[1]:
            return
        seconds = (stamp_ns - last[1]) / 1e9
        now = [(b - a) / seconds for a, b in zip(last[0], self._last[0], strict=True)]
        if hypot(*now) > JUMP_MPS:
            now = self._velocity = (0.0, 0.0, 0.0)
        share = 1 - exp(-seconds / SMOOTHING_S)
        self._velocity = _three((v + share * (n - v) for v, n in zip(self._velocity, now, strict=True)), float)

    def _wanted_extent(self) -> Cell:
        if not self._grow_s or self._fixed is not None:
            return self._size
        sizes = zip(self._size, self.largest, self._extent, self._velocity, self._cell, strict=True)
        return _three((self._grown(*numbers) for numbers in sizes), int)

    def _grown(self, least: int, most: int, now: int, velocity: float, cell: float) -> int:
        extra = abs(velocity) * self._grow_s / cell
        up, down = (least + GROWTH * ceil(extra / GROWTH), least + GROWTH * ceil((extra + GROWTH / 2) / GROWTH))
        return min(max(up, min(now, down)), most)

    def _centre(self, axis: int, camera: float) -> int:
        """Return the middle cell face of the box on one axis: moved by whole cells, no further than needed."""
        cell = self._cell[axis]
        if self._fixed is not None:
            return round(self._fixed[axis] / cell)
        reach = self._extent[axis] * cell / 2
        lead = self._velocity[axis] * self._lead_s
        limit = max(reach - self._trigger - cell, 0.0)
        wanted = camera + min(max(lead, -limit), limit)
        if self.box is None:
            return round(wanted / cell)
        now = (self.box[0][axis] + self.box[1][axis]) // 2
        off = wanted - now * cell
        if abs(off) <= self._trigger:
            return now
        cells = ceil((abs(off) - self._trigger) / cell - 1e-9)
        return now + (cells if off > 0 else -cells)


def without(box: Box, other: Box) -> Iterator[Box]:
    """Yield at most six disjoint boxes that cover the part of `box` outside `other`."""
    low, high = list(box[0]), list(box[1])
    for axis in range(3):
        start, end = max(other[0][axis], low[axis]), min(other[1][axis], high[axis])
        if start >= end:
            yield _three(low, int), _three(high, int)
            return
        for a, b in ((low[axis], start), (end, high[axis])):
            if a < b:
                piece_low, piece_high = low.copy(), high.copy()
                piece_low[axis], piece_high[axis] = a, b
                yield _three(piece_low, int), _three(piece_high, int)
        low[axis], high[axis] = start, end


def coarser(box: Box, cells: int) -> Box:
    """Return the box of larger cells (`cells` along each side) that `box` touches."""
    low, high = box
    return _three((a // cells for a in low), int), _three((-(-b // cells) for b in high), int)


def most_touched(extent: Cell, cells: int) -> int:
    """Return how many larger cells (`cells` along each side) a box of this extent touches at most, at any position."""
    number = 1
    for n in extent:
        number *= (n - 2) // cells + 2 if n > 1 else 1
    return number


def _three(numbers: Any, kind: Any, most: float = 1e300) -> tuple[Any, Any, Any]:
    """Return three finite numbers of this kind within +-most."""
    x, y, z = (kind(number) for number in numbers)
    if not all(isfinite(number) and abs(number) <= most for number in (x, y, z)):
        raise ValueError(f"{list(numbers)} is invalid")
    return x, y, z


def size_in_cells(size: Sequence[float], cell: Sequence[float]) -> Cell:
    """Return the length in cells of a box of this size in metres on each axis, at least one."""
    return _three((max(1, floor(x / c + 0.5)) for x, c in zip(size, cell, strict=True)), int)
