# SPDX-License-Identifier: Apache-2.0
"""From a scan to evidence on the cells of a grid: beams clear the cells they pass and mark the cells they hit.

IST 2019, section II; the map adds the evidence by its Eq 5.

From one distance of a sonar to evidence on the cells of a grid, as `Points` makes of its rays in space.
"""

from __future__ import annotations

from math import atan2, ceil, hypot, inf, log
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import registry
from stereovox.config import Config
from stereovox.depth.cloud import APART
from stereovox.errors import ConfigError, FrameRefused
from stereovox.frame import Range, Scan, name_of
from stereovox.frame.validate import for_kernels
from stereovox.geometry import se2
from stereovox.geometry.se3 import Transform
from stereovox.integrate import _beams
from stereovox.maps.cells.evidence import CELLS, SIDE, GridEvidence, to_units
from stereovox.maps.voxel_map import INDEX_LIMIT
from stereovox.sensors.models import Arc
from stereovox.sensors.protocol import REACH_SIGMA

TRAVERSALS = {
    "bresenham": "stereovox.integrate._beams:bresenham",
    "exact": "stereovox.integrate._beams:exact",
}
"""Name -> kernel `(lines, first, columns, rows, gain, adding, values)`, see `_beams.exact`; more by entry points."""
MAX_CELLS = 4096
"""Most cells of a beam: a scan's patch is at most four times the square of it."""
MAX_BEAMS = 65536
"""Most beams of a scan: the sum of their largest evidence fits into 32 bits."""
UPDATES = {"once": (None, np.int16), "every": (1, np.int32)}
"""Whether the evidence of beams on a cell is summed (None: the last counts), and the dtype of the sum."""


def make_beams(config: Config) -> Beams:
    """Return the configured `Beams`. Raises ConfigError for settings that do not fit together."""
    return Beams(config)


class Beams:
    """Turns scans into evidence on cells of `config.voxel_size`; it never sees the map."""

    def __init__(self, config: Config):
        grid = config.grid
        if config.max_range + grid.thickness > MAX_CELLS * config.voxel_size:
            raise ConfigError(
                f"max_range {config.max_range:g} spans more than {MAX_CELLS} cells of {config.voxel_size:g} in a "
                "grid; use larger cells"
            )
        self._config = config
        self._traverse = registry.find("traversals", TRAVERSALS, grid.traversal)
        self._adding, dtype = UPDATES[grid.update]
        occupied, free = (to_units(log(p / (1 - p))) for p in (grid.p_occupied, grid.p_free))
        self._occupied, self._free = int(max(occupied, 1)), int(min(free, -1))
        self._values, self._coords = np.empty((0, CELLS), dtype), np.empty((0, 3), np.int32)
        self._lines, self._ends = tuple(np.empty((0, 4)) for _ in range(3)), np.empty((0, 6))
        self._seen: tuple[float, float, int] | None = None
        self._directions = np.empty((0, 2))

    def evidence(self, scan: Scan, origin: ArrayLike = (0.0, 0.0, 0.0)) -> GridEvidence:
        """Return the evidence of a validated scan on the cells of a grid with this `origin` (3,): x, y, yaw.

        A range from `range_min` to min(`range_max`, `config.max_range`) is a hit: its beam is free up to it, and
        occupied from there to `grid.thickness` behind it. +inf, or a hit beyond `config.max_range`, is free up to that
        minimum. Other ranges give no evidence. If the scan has `clear`, its beams are free up to there, and from
        `clear_from` on. A beam never clears the cell it hits. If the sensor leans, lengths are projected to the floor.
        The memory of the evidence is reused by the next call.
        Raises FrameRefused: `too_many_beams`, `bad_clear`, `bad_scan`, `pose_too_far`.
        """
        lines, ends, box = self._aim(scan, np.asarray(origin, float))
        if not sum(map(len, lines)):
            return GridEvidence.nothing()
        low, high = np.floor_divide(box.reshape(2, 2), SIDE)
        across, up = (high - low + 1).tolist()
        coords, values = self._patch(low, across, across * up)
        columns, rows = _beams.places(across, up)
        flat, dtype = values.reshape(-1), values.dtype.type
        free, hits, taken_back = lines
        passes = [(free, self._free), (hits, self._occupied)]
        if self._adding:  # otherwise hits, which come last, replace the value
            passes.append((taken_back, -self._free))
        for what, gain in passes:
            self._traverse(what, low * SIDE, columns, rows, dtype(gain), self._adding, flat)
        return GridEvidence(coords, values, ends)

    def _aim(
        self, scan: Scan, origin: NDArray[np.float64]
    ) -> tuple[list[NDArray[np.float64]], NDArray[np.float64], NDArray[np.int64]]:
        """Return the lines to clear, to occupy, and to un-clear at hits; each beam's ends; and the box of all."""
        size, config = self._config.voxel_size, self._config
        ranges, clear, clear_from = _beams_of(scan)
        T = se2.lifted(se2.inverse(origin)) @ scan.T_world_sensor
        position = check_near(T, size, scan)
        reach = np.fmin(scan.range_max, config.max_range)
        with np.errstate(over="ignore"):
            limits = np.array([scan.range_min, reach, scan.range_max], np.float32)
        if len(self._lines[0]) < len(ranges):
            self._lines, self._ends = tuple(np.empty((len(ranges), 4)) for _ in range(3)), np.empty((len(ranges), 6))
        ends = self._ends[: len(ranges)]
        box = np.empty(4, np.int64)
        counts = _beams.aim(
            ranges, clear, clear_from, self._directions_of(scan), T[:2, :2] / size, position, limits,
            config.grid.thickness, *self._lines, ends, box,
        )  # fmt: skip
        return [lines[:count] for lines, count in zip(self._lines, counts, strict=True)], ends, box

    def _directions_of(self, scan: Scan) -> NDArray[np.float64]:
        """Return cosine and sine (N, 2) of each beam; reused from the previous scan if it had the same angles."""
        seen = float(scan.angle_min), float(scan.angle_step), len(scan.ranges)
        if seen != self._seen:
            if not np.isfinite(seen[0] + seen[1] * seen[2]):
                raise FrameRefused("bad_scan", f"{name_of(scan)}: its angles are not finite")
            self._directions, self._seen = np.column_stack([np.cos(scan.angles), np.sin(scan.angles)]), seen
        return self._directions

    def _patch(self, low: NDArray[np.int64], across: int, tiles: int) -> tuple[Any, Any]:
        """Return coordinates and zeroed values of the tiles of a patch."""
        if len(self._values) < tiles:
            self._values = np.empty((tiles, CELLS), self._values.dtype)
            self._coords = np.empty((tiles, 3), np.int32)
        coords, values = self._coords[:tiles], self._values[:tiles]
        _beams.lay_out(low, across, coords, values)
        return coords, values


