# SPDX-License-Identifier: Apache-2.0
"""Evidence of clouds: each ray is followed from the sensor's position at that time to its point.

The cells that the rays of a lidar scan cross, and the evidence of a scan on them: for points that form no image.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar, RangeSensor
from stereovox.config import Config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import CheckedCloud
from stereovox.integrate import _beams, _cells, _lanes, _points
from stereovox.integrate._lanes import LANES
from stereovox.integrate.ray import make_lanes, make_memory, merged
from stereovox.integrate.views import MAX_BLOCKS, KernelTable, PerCamera, origin_block, sensor_table
from stereovox.kernels.threads import in_shards
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import CELLS, SIDE, BlockPool, blocks_of_cells
from stereovox.sensors import make_sensor
from stereovox.sensors.protocol import InverseSensorModel

AT_ONCE = 1 << 22
"""Cells walked before duplicates are dropped."""
MAX_LENGTH = 1 << 20
"""Most cells along each axis from the sensor to the end of a ray."""


def crossed_cells(origin: NDArray[np.float64], ends: NDArray[np.float64], voxel_size: float) -> NDArray[np.int64]:
    """Return the cells (M, 3) that the rays from `origin` (3,) to `ends` (N, 3) cross, each once, in ascending order.

    Origin and ends are in metres. The cells of the ends are included.
    Raises StereovoxError for a ray of more than `MAX_LENGTH` cells.
    """
    start, stop = np.asarray(origin, np.float64) / voxel_size, np.asarray(ends, np.float64).reshape(-1, 3) / voxel_size
    base = np.floor(start).astype(np.int64)
    apart = np.abs(np.floor(stop) - base)
    if len(stop) and not apart.max() < MAX_LENGTH:
        raise StereovoxError(f"a ray of {apart.max() * voxel_size:g} m spans too many cells; use larger cells")
    steps = apart.sum(axis=1).astype(np.int64)
    found = [_packed(np.floor(stop).astype(np.int64) - base)]
    for part in _pieces(steps):
        first = np.cumsum(steps[part] + 1) - steps[part] - 1
        cells = np.empty((int((steps[part] + 1).sum()), 3), np.int64)
        _beams.walk(start, np.ascontiguousarray(stop[part]), first, steps[part], cells)
        found.append(np.unique(_packed(cells - base)))
    return _unpacked(np.unique(np.concatenate(found))) + base


def scan_evidence(
    origin: NDArray[np.float64], ends: NDArray[np.float64], voxel_size: float, hit: int, miss: int
) -> Evidence:
    """Return the evidence of one scan: `hit` for each cell that holds an end, `miss` for the others that rays cross.

    origin: (3,) and ends: (N, 3) in metres, world frame. Only one ray is walked to each cell with ends, so some cells
    that other rays cross are missed, but none is added. hit, miss: log-odds in thousandths. Raises StereovoxError as
    `crossed_cells`.
    """
    cells = np.floor(ends / voxel_size).astype(np.int64)
    hits, chosen = np.unique(cells, axis=0, return_index=True)
    crossed = crossed_cells(origin, ends[chosen], voxel_size)
    together = np.concatenate([crossed, hits])  # if a cell is in both, the later one counts
    gains = np.repeat(np.array([miss, hit], np.int16), [len(crossed), len(hits)])
    blocks, of_cell = blocks_of_cells(together)
    x, y, z = (together & (SIDE - 1)).T
    values = np.zeros((len(blocks), CELLS), np.int16)
    values[of_cell, (x << 6) | (y << 3) | z] = gains
    return Evidence(blocks.astype(np.int32), values, np.empty((0, 3), np.int32), np.empty(0, np.int16))


def _pieces(steps: NDArray[np.int64]) -> list[slice]:
    """Return runs of rays that cross about `AT_ONCE` cells."""
    run = np.cumsum(steps + 1) // AT_ONCE
    edges = [0, *(np.flatnonzero(np.diff(run)) + 1).tolist(), len(steps)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]


def _packed(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number (N,) for each cell (N, 3) within `MAX_LENGTH` of 0, in the same order as the cells."""
    x, y, z = (cells + MAX_LENGTH).T
    return (x << 42) | (y << 21) | z


def _unpacked(numbers: NDArray[np.int64]) -> NDArray[np.int64]:
    mask = (1 << 21) - 1
    return np.stack([numbers >> 42, numbers >> 21 & mask, numbers & mask], axis=1) - MAX_LENGTH


PLACES = 16
"""Ray origins per cell side: the origins of a moving sensor are rounded to these."""


class _View(NamedTuple):
    voxel_size: np.float32
    max_range: np.float32


class _Tools(NamedTuple):
    """Tools of one lidar: its sensor table, and the same table with both signs together."""

    table: KernelTable
    look_up: NDArray[np.int32]


