# SPDX-License-Identifier: Apache-2.0
"""Check whether a ball can move along a path, where it is blocked, and how old the evidence is."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.query.queries import points_of

HALVINGS = 48
"""Bisection steps in the search for a place on a segment."""
PIECE = 8
"""Segments are searched for cell ages in pieces of this many cells, or of the radius if that is more."""


class PathCheck(NamedTuple):
    """The check of a path of N segments against a map.

    Attributes:
        worst: (N,) uint8, the worst `State` that the ball touches on each segment (`check_capsules`).
        blocked_at: Metres along the path until the ball touches a blocking cell; None if it reaches the end.
        oldest_s: (N,) float32 seconds since the last evidence of the stalest known cell that a segment touches; NaN
            if it touches none. None if the map keeps no times.
    """

    worst: NDArray[np.uint8]
    blocked_at: float | None
    oldest_s: NDArray[np.float32] | None

    @property
    def free(self) -> bool:
        """Whether nothing blocks the path."""
        return self.blocked_at is None


@one_state
def check_path(
    voxel_map: VoxelMap,
    waypoints: ArrayLike,
    radius: float,
    through_unknown: bool = False,
    now_ns: int | None = None,
) -> PathCheck:
    """Check whether a ball can move along a path.

    Occupied, tentative and unknown cells block it.

    Args:
        voxel_map: The map.
        waypoints: (N + 1, 3) metres, world frame.
        radius: Radius of the ball in metres.
        through_unknown: Unknown cells do not block.
        now_ns: Time at which ages are taken; None: the map's last frame.

    Returns:
        The result for each segment.

    Raises:
        StereovoxError: Fewer than two waypoints or other bad input.
    """
    points = points_of(waypoints, "waypoints").astype(float)
    if len(points) < 2:
        raise StereovoxError(f"waypoints: {len(points)} of them make no path; give two or more")
    worst = voxel_map.check_capsules(points[:-1], points[1:], radius)
    blocking = [State.OCCUPIED, State.TENTATIVE] + ([] if through_unknown else [State.UNKNOWN])
    stopped = np.flatnonzero(np.isin(worst, blocking))
    blocked_at = None
    if len(stopped):
        lengths, first = np.linalg.norm(np.diff(points, axis=0), axis=1), stopped[0]
        share = _free_share(voxel_map, points[first], points[first + 1], radius, blocking)
        blocked_at = float(lengths[:first].sum() + share * lengths[first])
    return PathCheck(worst, blocked_at, _oldest(voxel_map, points, radius, now_ns))


def point_along(waypoints: ArrayLike, metres: float) -> NDArray[np.float64]:
    """Return the point (3,) that many metres along a path (N, 3); its end if the path is shorter."""
    points = points_of(waypoints, "waypoints").astype(float)
    at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    return np.array([np.interp(metres, at, points[:, axis]) for axis in range(3)])


def path_length(path: NDArray[np.floating]) -> float:
    """Return the length of a path (N, 3) in metres."""
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


def _free_share(
    voxel_map: VoxelMap, start: NDArray[np.float64], end: NDArray[np.float64], radius: float, blocking: list[State]
) -> float:
    """Return the share of a blocked segment, 0 to 1, that the ball can travel."""
    if voxel_map.check_capsules(start, start, radius)[0] in blocking:
        return 0.0
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        if voxel_map.check_capsules(start, start + middle * (end - start), radius)[0] in blocking:
            high = middle
        else:
            low = middle
    return low


def _oldest(
    voxel_map: VoxelMap, points: NDArray[np.float64], radius: float, now_ns: int | None
) -> NDArray[np.float32] | None:
    """Return the age (N,) in seconds of the oldest evidence that each segment touches, None if no times are kept."""
    if not voxel_map.config.map.keep_times:
        return None
    cell, bounds = np.array(voxel_map.config.cell), voxel_map.bounds()
    oldest = np.full(len(points) - 1, np.nan, np.float32)
    for n, (start, end) in enumerate(pairwise(points) if bounds is not None else ()):
        for cells in _touched(cell, np.asarray(bounds), start, end, radius):
            ages = voxel_map.age((cells + 0.5) * cell, now_ns)
            oldest[n] = np.fmax.reduce(ages, initial=oldest[n])
    return oldest


def _touched(
    cell: NDArray[np.float64],
    bounds: NDArray[np.float64],
    start: NDArray[np.float64],
    end: NDArray[np.float64],
    radius: float,
) -> Iterator[NDArray[np.int64]]:
    """Yield the cells (n, 3) within `bounds` (2, 3) that a capsule touches, piece by piece; some of them twice."""
    first, last = _within(bounds + np.array([[-radius], [radius]]), start, end)
    if first > last:
        return
    start, end = start + first * (end - start), start + last * (end - start)
    pieces = 1 + int(np.linalg.norm(end - start) / max(PIECE * cell.max(), radius))
    lowest, highest = np.rint(bounds / cell).astype(np.int64)
    for a, b in pairwise(np.linspace(start, end, 1 + pieces)):
        low = np.maximum(np.floor((np.minimum(a, b) - radius) / cell).astype(np.int64), lowest)
        high = np.minimum(np.floor((np.maximum(a, b) + radius) / cell).astype(np.int64) + 1, highest)
        cells = low + np.indices(np.maximum(high - low, 0)).reshape(3, -1).T
        yield cells[_away(a, b, cells * cell, (cells + 1) * cell) <= radius]


def _within(box: NDArray[np.float64], start: NDArray[np.float64], end: NDArray[np.float64]) -> tuple[float, float]:
    """Return the interval, within 0 to 1, of a segment in a box (2, 3); the first is larger if it misses the box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = np.sort((box - start) / (end - start), axis=0)
    level = start == end
    crossings[:, level] = np.where(((box[0] <= start) & (start <= box[1]))[level], [[0.0], [1.0]], [[1.0], [0.0]])
    return max(0.0, float(crossings[0].max())), min(1.0, float(crossings[1].min()))


def _away(
    a: NDArray[np.float64], b: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the distance (n,) of boxes low..high (n, 3) from a segment: at the zero of its derivative."""
    before, after = np.zeros((len(low), 1)), np.ones((len(low), 1))
    for _ in range(HALVINGS):
        middle = (before + after) / 2
        place = a + middle * (b - a)
        falls = ((place - np.clip(place, low, high)) @ (b - a) < 0)[:, None]
        before, after = np.where(falls, middle, before), np.where(falls, after, middle)
    place = a + after * (b - a)
    return np.linalg.norm(place - np.clip(place, low, high), axis=1)
