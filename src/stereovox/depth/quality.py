# SPDX-License-Identifier: Apache-2.0
"""Plausibility of images, clouds and scans: enough values, on surfaces, in metres; neither black nor saturated.

Chien 2020, 5.1, asks for such a filter of overexposed images and miscalculated depth. The gate checks whether an image
agrees with the map and the frames before it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.depth import _cloud, _images
from stereovox.errors import FrameRefused
from stereovox.frame import CheckedCloud, Cloud, DepthImage, Frame, Reason, Scan, StereoFrame, name_of
from stereovox.frame.validate import validate_upright_scan
from stereovox.sensors.noise import RangeNoise

ROWS = 16
"""Rows of an image that are sampled."""
BEND_SIGMA, BEND_SLACK = 3 * sqrt(6), 0.02
"""On a surface, the second difference of inverse depth along a row is at most three of its standard deviations (sigma
of a depth times the root of 1 + 4 + 1), plus 2 % of the inverse depth, since surfaces are not all planar."""
FEW = 100
"""Fewer pixels with a depth on both sides prove neither surfaces nor their absence."""
BLACK, WHITE = 5, 250
"""Grey value up to which a pixel is black, and from which it is saturated."""
FAR_RANGES, FAR_M = 60, 300.0
"""Median depth, in maximum ranges and in metres, beyond which the unit must be wrong."""
NEAR_RANGE, NEAR_M = 0.1, 0.01
"""Median depth, as a share of the minimum range and in metres, below which the unit must be wrong."""
SPARSE = 0.05
"""The unit is checked if a smaller share of the pixels has a depth within the range."""
FAR_LIDAR_M = 300.0
"""Median range, and at least twice the maximum range of the map, beyond which a lidar's ranges are not in metres. Half
of the points of a lidar on a vehicle are nearer; a room in millimetres is farther. Ranges in feet or centimetres may be
nearer, and cannot be recognised."""
SAMPLE, ASKED, ALL = 4096, 256, 1 << 18
"""Rays of a cloud in the sample, those of them whose neighbours are sought, and rays that are searched for neighbours
once more before a cloud is refused: leaves of a thicket are similar only between directly adjacent rays."""
FEW_RAYS, FEW_BEAMS = 200, 50
"""Fewer rays of a cloud, or beams of a scan, prove neither surfaces nor their absence."""
ALIKE, ALIKE_SIGMA = 0.03, 3 * sqrt(2)
"""Ranges of neighbours on a surface differ by no more than their distance across, this share of the range, and this
many standard deviations of a range."""
TINY_M, BEAM_SIGMA_M = 1e-6, 0.03
"""Length used for a ray of length 0, and the assumed standard deviation of a 2-D lidar's ranges."""


def check_depth(image: DepthImage, frame: Frame, config: Config) -> None:
    """Raise FrameRefused if the depth image of `frame` shows no surfaces: `too_few_values`, `no_surfaces`."""
    looked, informative, compared, even = counted(image, config)
    if informative < config.trust.min_valid_share * looked:  # in the sampled rows; now count all
        _check_share(image, frame, config.trust.min_valid_share)
    if even < config.trust.min_surface_share * compared and compared >= FEW:
        detail = f"{even / compared:.0%} of the depths are on surfaces"
        limit = f"trust.min_surface_share {config.trust.min_surface_share:g}"
        raise FrameRefused("no_surfaces", f"{name_of(frame)}: {detail} ({limit}); check camera and driver")


def counted(image: DepthImage, config: Config) -> tuple[int, int, int, int]:
    """Return four numbers of pixels in the sampled rows: all; those with a depth or too far; those with a depth
    between two others; and those of the last that are on a surface with both, within the range noise.
    """
    noise, counts = RangeNoise.of(config.noise, image.camera), np.empty(4, np.int64)
    allowed = np.array([BEND_SIGMA * noise.s0, BEND_SIGMA * noise.s1, BEND_SIGMA * noise.s2], np.float32)
    _images.count(image.depth_m, _step(image.depth_m), allowed, np.float32(BEND_SLACK), counts)
    looked, informative, compared, even = counts.tolist()
    return looked, informative, compared, even


