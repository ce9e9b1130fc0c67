# SPDX-License-Identifier: Apache-2.0
"""Memory limits: how many blocks fit, and how large the window may be."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from stereovox.config import Config
from stereovox.config.maps import MAX_WINDOW
from stereovox.errors import ConfigError
from stereovox.maps.cells.cell_format import FORMATS
from stereovox.maps.storage.blocks import CELLS, SIDE, table_size
from stereovox.maps.storage.tiles import TILE, WAITING
from stereovox.maps.storage.window import most_touched, size_in_cells

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
