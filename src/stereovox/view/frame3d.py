# SPDX-License-Identifier: Apache-2.0
"""A box with numbered edges round what is drawn in parallel projection: equal axes that can be read off."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.view.panels import GREY, LINE, round_length
from stereovox.view.render import Direction

Numbers = tuple[str, NDArray[np.float64], NDArray[np.float64]]
"""Label of an edge, where its ticks stand in metres, and the numbers written there."""


def numbers(label: str, low: float, high: float, least_m: float = 1e-6) -> Numbers:
    """Return round numbers between `low` and `high`, about `least_m` or more apart, for the edge `label`."""
    step = round_length(max((high - low) / 4, least_m))
    at = np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step + 0.0  # no "-0"
    return label, at, at


def draw_frame(
    axis: Any, direction: Direction, low: ArrayLike, high: ArrayLike, edges: tuple[Numbers, Numbers, Numbers]
) -> None:
    """Draw floor and edges of the box from `low` to `high` (3,) in metres, below all else, and number three edges."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    front = np.where(direction.toward > 0, high, low)
    back = np.where(direction.toward > 0, low, high)
    floor = np.array([low[:2], [high[0], low[1]], high[:2], [low[0], high[1]]])
    corners = np.column_stack([floor, np.full(4, low[2])])
    room = 0.04 * float((high - low).max())
    axis.fill(*direction.flat(corners).T, facecolor="#f3f4f6", edgecolor=LINE, linewidth=0.8, zorder=0)
    for n, across in ((0, 1), (1, 0)):
        for at in edges[n][1]:
            line = np.array([low, low])
            line[:, n], line[0, across], line[1, across] = at, low[across], high[across]
            axis.plot(*direction.flat(line).T, color="#dfe2e7", linewidth=0.7, zorder=0)
        start = np.array([front[0], front[1], low[2]])
        _edge(axis, direction, n, start, _inner(edges[n], low[n], high[n], room), np.array([*(front - back)[:2], 0.0]))
    left = corners[np.argmin(direction.flat(corners)[:, 0])]
    _edge(axis, direction, 2, left, edges[2], -direction.right * np.ptp([low, high], axis=0).max())
    axis.plot(*direction.flat(np.array([left, [*left[:2], high[2]]])).T, color=LINE, linewidth=0.8, zorder=0)


def fit(axis: Any, direction: Direction, low: ArrayLike, high: ArrayLike, margin: float = 0.09) -> float:
    """Show the whole box with room for its numbers, without axes; return height divided by width."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    flat = direction.flat(corners)
    size = np.ptp(flat, axis=0)
    space = margin * size.max()
    (left, bottom), (right, top) = flat.min(0) - space, flat.max(0) + np.array([space, 0.15 * space])
    axis.set(xlim=(left, right), ylim=(bottom, top), aspect="equal")
    axis.set_axis_off()
    return float((top - bottom) / (right - left))


def _inner(edge: Numbers, low: float, high: float, room: float) -> Numbers:
    """Return an edge without the numbers at its ends, where those of its neighbours stand."""
    label, places, values = edge
    kept = (places >= low + room) & (places <= high - room)
    return label, places[kept], values[kept]


def _edge(
    axis: Any, direction: Direction, n: int, start: NDArray[np.float64], edge: Numbers, outward: NDArray[np.float64]
) -> None:
    label, places, values = edge
    away = direction.flat(_without(outward, n)[None])[0]
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    points = np.repeat(start[None], len(places), axis=0)
    points[:, n] = places
    for (x, y), value in zip(direction.flat(points), values, strict=True):
        _text(axis, (x, y), f"{value:g}", 11 * away, 9)
    middle = np.array(points.mean(0) if len(points) else start)
    _text(axis, tuple(direction.flat(middle[None])[0]), label, 44 * away, 10.5, 90 if n == 2 else 0)


def _without(vector: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    rest = vector.copy()
    rest[n] = 0
    return rest


def _text(
    axis: Any, at: tuple[float, float], text: str, offset: NDArray[np.float64], size: float, turn: float = 0
) -> None:
    axis.annotate(text, at, xytext=tuple(offset), textcoords="offset points", ha="center", va="center",
                  fontsize=size, color=GREY, rotation=turn, annotation_clip=False)  # fmt: skip
