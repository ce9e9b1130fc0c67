# SPDX-License-Identifier: Apache-2.0
"""Furniture of simulated floors, where a slice at one height is not what a robot bumps into."""

from __future__ import annotations

from stereovox.sources.floor_plan import Thing, block


def table(name: str, x: float, y: float, size: tuple[float, float] = (1.6, 0.8), turn_deg: float = 0.0) -> list[Thing]:
    """Return a table with its middle at (x, y): four thin legs, and a top that a low lidar does not see."""
    half_x, half_y = size[0] / 2, size[1] / 2
    about = (x, y)
    top = block("tables", f"{name}: top", _round(x, y, half_x, half_y), (0.70, 0.74), turn_deg, about)
    legs = [
        block("tables", f"{name}: leg {n}", _round(x + a, y + b, 0.025, 0.025), (0.0, 0.70), turn_deg, about)
        for n, (a, b) in enumerate(_four(half_x - 0.05, half_y - 0.05), 1)
    ]
    return [top, *legs]


def chair(name: str, x: float, y: float, turn_deg: float = 0.0) -> list[Thing]:
    """Return a chair with its middle at (x, y), whose sitter looks along x turned by `turn_deg`."""
    about = (x, y)
    seat = block("chairs", f"{name}: seat", _round(x, y, 0.21, 0.21), (0.43, 0.47), turn_deg, about)
    back = block("chairs", f"{name}: back", (x - 0.21, y - 0.2, x - 0.18, y + 0.2), (0.47, 0.88), turn_deg, about)
    legs = [
        block("chairs", f"{name}: leg {n}", _round(x + a, y + b, 0.018, 0.018), (0.0, 0.43), turn_deg, about)
        for n, (a, b) in enumerate(_four(0.18, 0.18), 1)
    ]
    return [seat, back, *legs]


def shelf(name: str, where: tuple[float, float, float, float]) -> list[Thing]:
    """Return a shelf on two sides, its lowest board 35 cm up: a lidar looks below it, the sides apart."""
    x0, y0, x1, y1 = where
    ends = ((x0, y0, x0 + 0.03, y1), (x1 - 0.03, y0, x1, y1))
    sides = [block("shelf", f"{name}: side {n}", end, (0.0, 1.9)) for n, end in enumerate(ends, 1)]
    boards = [
        block("shelf", f"{name}: board {n}", where, (z, z + 0.03)) for n, z in enumerate((0.35, 0.8, 1.25, 1.7), 1)
    ]
    return [*sides, *boards]


def _round(x: float, y: float, half_x: float, half_y: float) -> tuple[float, float, float, float]:
    return x - half_x, y - half_y, x + half_x, y + half_y


def _four(x: float, y: float) -> tuple[tuple[float, float], ...]:
    return (-x, -y), (x, -y), (x, y), (-x, y)
