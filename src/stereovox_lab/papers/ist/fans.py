# SPDX-License-Identifier: Apache-2.0
"""Synthetic beams into an empty grid, and the cells they mark (IST 2019, IV-A and Fig 3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config, load_config
from stereovox.evaluate.metrics import percentiles
from stereovox.frame import Scan
from stereovox.mapper import GridMapper
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import State

FIELD_DEG = 57.0
"""Horizontal field of view of the Kinect (III-C)."""
MANY, DISTANCE = 700, 3.0
"""Beams of the first simulation, and their common distance in metres (not given in the report)."""
FEW = (1.2, 2.6, 3.4, 1.8, 4.4, 3.0, 2.2, 4.0, 1.5, 2.9)
"""Distances in metres of the second one's beams (not given in the report)."""
UPDATES = 60
"""Number of equal scans; one alone leaves a free cell at 0.4, which is not yet called free."""


@dataclass(frozen=True, eq=False)
class Fan:
    """The map that beams make from an empty one.

    right: share of places along all beams (before the object and in it) with a cell of the right state at most one cell
    away: a line in a grid deviates from the beam by that much.
    free, occupied: cells; expected_free, expected_occupied: from the areas of sector and ring, the ring a cell
    wider than the thickness, because both its ends are drawn (None: few beams).
    beyond: known cells that no beam reaches. ms: of one update.
    """

    scan: Scan
    grid: OccupancyGrid
    right: float
    free: int
    occupied: int
    expected_free: float | None
    expected_occupied: float | None
    beyond: int
    ms: dict[str, float]


def simulate(distances: ArrayLike, step: Callable[[], None] = lambda: None) -> Fan:
    """Return the map from beams of these lengths (N,), evenly spread over the Kinect's field of view."""
    config, scan = load_config("ist2019"), _scan(np.asarray(distances, np.float32))
    mapper = GridMapper(config)
    reports = [mapper.add(scan) for _ in range(UPDATES)]
    grid = mapper.occupancy()
    step()
    states = grid.states
    sector = float(np.radians(FIELD_DEG)) / 2 / config.voxel_size**2
    alike, r, deep = len(set(scan.ranges.tolist())) == 1, float(scan.ranges[0]), config.grid.thickness
    return Fan(
        scan,
        grid,
        right=_right(mapper, scan, config),
        free=int((states == State.FREE).sum()),
        occupied=int((states == State.OCCUPIED).sum()),
        expected_free=sector * r**2 if alike else None,
        expected_occupied=sector * ((r + deep + config.voxel_size) ** 2 - r**2) if alike else None,
        beyond=_beyond(grid, scan, config),
        ms=percentiles([one.depth_ms + one.integrate_ms for one in reports]),
    )


def _scan(distances: NDArray[np.float32]) -> Scan:
    field = float(np.radians(FIELD_DEG))
    return Scan(distances, -field / 2, field / (len(distances) - 1), 0.8, 5.0, np.eye(4))


def _right(mapper: GridMapper, scan: Scan, config: Config) -> float:
    """Return `Fan.right`; places within a cell's side of the measurement's end are left out."""
    directions, size, right = np.column_stack([np.cos(scan.angles), np.sin(scan.angles)]), config.voxel_size, []
    for direction, r in zip(directions, scan.ranges.astype(float), strict=True):
        before = np.arange(size, r - size, size / 2)[:, None] * direction
        within = np.arange(r + size, r + config.grid.thickness - size, size / 2)[:, None] * direction
        right += [_has_state(mapper, before, State.FREE), _has_state(mapper, within, State.OCCUPIED)]
    return float(np.concatenate(right).mean())


def _has_state(mapper: GridMapper, points: NDArray[np.float64], state: State) -> NDArray[np.bool_]:
    """Return which points (N, 2) have a cell of this state at most one cell away."""
    size = mapper.map.voxel_size
    around = [points + np.array([x, y]) * size for x in (-1, 0, 1) for y in (-1, 0, 1)]
    return np.any([mapper.map.state(one) == state for one in around], axis=0)


def _beyond(grid: OccupancyGrid, scan: Scan, config: Config) -> int:
    """Return the number of known cells beyond the longest beam and its object."""
    rows, columns = np.nonzero(grid.cells >= 0)
    away = np.linalg.norm(grid.centres(rows, columns), axis=1)
    return int((away > scan.ranges.max() + config.grid.thickness + config.voxel_size).sum())
