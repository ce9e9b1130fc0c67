# SPDX-License-Identifier: Apache-2.0
"""The notebook view of a map: a small picture from above and a few facts, as self-contained HTML.

It takes arrays, so that voxel maps, grids and mappers can all call it. It is fast: a few passes over the cells and no
matplotlib, which `view/` uses for saved pictures.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.maps.cells.cell_format import State
from stereovox.maps.record.history import History
from stereovox.maps.storage.blocks import SIDE
from stereovox.maps.storage.window import format_bytes
from stereovox.maps.upright import ceiling, turned, turned_cells

SIZE_PX = 400
"""Longest side of a picture; smaller maps are enlarged by a whole factor."""
MAX_PNG = 100_000
"""Most bytes of a picture; a larger one is halved."""
MAX_FLOOR = 2**26
"""Most cells of a floor's rectangle that are drawn: 64 MB."""
EMPTY = "This map is empty: no cell is known yet."
MAX_REASONS = 4
"""Most reasons of refusals that are named."""
RELIEF = 0.3
"""Largest share by which a step in height brightens or darkens a pixel."""
_HEIGHTS = np.array([[105, 70, 130], [95, 115, 165], [75, 165, 160], [130, 210, 125], [253, 236, 85]], float)
"""Colours of heights from low to high, evenly spaced: viridis, paler, so that light and shade show."""
_STATES = np.array([[0, 0, 0, 0], [226, 224, 212, 255], [232, 163, 61, 255], [34, 48, 74, 255]], np.uint8)
"""RGBA of unknown (transparent), free, tentative and occupied."""
_UNKNOWN_FLOOR = np.array([128, 134, 145, 110], np.uint8)
"""RGBA of unknown cells of a floor, whose walls must be visible on white and black pages."""
_PATH = (224, 69, 47, 255)

Blocks = tuple[NDArray[np.int32], NDArray[np.integer]]