def check_near(T: Transform, size: float, seen: Scan | Range) -> NDArray[np.float64]:
    """Return the place (2,) in cells of a sensor at T in the grid. Raises FrameRefused `pose_too_far`."""
    position = T[:2, 3] / size
    if not ((np.abs(position) < INDEX_LIMIT - 2 * MAX_CELLS).all() and (np.abs(T[:2, :2]) < 1.01).all()):
        raise FrameRefused(
            "pose_too_far", f"{name_of(seen)}: it is more than {INDEX_LIMIT} cells from the map's origin"
        )
    return position


def _beams_of(scan: Scan) -> tuple[NDArray[np.float32], ...]:
    """Return ranges, how far beams are known to be free (empty: by ranges), and from where (empty: 0)."""
    shape = np.shape(scan.ranges)
    if shape[0] > MAX_BEAMS:
        raise FrameRefused("too_many_beams", f"{name_of(scan)}: {shape[0]} beams; at most {MAX_BEAMS} are accepted")
    for what in ("clear", "clear_from"):
        given = getattr(scan, what)
        if given is not None and (given.shape != shape or given.dtype.kind not in "fiu"):
            detail = f"{what} is {given.shape} {given.dtype}, ranges are {shape}"
            raise FrameRefused("bad_clear", f"{name_of(scan)}: {detail}")
    return _floats(scan.ranges), _floats(scan.clear), _floats(scan.clear_from)


def _floats(part: ArrayLike | None) -> NDArray[np.float32]:
    with np.errstate(over="ignore", invalid="ignore"):
        return for_kernels(np.asarray(() if part is None else part, np.float32))


def cone_evidence(seen: Range, config: Config, origin: ArrayLike = (0.0, 0.0, 0.0)) -> GridEvidence:
    """Return the evidence of a checked distance on the cells of a grid with this `origin` (3,): x, y, yaw.

    Cells that rays of the cone cross are free, from the least distance that the sensor measures to four sigma before
    its reading, and at most to `config.max_range`. The cells that the arc there crosses share the echo (`Arc`), unless
    it is beyond `max_range`. An infinite distance is a cone that is free up to the sensor's largest one. A leaning
    cone is projected to the floor. Raises FrameRefused `pose_too_far`.
    """
    beam, size = seen.beam, config.voxel_size
    T = se2.lifted(se2.inverse(np.asarray(origin, float))) @ seen.T_world_sensor
    check_near(T, size, seen)
    far = beam.range_max if seen.distance == inf else float(seen.distance)
    heard, level = seen.distance != inf and far <= config.max_range, hypot(T[0, 0], T[1, 0])
    number = 1 + ceil(beam.beam * min(far, config.max_range) / (APART * size))
    angles = atan2(T[1, 0], T[0, 0]) + beam.beam * np.linspace(-0.5, 0.5, number)
    rays = level * np.column_stack([np.cos(angles), np.sin(angles)])
    since, until = beam.range_min, min(far - REACH_SIGMA * beam.sigma, config.max_range)
    free = np.hstack([_cells(T, rays, metres, size) for metres in (since, until)])[: number if since < until else 0]
    arc = np.unique(np.floor(_cells(T, rays if heard else rays[:0], far, size)), axis=0).astype(np.int64)
    if not len(free) + len(arc):
        return GridEvidence.nothing()
    ends = np.concatenate([np.floor(free.reshape(-1, 2)).astype(np.int64), arc])
    low, high = np.floor_divide(ends.min(axis=0), SIDE), np.floor_divide(ends.max(axis=0), SIDE)
    across, up = (high - low + 1).tolist()
    coords, values = np.empty((across * up, 3), np.int32), np.empty((across * up, CELLS), np.int16)
    _beams.lay_out(low, across, coords, values)
    columns, rows = _beams.places(across, up)
    model, flat = Arc(beam.solid_angle), values.reshape(-1)
    gain = np.int16(to_units(log(model.p_free / (1 - model.p_free))))
    _beams.exact(free, low * SIDE, columns, rows, gain, None, flat)
    hit = model.shared(np.maximum([beam.beam * far / size], 1.0), np.array([beam.sigma / size]))
    column, row = (arc - low * SIDE).T
    flat[columns[column] + rows[row]] = to_units(np.log(hit / (1 - hit)))
    return GridEvidence(coords, values, weak=True)


def _cells(T: NDArray[np.float64], rays: NDArray[np.float64], metres: float, size: float) -> NDArray[np.float64]:
    """Return the ends (N, 2) in cells of rays from a sensor at T, as `_beams.aim` rounds them."""
    return np.rint((T[:2, 3] + metres * rays) / size * _beams.GRAIN) / _beams.GRAIN
