# SPDX-License-Identifier: Apache-2.0
"""A sonar's or radar's distance as rays that fill its cone."""

from __future__ import annotations

from dataclasses import replace
from math import asin, ceil, cos, degrees, inf, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import Cloud, Range, Rays, name_of
from stereovox.frame.validate import rigid_pose, validate_fields
from stereovox.sensors.model import REACH_SIGMA

APART = 0.5
"""Distance between neighbouring rays at their end, in cells."""
MOST = 1 << 18
"""Most rays in one cone; if it needs more, cells between them are unchanged."""
GOLDEN = pi * (3 - sqrt(5))


def cloud_of(seen: Rays, config: Config) -> Cloud:
    """Return the rays of a cone: to its arc at the distance, or free ones up to where nothing was heard.

    A cloud is returned unchanged.

    Rays instead of an integrator of its own: limits, noise, cells, threads and all checks are those of clouds, whose
    kernel already lets a cell that holds an end outweigh whatever passes it.

    Raises FrameRefused as `distance_of`.
    """
    if isinstance(seen, Cloud):
        return seen
    distance, beam = distance_of(seen), seen.beam
    silent = distance == inf
    end = max(beam.range_max - REACH_SIGMA * beam.sigma, 0.0) if silent else distance
    apart = APART * min(config.cell) / max(min(end, config.max_range), min(config.cell))
    rays = end * directions(beam.beam, min(ceil(beam.solid_angle / apart**2), MOST))
    return Cloud(
        np.empty((0, 3)) if silent else rays, seen.T_world_sensor, seen.stamp_ns, beam, clear=rays if silent else None,
        name=seen.name, sensor=seen.sensor, pose_off_ns=seen.pose_off_ns, pose_sigma=seen.pose_sigma,
    )  # fmt: skip


def distance_of(seen: Range) -> float:
    """Return the distance in metres; inf if nothing was heard.

    Raises FrameRefused as `validate_fields`, and `no_valid_range`: it is not within the sensor's limits, or nothing was
    heard and that clears nothing.
    """
    validate_fields(seen, Range)
    beam, distance = seen.beam, float(seen.distance)
    if distance == inf and not beam.silence_clears:
        raise FrameRefused("no_valid_range", f"{name_of(seen)}: nothing was heard, which clears nothing")
    if distance != inf and not beam.range_min <= distance <= beam.range_max:
        limits = f"it measures {beam.range_min:g} to {beam.range_max:g} m"
        raise FrameRefused("no_valid_range", f"{name_of(seen)}: its distance is {distance:g}; {limits}")
    return distance


def level_range(seen: Range, config: Config) -> Range:
    """Return a distance for a floor map, with an exactly rigid pose.

    Raises FrameRefused as `distance_of` and `rigid_pose`, and `tilted`: the cone leans by more than
    `grid.max_tilt_deg`.
    """
    distance = distance_of(seen)
    T = rigid_pose(seen, config.pose_rigidity_tolerance)
    lean = degrees(asin(min(abs(T[2, 0]), 1.0)))
    if lean > config.grid.max_tilt_deg:
        raise FrameRefused("tilted", f"{name_of(seen)}: its cone leans {lean:.1f} degrees (grid.max_tilt_deg)")
    return replace(seen, distance=distance, T_world_sensor=T)


def directions(beam: float, number: int) -> NDArray[np.float64]:
    """Return unit vectors (N, 3) that fill a cone about x evenly, on a spiral (Vogel 1979). beam: its full width."""
    k = np.arange(number)
    x = 1 - (k + 0.5) / number * (1 - cos(beam / 2))
    aside = np.sqrt(np.maximum(1 - x * x, 0))
    return np.stack([x, aside * np.cos(GOLDEN * k), aside * np.sin(GOLDEN * k)], axis=1)