def _check_share(image: DepthImage, frame: Frame, least: float) -> None:
    number = np.bincount(image.reason.ravel(), minlength=len(Reason))
    informative, pixels = number[Reason.VALID] + number[Reason.TOO_FAR], number.sum() - number[Reason.MASKED]
    if informative < least * pixels:
        detail = (
            f"{informative} of {pixels} pixels have information (trust.min_valid_share {least:g}); is the view blocked?"
        )
        raise FrameRefused("too_few_values", f"{name_of(frame)}: {detail}")


def check_unit(frame: Frame, depth_m: NDArray[np.floating], config: Config) -> None:
    """Raise FrameRefused `bad_units` if the depths (N,) of a frame, in metres, cannot be metres."""
    found = _wrong_unit(depth_m, max(FAR_RANGES * config.max_range, FAR_M), config)
    if found:
        cure = "millimetres? give depth_scale=0.001" if found[1] == "beyond" else "metres already? give depth_scale=1"
        detail = f"half of its depths are {found[1]} {found[0]:.4g} m with depth_scale {frame.depth_scale:g}"
        raise FrameRefused("bad_units", f"{name_of(frame)}: {detail}; is it in {cure}")


def check_unit_of_rays(seen: Cloud | Scan, lengths_m: NDArray[np.floating], config: Config) -> None:
    """Raise FrameRefused `bad_units` if the lengths (N,) of a lidar's rays, in metres, cannot be metres."""
    found = _wrong_unit(lengths_m, max(2 * config.max_range, FAR_LIDAR_M), config)
    if found:
        cure = "millimetres? multiply by 0.001" if found[1] == "beyond" else "kilometres? multiply by 1000"
        detail = f"half of its ranges are {found[1]} {found[0]:.4g} m; give metres"
        raise FrameRefused("bad_units", f"{name_of(seen)}: {detail}: are they in {cure}")


