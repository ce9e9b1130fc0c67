# SPDX-License-Identifier: Apache-2.0
"""Check clouds, and correct the motion distortion of clouds from a moving sensor.

A sonar's or radar's distance as rays that fill its cone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import asin, ceil, cos, degrees, inf, pi, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.lidar import RangeSensor
from stereovox.config import Config
from stereovox.depth._cloud import usable
from stereovox.depth.quality import check_cloud, check_unit_of_rays
from stereovox.errors import FrameRefused
from stereovox.frame import MAX_POINTS, CheckedCloud, Cloud, Range, Rays, name_of
from stereovox.frame.validate import rigid_pose, validate_fields
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sensors.protocol import REACH_SIGMA

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


SOME = 4096
"""Points of a cloud that are sampled to check its unit."""
STEPS, STEP_S = 64, 0.002
"""Poses of a moving sensor during one cloud, and most seconds between two: it moves a few centimetres in that time."""
LONGEST_S, FARTHEST_S = 10.0, 1e6
"""Most seconds from the first to the last point of a cloud, and from its stamp; larger numbers are not times."""
TIME_UNITS = {1.0: "seconds", 1e-3: "milliseconds", 1e-6: "microseconds", 1e-9: "nanoseconds"}
SWEEP_S, OF_PERIOD = (1.5e-3, 1.5), (0.1, 2.5)
"""Shortest and longest sweep: in seconds if nothing else is known, else in periods of the clouds. The ratio of each
pair is at most 1000, so that at most one unit fits."""
USUAL_PERIOD_S, SAME_CLOCK_S = 0.5, 5.0
"""Longest period that sweeps fill (longer ones are of clouds that were left out), and largest distance of times from
the stamp of their cloud on one clock."""


def checked_cloud(cloud: Cloud, config: Config) -> CheckedCloud:
    """Return the usable rays of a cloud.

    Points without value, and points nearer than the lidar's or the settings' minimum range, are left out: their rays
    clear nothing. Rays beyond the lidar's own maximum range end there without a surface, and at least four sigma in
    front of their point. Raises FrameRefused with the reason: the source's `fault`, `bad_form` and others of
    `validate_fields`, `bad_dtype`, `bad_shape`, `too_many_points`, `bad_units`, `no_valid_point`, `too_few_values`,
    `no_surfaces`, and as `rigid_pose`.
    """
    validate_fields(cloud, Cloud)
    T = rigid_pose(cloud, config.pose_rigidity_tolerance)
    points, clear = _points(cloud, "points"), _points(cloud, "clear")
    origins = None if cloud.origins is None else _points(cloud, "origins")
    if origins is not None and len(origins) != len(points):
        detail = f"{len(origins)} origins for {len(points)} points; give one for each"
        raise FrameRefused("bad_shape", f"{name_of(cloud)}: {detail}")
    clear = clear[np.isfinite(clear).all(axis=1)]
    room = len(points) + len(clear)
    ends, starts, hits = np.empty((room, 3)), np.empty((room, 3)), np.zeros(room, bool)
    _check_unit(cloud, points, origins, clear, config)
    own = cloud.lidar.range_min  # `min_range` is the cameras' limit; sonars measure nearer
    nearest = own if isinstance(cloud.lidar, RangeSensor) else max(own, config.min_range)
    none = np.empty((0, 3)) if origins is None else origins
    farthest, reach = float(cloud.lidar.range_max), REACH_SIGMA * float(cloud.lidar.sigma)
    used, finite = usable(points, none, nearest, farthest, reach, ends, starts, hits)
    if not used and not len(clear):
        found = f"{len(points)} points, {finite} of them finite"
        raise FrameRefused("no_valid_point", f"{name_of(cloud)}: no ray can be used ({found}); is it covered?")
    rays = used + len(clear)
    ends[used:rays], starts[used:rays], hits[used:rays] = clear, 0.0, False
    begin = None if origins is None else starts[:rays]
    checked = CheckedCloud(ends[:rays], begin, hits[:rays], cloud.lidar, T, int(cloud.stamp_ns))
    check_cloud(checked, cloud, config)
    return checked


def _check_unit(
    cloud: Cloud,
    points: NDArray[np.float64],
    origins: NDArray[np.float64] | None,
    clear: NDArray[np.float64],
    config: Config,
) -> None:
    """Raise FrameRefused `bad_units` if a cloud's points, or its free rays, are not in metres."""
    for ends, starts in ((points, origins), (clear, None)):
        some = slice(None, None, max(1, len(ends) // SOME))
        arms = ends[some] if starts is None else ends[some] - starts[some]
        with np.errstate(over="ignore", invalid="ignore"):
            check_unit_of_rays(cloud, np.sqrt(np.einsum("ij,ij->i", arms, arms)), config)


class SweepTimes(NamedTuple):
    """When the points of a cloud were measured.

    seconds: (N,) float64 from the stamp of the cloud, NaN: unknown; None: at once. words: how they were read, if that
    is unusual.
    """

    seconds: NDArray[np.float64] | None
    words: str = ""


def sweep_times(
    given: NDArray[np.generic], used: NDArray[np.bool_], stamp_ns: int, period_s: float = 0.0
) -> SweepTimes:
    """Return times of points, whose unit and origin drivers choose freely, in seconds from the stamp of their cloud.

    The unit is the one in which the sweep takes a plausible time. Times near zero count from the stamp, those near the
    stamp are on its clock, and all others are on another clock, on which the stamp is the first point.

    Args:
        given: (N,) numbers of a point field.
        used: (N,) whether a point is one; invalid ones often have a time of 0.
        stamp_ns: Stamp of the cloud.
        period_s: Time from cloud to cloud, 0 if unknown.

    Raises:
        ValueError: There is no such unit.
    """
    times = given.astype(np.float64)
    known = used & np.isfinite(times)
    some = times[known & (times != 0)]
    if some.size and some.min() > 10 * np.ptp(some) > 0:
        known &= times != 0
    times = np.where(known, times, np.nan)
    if not known.any():
        return SweepTimes(times)
    first, span = float(np.nanmin(times)), float(np.nanmax(times) - np.nanmin(times))
    low, high = SWEEP_S if not 0 < period_s <= USUAL_PERIOD_S else (period_s * share for share in OF_PERIOD)
    unit = next((unit for unit in TIME_UNITS if low <= span * unit <= high), 0.0)
    coarse = given.dtype == np.float32 and float(np.spacing(np.float32(first + span))) > 0.05 * span
    if coarse and first > 0:
        return SweepTimes(None, "too coarse to say anything, and ignored")
    if not unit and not span and abs(first) <= high:
        return SweepTimes(times)
    if not unit and period_s and 0 <= first <= first + span <= 1:
        return SweepTimes(times * period_s, f"shares of the {period_s:.3g} s from cloud to cloud")
    if not unit:
        raise ValueError(f"times of its points span {span:g}, in no unit between {low:.3g} and {high:.3g} s")
    words = "" if unit == (1e-9 if given.dtype.kind in "iu" else 1.0) else f"in {TIME_UNITS[unit]}"
    if abs(first * unit) <= 2 * high:
        return SweepTimes(times * unit, words)
    since = (times - 1e-9 * stamp_ns / unit) * unit
    if abs(float(np.nanmedian(since))) <= SAME_CLOCK_S:
        return SweepTimes(since, words)
    return SweepTimes((times - first) * unit, f"in {TIME_UNITS[unit]} of another clock, from the first point on")


def deskewed(cloud: Cloud, times_s: ArrayLike, pose_at: Callable[[int], Transform]) -> Cloud:
    """Return a cloud as if measured all at once, at its stamp, corrected for the motion of its sensor.

    Args:
        cloud: Each of its points is in the sensor's frame at the time it was measured.
        times_s: (N,) seconds from `stamp_ns` at which each was measured.
        pose_at: Returns T_world_sensor (4, 4) at a time in nanoseconds; raises FrameRefused if it is unknown.

    Returns:
        The cloud with its points in the sensor's frame at `stamp_ns`, and with `origins`. Points with a time that is
        not finite become not finite.

    Raises:
        FrameRefused: The pose at some time of the sweep is unknown, or the number of times differs from the number of
            points, or they are not times.
    """
    times = np.asarray(times_s, float)
    if times.shape != (len(cloud.points),):
        raise FrameRefused("bad_shape", f"{name_of(cloud)}: {times.shape} times for {len(cloud.points)} points")
    known = np.isfinite(times)
    if not known.any():
        return replace(cloud, points=np.full((len(times), 3), np.nan))
    first, last = float(times[known].min()), float(times[known].max())
    if last - first > LONGEST_S or max(-first, last) > FARTHEST_S:
        detail = f"points were measured {first:.3g} to {last:.3g} s from its stamp, which no sweep takes"
        raise FrameRefused("no_pose", f"{name_of(cloud)}: {detail}; what is the unit of its times?")
    knots = (
        np.linspace(first, last, max(STEPS, ceil((last - first) / STEP_S) + 1)) if last > first else np.array([first])
    )
    T_now_world = inverse(cloud.T_world_sensor)
    moved = np.array([T_now_world @ pose_at(cloud.stamp_ns + round(1e9 * knot)) for knot in knots])
    step = (last - first) / max(len(knots) - 1, 1) or 1.0
    number = np.clip(np.rint((np.where(known, times, first) - first) / step).astype(np.int64), 0, len(knots) - 1)
    R, origins = moved[number, :3, :3], moved[number, :3, 3]
    points = np.einsum("nij,nj->ni", R, np.asarray(cloud.points, float)) + origins
    points[~known | ~np.asarray(cloud.points).any(axis=1)] = np.nan
    return replace(cloud, points=points, origins=origins)


def _points(cloud: Cloud, field: str) -> NDArray[np.float64]:
    """Return points (N, 3) of a field as float64; (0, 3) if it is None."""
    given = getattr(cloud, field)
    if given is None:
        return np.empty((0, 3))
    if given.dtype.kind != "f":
        raise FrameRefused("bad_dtype", f"{name_of(cloud)}: {field} are {given.dtype}; give float32 metres")
    if given.ndim != 2 or given.shape[1] != 3:
        raise FrameRefused("bad_shape", f"{name_of(cloud)}: {field} are {given.shape}; give (N, 3) metres")
    if len(given) > MAX_POINTS:
        raise FrameRefused(
            "too_many_points", f"{name_of(cloud)}: {len(given)} {field}; at most {MAX_POINTS} are accepted"
        )
    return np.ascontiguousarray(given, float)
