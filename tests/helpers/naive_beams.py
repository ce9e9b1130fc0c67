# SPDX-License-Identifier: Apache-2.0
"""Slow, obvious twin of `beams` in exact fractions: what one scan says about a floor, cell by cell.

It shares no code with the kernels; tests compare them with it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from fractions import Fraction
from itertools import pairwise
from math import ceil, floor, isfinite, log

import numpy as np
from numpy.typing import ArrayLike

from stereovox.config import Config
from stereovox.frame import Scan

Cell = tuple[int, int]
Place = tuple[Fraction, Fraction]


def scan_cells(scan: Scan, config: Config, origin: ArrayLike = (0.0, 0.0, 0.0)) -> dict[Cell, int]:
    """Return thousandths of log-odds by cell (column, row), as `Beams.evidence` has them."""
    line = {"exact": touched, "bresenham": drawn}[config.grid.traversal]
    passes, hits = Counter[Cell](), Counter[Cell]()
    for start, free, hit, behind in _beams(scan, config, origin):
        occupied = line(hit, behind) if hit and behind else []
        passed = set(line(start, free)) if free else set()
        passes.update(passed - {_cell(hit)} if hit else passed)
        hits.update(set(occupied))
    free, occupied = (round(1000 * log(p / (1 - p))) for p in (config.grid.p_free, config.grid.p_occupied))
    if config.grid.update == "once":
        return {cell: occupied if cell in hits else free for cell in passes | hits}
    sums = {cell: passes[cell] * free + hits[cell] * occupied for cell in passes | hits}
    return {cell: evidence for cell, evidence in sums.items() if evidence}


def scan_beams(scan: Scan, config: Config, origin: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Return from where to where each beam clears, and where it hits, (N, 6) in cells, as `GridEvidence.ends`."""
    rows = []
    for start, free, hit, _ in _beams(scan, config, origin):
        places = (start if free else None, free, hit)
        rows.append([float(x) for place in places for x in (place or (np.nan, np.nan))])
    return np.array(rows)


def touched(start: Place, end: Place) -> list[Cell]:
    """Return the cells a line from `start` to `end` touches: cut it at all grid lines, take each part's middle."""
    cuts = {Fraction(0), Fraction(1)}
    for a, b in zip(start, end, strict=True):
        if a != b:
            cuts |= {(edge - a) / (b - a) for edge in range(ceil(min(a, b)), floor(max(a, b)) + 1)}
    shares = sorted(cuts)
    middles = [(t0 + t1) / 2 for t0, t1 in pairwise(shares)]
    return [_cell((start[0] + t * (end[0] - start[0]), start[1] + t * (end[1] - start[1]))) for t in [0, *middles, 1]]


def drawn(start: Place, end: Place) -> list[Cell]:
    """Return the cells of Bresenham's line: the nearest along its longer axis; of two, that of the step before."""
    (x0, y0), (x1, y1) = _cell(start), _cell(end)
    steps = max(abs(x1 - x0), abs(y1 - y0))
    cells = []
    for k in range(steps + 1):
        across, up = (Fraction(k * abs(d), max(steps, 1)) for d in (x1 - x0, y1 - y0))
        across, up = ceil(across - Fraction(1, 2)), ceil(up - Fraction(1, 2))
        cells.append((x0 + (across if x1 >= x0 else -across), y0 + (up if y1 >= y0 else -up)))
    return cells


def _beams(
    scan: Scan, config: Config, origin: ArrayLike
) -> Iterator[tuple[Place, Place | None, Place | None, Place | None]]:
    """Yield each beam's start, how far it is free, where it hits, and `thickness` behind that; None for nothing."""
    x, y, yaw = np.asarray(origin, float)
    T = np.eye(4)
    T[:2, :2], T[:2, 3] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]], (x, y)
    T_grid_sensor = np.linalg.inv(T) @ scan.T_world_sensor
    nearest = np.float32(scan.range_min)
    reach = np.float32(min(scan.range_max, config.max_range))
    for i, measured in enumerate(np.asarray(scan.ranges, np.float32)):
        angle = scan.angle_min + i * scan.angle_step
        along = T_grid_sensor[:3, :3] @ [np.cos(angle), np.sin(angle), 0]

        def place(length: float, along: np.ndarray = along) -> Place:
            x, y = (T_grid_sensor[:2, 3] + float(length) * along[:2]) / config.voxel_size
            return Fraction(round(float(x) * 2**20), 2**20), Fraction(round(float(y) * 2**20), 2**20)

        is_hit = isfinite(measured) and measured > 0 and nearest <= measured <= reach
        beyond = measured == np.inf or reach < measured <= np.float32(scan.range_max)
        free_to = measured if is_hit else reach if beyond else 0
        if scan.clear is not None:
            free_to = min(scan.clear[i], measured if is_hit else reach) if scan.clear[i] > 0 else 0
        hit = place(measured) if is_hit else None
        behind = place(float(measured) + config.grid.thickness) if is_hit else None
        since = 0.0 if scan.clear_from is None else float(scan.clear_from[i])
        free_to = free_to if since < free_to else 0
        yield place(max(since, 0.0)), place(float(free_to)) if free_to > 0 else None, hit, behind


def _cell(place: Place) -> Cell:
    return floor(place[0]), floor(place[1])
