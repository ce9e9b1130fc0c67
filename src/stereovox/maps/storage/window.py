# SPDX-License-Identifier: Apache-2.0
"""The box of cells a rolling map covers, and how it follows the camera (Chien 2020, 3.6).

Memory limits: how many blocks fit, and how large the window may be.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import ceil, exp, floor, hypot, isfinite
from typing import Any

from stereovox.config import Config
from stereovox.config.maps import MAX_WINDOW
from stereovox.errors import ConfigError
from stereovox.maps.cells.cell_format import FORMATS
from stereovox.maps.storage.blocks import CELLS, SIDE, table_size
from stereovox.maps.storage.tiles import TILE, WAITING

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


MAX_BYTES = 8_000_000_000
"""A window that needs more memory is treated as a mistake, unless `max_memory` allows it."""
MAX_FORMATTED = 10**24
"""Larger numbers of bytes are shown as this one: an integer may exceed any float."""
UNITS = (1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")
MAX_BLOCKS = 1 << 29
"""Places of blocks take 32 bits, with blocks that have numbers before those without."""
COORDS = 3 * 4
"""Bytes of a block's coordinates."""


def pool_bytes(config: Config, blocks: int) -> int:
    """Return the bytes of a pool with room for `blocks` blocks, with numbers or without, and of their times."""
    cells = blocks * (CELLS * FORMATS[config.map.cell].dtype.itemsize + 2 * COORDS) + 4 * table_size(2 * blocks)
    return cells + (blocks * (4 * CELLS + COORDS) + 4 * table_size(blocks) if config.map.keep_times else 0)


def most_blocks(config: Config) -> int:
    """Return how many blocks fit into `max_memory`. Raises ConfigError if none does."""
    allowed = int(config.max_memory or 0)
    most = _largest(lambda blocks: pool_bytes(config, blocks) <= allowed, MAX_BLOCKS)
    if not most:
        raise ConfigError(f"max_memory {allowed}: not one block of cells fits; allow more")
    return most


def window_blocks(config: Config) -> int:
    """Return the most blocks the window touches, including those of its disk tiles next to it."""
    assert config.window.size is not None
    unit = TILE if config.window.outside == "keep" else SIDE
    return (
        most_touched(size_in_cells(config.window.largest or config.window.size, config.cell), unit)
        * (unit // SIDE) ** 3
    )


def within_memory(config: Config) -> Config:
    """Return the settings with the window that `max_memory` and `when_full` imply; unchanged if there is none.

    If no window is given, it is the largest that fits, about half as high as wide. Raises ConfigError, one line with
    the cure, for one that does not fit, or if not even the view fits: that of a camera at the border of the trigger
    box, `max_range` to all sides and half as far up and down.
    """
    allowed = int(config.max_memory or 0)
    if not allowed or (config.window.size is None and config.when_full == "refuse"):
        _check(config, MAX_BYTES, "choose a smaller window.size or larger cells")
        return config
    if config.when_full != "refuse":
        config = _with_window(config, outside="keep" if config.when_full == "spill" else "drop")
    if config.window.size is None:
        config = _as_wide(config, _widest(config))
    _check(config, allowed, "allow more max_memory, or choose a smaller window.size or larger cells")
    return config


def format_bytes(number_of_bytes: float) -> str:
    """Return a number of bytes as text."""
    number = float(min(number_of_bytes, MAX_FORMATTED))
    size, unit = next(((size, unit) for size, unit in UNITS if number >= size), (1.0, "bytes"))
    return f"{number / size:.0f} {unit}" if number >= 10 * size else f"{number / size:.2g} {unit}"


def _format_at_least(number_of_bytes: int) -> str:
    """Return at least this number of bytes as text, so that setting the printed value suffices."""
    number = min(number_of_bytes, int(MAX_FORMATTED))
    size, unit = next(((int(size), unit) for size, unit in UNITS if number >= size), (1, "bytes"))
    part = 1 if number >= 10 * size or size == 1 else 10
    return f"{-(-number * part // size) / part:g} {unit}"


def _widest(config: Config) -> float:
    """Return the width in metres of the largest window that fits."""
    least = 2 * (config.max_range + config.window.trigger) + config.voxel_size
    step = SIDE * config.voxel_size
    fits = lambda n: _window_bytes(_as_wide(config, n * step)) <= (config.max_memory or 0)  # noqa: E731
    width = step * _largest(fits, int(MAX_WINDOW / step))
    if width < least:
        needed = _window_bytes(_as_wide(config, step * -(-least // step)))
        raise ConfigError(
            f"max_memory {format_bytes(config.max_memory or 0)}: "
            f"a window that covers the view needs {_format_at_least(needed)}; "
            "allow more, or set a smaller max_range or larger cells"
        )
    return width


def _as_wide(config: Config, width: float) -> Config:
    """Return the settings with a window of this width, and half as high, plus the margin of the trigger box."""
    up = "xyz".index(config.up[-1])
    size = tuple(width / 2 + config.window.trigger if axis == up else width for axis in range(3))
    return _with_window(config, size=size, largest=None)


def _with_window(config: Config, **changes: Any) -> Config:
    return config.model_copy(update={"window": config.window.model_copy(update=changes)})


def _window_bytes(config: Config) -> int:
    waiting = 0
    if config.window.outside == "keep":
        of_cell = FORMATS[config.map.cell].dtype.itemsize + (4 if config.map.keep_times else 0)
        waiting = WAITING * TILE**3 * of_cell
    return pool_bytes(config, window_blocks(config)) + waiting


def _check(config: Config, most: int, cure: str) -> None:
    if config.window.size is None:
        return
    needed = _window_bytes(config)
    if needed > most:
        size = " x ".join(f"{x:g}" for x in config.window.largest or config.window.size)
        raise ConfigError(
            f"window of {size} m in cells of {config.voxel_size:g} m needs {format_bytes(needed)} of memory, "
            f"more than {format_bytes(most)}; {cure}"
        )


def _largest(fits: Callable[[int], bool], most: int) -> int:
    """Return the largest number up to `most` that fits, given that smaller ones do; 0 if none does."""
    low, high = 0, most
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low