def _wrong_unit(lengths_m: NDArray[np.floating], farthest_m: float, config: Config) -> tuple[float, str] | None:
    """Return the median of lengths (N,) if it cannot be in metres, and whether it is `beyond` or `below` the limit."""
    known = lengths_m[np.isfinite(lengths_m) & (lengths_m > 0)]
    if not known.size:
        return None
    known.sort()
    median = float(known[(known.size - 1) // 2] + known[known.size // 2]) / 2  # np.median is ten times as slow
    if median > farthest_m:
        return median, "beyond"
    return (median, "below") if median < min(NEAR_RANGE * config.min_range, NEAR_M) else None


def check_cloud(checked: CheckedCloud, cloud: Cloud, config: Config) -> None:
    """Raise FrameRefused if a checked cloud shows too little, or no surfaces: `too_few_values`, `no_surfaces`."""
    given = len(cloud.points) + (0 if cloud.clear is None else len(cloud.clear))
    _check_number(cloud, len(checked.ends), given, "points", config)
    if config.trust.min_surface_share:
        _check_alike(cloud, partial(_alike_of, checked), config)


def checked_scan(scan: Scan, config: Config) -> Scan:
    """Return a lidar's scan with an exactly rigid pose.

    Raises FrameRefused as `validate_upright_scan` and `check_scan`.
    """
    scan = validate_upright_scan(scan, config)
    check_scan(scan, config)
    return scan


def check_scan(scan: Scan, config: Config) -> None:
    """Raise FrameRefused if a validated scan of a lidar is implausible.

    The reason is `bad_units`, `no_valid_range`, `too_few_values`, or `no_surfaces`.
    """
    ranges = np.asarray(scan.ranges, float)
    check_unit_of_rays(scan, ranges, config)
    hit = (ranges >= scan.range_min) & (ranges > 0) & (ranges <= scan.range_max) & np.isfinite(ranges)
    says = hit | (ranges == np.inf)
    clear = scan.clear
    if clear is not None and clear.shape == ranges.shape and clear.dtype.kind in "fiu":  # otherwise refused later
        says |= clear > 0
    number = int(np.count_nonzero(says))
    if not number:
        raise FrameRefused("no_valid_range", f"{name_of(scan)}: not one beam has a range; is the lidar covered?")
    _check_number(scan, number, ranges.size, "beams", config)
    at = np.flatnonzero(hit)
    if config.trust.min_surface_share and len(at) > FEW_BEAMS:
        gap = abs(float(scan.angle_step)) * np.diff(at)
        least = config.trust.min_surface_share
        share = _alike(ranges[at], np.arange(len(gap)), np.arange(1, len(at)), gap, BEAM_SIGMA_M, least)
        _check_alike(scan, lambda _: share, config)


def _check_number(seen: Cloud | Scan, number: int, of: int, what: str, config: Config) -> None:
    """Raise FrameRefused `too_few_values` if `number` of the `of` points or beams are too few."""
    least = config.trust.min_valid_share
    if number < least * of:
        detail = f"{number} of {of} {what} have information (trust.min_valid_share {least:g}); is the view blocked?"
        raise FrameRefused("too_few_values", f"{name_of(seen)}: {detail}")


def _check_alike(seen: Cloud | Scan, alike: Callable[[int], float], config: Config) -> None:
    """Raise FrameRefused `no_surfaces` if too few ranges are similar to their neighbours.

    alike: returns the share of them, 0 to 1, among a given number of rays.
    """
    least = config.trust.min_surface_share
    if alike(SAMPLE) < least and (share := alike(ALL)) < least:
        detail = (
            f"{max(share, 0):.0%} of its ranges are similar to their neighbours (trust.min_surface_share {least:g})"
        )
        raise FrameRefused("no_surfaces", f"{name_of(seen)}: {detail}; check sensor and driver")


def _alike_of(checked: CheckedCloud, most: int) -> float:
    """Return `_alike` for some points of a cloud, with neighbours from at most about `most` points."""
    at = np.flatnonzero(checked.hits)
    at = at[:: max(1, len(at) // most)]
    if len(at) < FEW_RAYS:
        return 1.0
    arms = checked.ends[at] if checked.origins is None else checked.ends[at] - checked.origins[at]
    ranges = np.maximum(np.sqrt(np.einsum("ij,ij->i", arms, arms)), TINY_M)
    directions = np.ascontiguousarray((arms / ranges[:, None]).T, np.float32)
    asked = np.arange(0, len(at), max(1, len(at) // ASKED))
    found = np.empty(len(asked), np.int64)
    _cloud.nearest(directions, asked, found)
    gap = np.linalg.norm(directions[:, asked] - directions[:, found], axis=0)
    return _alike(ranges, asked, found, gap, checked.lidar.sigma)


def _alike(
    ranges: NDArray[np.float64],
    one: NDArray[np.integer],
    next_to_it: NDArray[np.integer],
    gap: NDArray[np.floating],
    sigma: float,
    enough: float = 1.0,
) -> float:
    """Return how similar ranges (N,) are to those in nearly the same direction: 1 fully, 0 as any two of them.

    one, next_to_it: (Q,) rows of ranges that are next to each other; gap: (Q,) radians between them; sigma: metres.
    enough: a share that need not be known exactly; at least so much is then returned.

    A pair counts fully if both may be on one surface that is seen under at least 45 degrees. Otherwise it counts by
    the share of all ranges that are farther from the one than its neighbour is: half on average if ranges are random,
    whatever their distribution and the directions of the rays; nearly all on walls, on the ground, and in a bush.
    """
    logs = np.log(ranges)
    off = np.abs(logs[one] - logs[next_to_it])
    on_surface = off <= gap + ALIKE + ALIKE_SIGMA * sigma / ranges[one]
    if (least := 2 * float(on_surface.mean()) - 1) >= enough:
        return least
    ordered = np.sort(logs)
    below, above = np.searchsorted(ordered, logs[one] - off, "right"), np.searchsorted(ordered, logs[one] + off, "left")
    return float(2 * np.where(on_surface, 1.0, 1 - (above - below) / len(ordered)).mean() - 1)


def check_light(frame: StereoFrame, limit: float) -> None:
    """Raise FrameRefused if more than the share `limit` of an image is black or saturated.

    The reason is `too_dark` or `overexposed`.
    """
    for side, image in (("left", frame.left), ("right", frame.right)):
        if not isinstance(image, np.ndarray) or image.dtype != np.uint8 or image.ndim < 2 or not image.size:
            continue  # matching refuses it
        rows = image[:: _step(image)]
        dark, bright = float((rows <= BLACK).mean()), float((rows >= WHITE).mean())
        for share, reason, word in ((dark, "too_dark", "black"), (bright, "overexposed", "saturated")):
            if share > limit:
                detail = f"{share:.0%} of its {side} image is {word} (trust.max_unexposed_share {limit:g})"
                raise FrameRefused(reason, f"{name_of(frame)}: {detail}; set the exposure, or clear the lens")


def _step(image: NDArray) -> int:
    """Return the distance between sampled rows."""
    return max(1, len(image) // ROWS)