@dataclass(frozen=True, eq=False)
class Raster:
    """Mapping from cells to pixels: `low`, the lowest column and row; `step` cells a pixel; columns and rows of pixels.

    Row 0 is the lowest: a picture is flipped before it is shown.
    """

    low: NDArray[np.int64]
    step: int
    shape: tuple[int, int]

    @classmethod
    def of(cls, low: ArrayLike, high: ArrayLike) -> Raster:
        """Return the pixels of cells from `low` (2,) to `high` (2,), both included."""
        low = np.asarray(low, np.int64)
        size = np.asarray(high, np.int64) - low + 1
        step = -(-int(size.max()) // SIZE_PX)
        columns, rows = (-(-size // step)).tolist()
        return cls(low, step, (rows, columns))

    def places(self, cells: NDArray[np.integer]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return row and column in a picture of the pixels of cells (N, 2)."""
        column, row = ((cells - self.low) // self.step).T
        return row, column


def card(title: str, facts: Mapping[str, str], image: NDArray[np.uint8] | None, caption: str) -> str:
    """Return HTML: facts by name, next to an image (rows, columns, 4) RGBA, if there is one, with a caption.

    All text is escaped: names of recordings and reasons may come from a file.
    """
    rows = "".join(
        f'<tr><td style="text-align:left;opacity:.65;padding:1px 12px 1px 0">{escape(name)}</td>'
        f'<td style="text-align:left;padding:1px 0">{escape(text)}</td></tr>'
        for name, text in facts.items()
    )
    table = f'<table style="border-collapse:collapse;margin:4px 0;background:none;font:inherit">{rows}</table>'
    note = f'<div style="opacity:.65;max-width:26em">{escape(caption)}</div>'
    words = f'<div style="flex:1 1 22em"><b>{escape(title)}</b>{table}{note}</div>'
    style = "display:flex;flex-wrap:wrap;gap:18px;align-items:flex-start;font:13px/1.45 system-ui,sans-serif"
    return f'<div style="{style}">{_picture(image, title)}{words}</div>'


def facts_of(
    cell: Iterable[float],
    counts: Mapping[str, int],
    bounds: NDArray[np.floating] | None,
    memory_bytes: int | None = None,
    history: History | None = None,
) -> dict[str, str]:
    """Return the facts of a map by name.

    cell: sides in metres. counts: cells by state. bounds: lowest and highest corner in metres, None for an empty map.
    """
    facts = {
        "cell size": f"{' x '.join(f'{side:g}' for side in cell)} m",
        "cells": ", ".join(f"{number:,} {state}" for state, number in counts.items()),
    }
    if bounds is not None:
        facts["extent"] = f"{' x '.join(f'{size:.2f}' for size in bounds[1] - bounds[0])} m"
    if history is not None:
        facts |= _facts_of_frames(history)
    if memory_bytes is not None:
        facts["memory"] = format_bytes(memory_bytes)
    return facts


def _facts_of_frames(history: History) -> dict[str, str]:
    refused = history.refused.most_common()
    reasons = ", ".join(f"{number:,} {reason}" for reason, number in refused[:MAX_REASONS])
    more = f" and {len(refused) - MAX_REASONS} more reasons" if len(refused) > MAX_REASONS else ""
    facts = {
        "frames": f"{history.frames:,}",
        "refused": f"{history.refused.total():,}: {reasons}{more}" if refused else "none",
    }
    return facts | ({"recording": history.recording} if history.recording else {})


def voxels_from_above(
    blocks: Iterable[Blocks],
    states: Callable[[NDArray[np.integer]], NDArray[np.uint8]],
    cell: Iterable[float],
    up: str,
    history: History,
) -> tuple[NDArray[np.uint8] | None, str]:
    """Return the picture (rows, columns, 4) RGBA of a voxel map from above, or None for an empty one, and its caption.

    blocks: coordinates (n, 3) and cells (n, 512) as stored, which `states` converts to `State`. cell: sides in metres
    along x, y and z. up: the axis of the map that points up.
    """
    up = up.removeprefix("+")
    occupied, columns, free = _surfaces(blocks, states, up)
    if not len(columns):
        return None, EMPTY
    side = np.abs(turned(np.array(list(cell)), up))
    cut = ceiling(occupied)
    shown = occupied[occupied[:, 2] < cut]
    raster = Raster.of(columns.min(axis=0), columns.max(axis=0))
    seen = _highest(raster, columns, free.astype(float), -1.0).astype(int)
    image = _STATES[np.array([State.TENTATIVE, State.FREE, State.UNKNOWN])[seen]]
    words = f"From above ({up} is up). Pale: free; orange: tentative"
    if len(shown):
        height = _highest(raster, shown[:, :2], shown[:, 2].astype(float), np.nan)
        image = np.where(np.isfinite(height)[..., None], _relief(height), image)
        low, high = (shown[:, 2].min() * side[2], (shown[:, 2].max() + 1) * side[2])
        words = f"From above ({up} is up). Occupied: dark at {low:.2f} m to yellow at {high:.2f} m; pale: free"
    words += "; cut open below the ceiling" if len(shown) < len(occupied) else ""
    paths = [turned(history.path.poses(name)[:, :3, 3], up)[:, :2] / side[:2] for name in history.path.stops]
    words += "; red line: path of the sensor" if any(len(path) > 1 for path in paths) else ""
    return _with_paths(image, raster, paths), words + "."


def floor_from_above(
    size: Sequence[int] | NDArray[np.integer], states: Callable[[], NDArray[np.uint8]]
) -> tuple[NDArray[np.uint8] | None, str]:
    """Return the picture (rows, columns, 4) RGBA of a floor, or None for an empty one, and its caption.

    size: rows and columns. states: returns `State` (rows, columns), row 0 the lowest; a pixel of several cells shows
    the most important one.
    """
    rows, columns = (int(n) for n in size)
    if not rows * columns:
        return None, EMPTY
    if rows * columns > MAX_FLOOR:
        return None, "Too large for a quick picture."
    raster, image = Raster.of((0, 0), (columns - 1, rows - 1)), states()
    for axis, length in enumerate((rows, columns)):
        image = np.maximum.reduceat(image, np.arange(0, length, raster.step), axis=axis)
    colours = np.concatenate([[_UNKNOWN_FLOOR], _STATES[1:]])
    return _with_paths(colours[image], raster, ()), "Dark: occupied; pale: free; orange: tentative; grey: unknown."


def _surfaces(
    blocks: Iterable[Blocks], states: Callable[[NDArray[np.integer]], NDArray[np.uint8]], up: str
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.bool_]]:
    """Return occupied cells (N, 3) and known columns (M, 2), turned upright, and which columns have a free cell.

    A column may occur several times.
    """
    occupied, columns, free = [np.zeros((0, 3), np.int32)], [np.zeros((0, 3), np.int32)], [np.zeros(0, bool)]
    axis = 1 + "xyz".index(up[-1])
    for coords, values in blocks:
        found = states(values).reshape(-1, SIDE, SIDE, SIDE)
        block, *low = np.nonzero(found == State.OCCUPIED)
        occupied.append(coords[block] * SIDE + np.stack(low, axis=1).astype(np.int32))
        known = found.any(axis=axis, keepdims=True)
        block, *low = np.nonzero(known)
        columns.append(coords[block] * SIDE + np.stack(low, axis=1).astype(np.int32))
        free.append((found == State.FREE).any(axis=axis, keepdims=True)[known])
    solid, seen = (turned_cells(np.concatenate(cells), up) for cells in (occupied, columns))
    return solid, seen[:, :2], np.concatenate(free)


def _highest(
    raster: Raster, cells: NDArray[np.integer], values: NDArray[np.float64], empty: float
) -> NDArray[np.float64]:
    """Return the highest of the values (N,) of the cells (N, 2) in each pixel, `empty` if there is none."""
    order = np.argsort(values, kind="stable")
    image = np.full(raster.shape, empty)
    image[raster.places(cells[order])] = values[order]  # of equal places the last, the highest, wins
    return image


def _relief(height: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return heights (rows, columns) in cells as RGBA, lit from the left and above; NaN is left undefined."""
    low, high = np.nanmin(height), np.nanmax(height)
    share = (np.nan_to_num(height, nan=low) - low) / max(high - low, 1.0) * (len(_HEIGHTS) - 1)
    colours = np.stack([np.interp(share, np.arange(len(_HEIGHTS)), band) for band in _HEIGHTS.T], axis=-1)
    ground = np.pad(np.nan_to_num(height, nan=low), 1, mode="edge")
    rise = (ground[1:-1, 1:-1] - ground[1:-1, :-2]) + (ground[1:-1, 1:-1] - ground[2:, 1:-1])
    lit = np.clip(colours * (1 + RELIEF * np.tanh(rise / 4))[..., None], 0, 255)
    return np.concatenate([lit, np.full((*height.shape, 1), 255.0)], axis=-1).astype(np.uint8)


def _with_paths(image: NDArray[np.uint8], raster: Raster, paths: Iterable[NDArray[np.floating]]) -> NDArray[np.uint8]:
    """Return a picture enlarged, with paths (N, 2) in cells drawn into it, and its highest row first."""
    from PIL import Image, ImageDraw

    times = max(1, SIZE_PX // max(raster.shape))
    image = image.repeat(times, axis=0).repeat(times, axis=1)[::-1]
    picture = Image.fromarray(np.ascontiguousarray(image))
    draw = ImageDraw.Draw(picture)
    for path in paths:
        flat = (np.asarray(path, float) - raster.low) * (times / raster.step)
        flat = np.clip(flat * [1, -1] + [0, len(image)], -4 * SIZE_PX, 4 * SIZE_PX)
        draw.line([(float(x), float(y)) for x, y in flat], fill=_PATH, width=2, joint="curve")
    return np.asarray(picture)


def _picture(image: NDArray[np.uint8] | None, title: str) -> str:
    if image is None:
        return ""
    from PIL import Image

    rows, columns = image.shape[:2]
    while True:
        file = io.BytesIO()
        Image.fromarray(np.ascontiguousarray(image)).save(file, "PNG")
        if file.tell() <= MAX_PNG:
            break
        image = image[::2, ::2]
    data = base64.b64encode(file.getvalue()).decode("ascii")
    style = "image-rendering:pixelated;max-width:100%;border:1px solid rgba(128,128,128,.35);border-radius:3px"
    return (
        f'<img alt="{escape(title)}, from above" width="{columns}" height="{rows}" style="{style}" '
        f'src="data:image/png;base64,{data}">'
    )
