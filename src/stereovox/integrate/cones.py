# SPDX-License-Identifier: Apache-2.0
"""From one distance of a sonar to evidence on the cells of a grid, as `Points` makes of its rays in space."""

from __future__ import annotations

from math import atan2, ceil, hypot, inf, log

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.depth.ranges import APART
from stereovox.frame import Range
from stereovox.geometry import se2
from stereovox.integrate import _beams
from stereovox.integrate.beams import check_near
from stereovox.maps.cells.evidence import CELLS, SIDE, GridEvidence, to_units
from stereovox.sensors.arc import Arc
from stereovox.sensors.model import REACH_SIGMA


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