class Points:
    """Evidence of clouds by ray casting (Amanatides and Woo 1987), the strongest in each cell, as OctoMap does.

    A cell that holds a point is a hit, whatever other rays pass it; a cell that is only passed counts once per cloud.
    Rays end at `max_range`; one whose point is beyond is free as far as its noise allows.
    """

    def __init__(self, config: Config):
        sensor = make_sensor(config.sensor)
        self._config = config
        self._pools = [BlockPool(np.int32, capacity=8192) for _ in range(config.threads)]
        self._tools = PerCamera(partial(_tools, sensor, config))
        self._scratch: dict[tuple[bool, int], tuple] = {}

    def evidence(self, cloud: CheckedCloud) -> Evidence:
        """Return the evidence of a checked cloud; its memory is reused by the next call.

        Raises FrameRefused `view_too_large` if it spans more cells than can be kept.
        """
        config, tools = self._config, self._tools[cloud.lidar]
        rays, runs, places = self._laid_out(cloud, tools.table)
        wide, workers = self._is_wide(tools.table, places), min(config.threads, max(len(runs), 1))
        view = _View(np.float32(config.voxel_size), np.float32(config.max_range))
        scratch = [self._scratch_of(wide, n) for n in range(workers)]

        def follow(part: slice) -> None:
            n = part.start
            pool = self._pools[n]
            pool.clear()
            while not _points.cast(
                rays, runs, places, view, *tools, *scratch[n], pool.table, pool.coords, pool.count, pool.values,
                n, workers,
            ):  # fmt: skip
                if 2 * len(pool.coords) > MAX_BLOCKS:
                    raise FrameRefused(
                        "view_too_large",
                        f"the cloud has evidence on more than {CELLS * MAX_BLOCKS:.2g} cells: lower max_range, or use "
                        "larger cells",
                    )
                pool.clear()
                pool.reserve(2 * len(pool.coords))

        in_shards(follow, [slice(n, None) for n in range(workers)])
        pool = merged(self._pools[:workers], adds=False)
        values = np.empty((len(pool), CELLS), np.int16)
        _lanes.to_thousandths(pool.values[: len(pool)], 0, values)
        origin = origin_block(cloud.T_world_sensor, config).astype(np.int32)
        none, weak = np.empty((0, 3), np.int32), isinstance(cloud.lidar, RangeSensor)
        return Evidence(pool.coords[: len(pool)] + origin, values, none, np.empty(0, np.int16), weak)

    def _laid_out(
        self, cloud: CheckedCloud, table: KernelTable
    ) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.float32]]:
        """Return the rays of a cloud, runs of them with the same course (place and signs), and the places."""
        config, cell = self._config, np.array(self._config.cell)
        R, block = cloud.T_world_sensor[:3, :3], origin_block(cloud.T_world_sensor, config)
        corner = block.astype(float) * SIDE * cell
        places, of_place = self._places(cloud, R, corner, cell)
        rays, course = np.empty((5, len(cloud.ends)), np.float32), np.empty(len(cloud.ends), np.int64)
        used = _points.lay(
            cloud.ends, cloud.hits, of_place, places, np.ascontiguousarray(R), cloud.T_world_sensor[:3, 3] - corner,
            cell, float(config.max_range), float(table.reach[-1]), rays, course,
        )  # fmt: skip
        order = np.argsort(course[:used].astype(np.min_scalar_type(8 * len(places))), kind="stable")  # a radix sort
        return np.take(rays, order, axis=1), _runs(course[order]), np.ascontiguousarray(places, np.float32)

    def _places(
        self, cloud: CheckedCloud, R: NDArray[np.float64], corner: NDArray[np.float64], cell: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the places (P, 3) in cells where rays begin, and each ray's place (N,); (0,): all at the first."""
        t = cloud.T_world_sensor[:3, 3] - corner
        if cloud.origins is None:
            return t[None] / cell, np.empty(0, np.int64)
        starts = np.rint((cloud.origins @ R.T + t) / cell * PLACES) / PLACES
        places, of_place = np.unique(starts, axis=0, return_inverse=True)
        return places, of_place.reshape(-1)

    def _is_wide(self, table: KernelTable, places: NDArray[np.float32]) -> bool:
        """Return whether cells need keys of 64 bits. Raises FrameRefused if these do not suffice either."""
        config = self._config
        beyond = float(table.reach[-1]) if table.marks else 0.0
        far = (config.max_range + beyond) / min(config.cell) + SIDE + float(np.abs(places).max(initial=0))
        if far >= 1 << (_cells.WIDE - 1):
            raise FrameRefused(
                "view_too_large", f"the cloud reaches {far:.2g} cells far: lower max_range, or use larger cells"
            )
        return far >= 1 << (_cells.NARROW - 1)

    def _scratch_of(self, wide: bool, n: int) -> tuple:
        if (wide, n) not in self._scratch:
            self._scratch[wide, n] = make_lanes(wide), make_memory()
        return self._scratch[wide, n]


def _tools(sensor: InverseSensorModel, config: Config, lidar: Lidar) -> _Tools:
    table = sensor_table(sensor, config, lidar)
    return _Tools(table, (table.clear + table.mark).ravel())


def _runs(course: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return runs (K, 3) of at most LANES rays with the same course, of sorted courses (N,): start, end, place."""
    edges = np.flatnonzero(np.diff(course, prepend=-1, append=-1))
    runs = [
        np.column_stack([starts, np.minimum(starts + LANES, stop), np.full(len(starts), course[start] >> 3)])
        for start, stop in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)
        for starts in (np.arange(start, stop, LANES),)
    ]
    return np.concatenate([np.empty((0, 3), np.int64), *runs]).astype(np.int32)
