# SPDX-License-Identifier: Apache-2.0
"""Time to publish a map (IST 2019, IV-D: 15 s for 3000 x 3000 cells)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from stereovox.config import load_config
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.sources.bags.writer import BagWriter

SIDE = 3000
TIMES = 3


@dataclass(frozen=True)
class Published:
    """Median seconds of each part. picture: from the map's tiles to one array of per cent; message: from there to a
    `nav_msgs/OccupancyGrid` in a file, which costs more than passing it on.
    """

    side: int
    picture: float
    message: float


def time_publishing(side: int = SIDE, step: Callable[[], None] = lambda: None) -> Published:
    """Return the times for a map of `side` x `side` cells, a third each unknown, free and occupied."""
    cells = np.random.default_rng(0).choice(np.array([-1, 0, 100], np.int8), (side, side))
    grid_map = GridMap.from_occupancy(OccupancyGrid(cells, 0.02), load_config("ist2019"))
    grid_map.occupancy()
    times = []
    with TemporaryDirectory() as folder:
        for n in range(TIMES):
            times.append(_once(grid_map, Path(folder) / f"{n}.mcap"))
            step()
    picture, message = np.median(times, axis=0)
    return Published(side, float(picture), float(message))


def _once(grid_map: GridMap, path: Path) -> tuple[float, float]:
    with BagWriter(path, packed=False) as bag:
        start = perf_counter()
        grid = grid_map.occupancy()
        between = perf_counter()
        bag.occupancy(0, grid)
        return between - start, perf_counter() - between
