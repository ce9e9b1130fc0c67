# SPDX-License-Identifier: Apache-2.0
"""Views kept along the way, to find it again: which look alike, and whether an image belongs where it seems to fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from stereovox.se3 import Transform, inverse, rotation_vector

GRID = (30, 40)
"""Rows and columns of a view's depths."""
SMALL = (12, 16)
"""Places at which views are compared by their looks."""
FEW, NEAR = 4, 12
"""Views that an image is compared with, the nearest: each time, and where a place must be sure."""
WIDEST = 4.0
"""Half width and half height of the grid at one metre, at most: of a camera that sees farther aside, what is ahead."""
TOLERANCE = 0.04
"""Share of the depth by which what is seen twice may differ, besides four standard deviations."""


class View(NamedTuple):
    """What one image saw. T: T_map_camera (4, 4). depth: GRID metres along the optical axis, NaN where there is none.

    nearest: the least of each place of the grid and those around it, infinity where there is none. points: (N, 3)
    float32 metres, camera frame. sigma: (N,) their standard deviations. slope: (2,) half width and half
    height of the grid at one metre.
    """

    T: Transform
    depth: NDArray[np.float32]
    nearest: NDArray[np.float32]
    points: NDArray[np.float32]
    sigma: NDArray[np.float32]
    slope: NDArray[np.float64]


def view_of(points: NDArray[np.float32], sigma: NDArray[np.float32], T: Transform) -> View:
    """Return the view of an image's patches (N, 3), (N,) from T_map_camera."""
    ahead = points[points[:, 2] > 0]
    slope = np.minimum(np.abs(ahead[:, :2] / ahead[:, 2:]).max(axis=0, initial=0.0), WIDEST) + 1e-6
    view = View(T, np.full(GRID, np.nan, np.float32), np.full(GRID, np.inf, np.float32), points, sigma, slope)
    row, column, inside = _places(view, points)
    order = np.argsort(-points[inside, 2])  # the nearest is written last
    view.depth[row[inside][order], column[inside][order]] = points[inside, 2][order]
    around = np.pad(np.nan_to_num(view.depth, nan=np.inf), 1, constant_values=np.inf)
    view.nearest[:] = sliding_window_view(around, (3, 3)).min(axis=(2, 3))
    return view


def stood_free(
    points: NDArray[np.float32], sigma: NDArray[np.float32], T: Transform, views: list[View]
) -> NDArray[np.bool_]:
    """Return which points (N, 3) of an image at T_map_camera stand where near views saw free space.

    sigma: (N,) their standard deviations.

    What stands there has come since: it moves, or the pose is wrong.
    """
    free = np.zeros(len(points), bool)
    for view in nearest_views(views, T, FEW):
        T_view_camera = inverse(view.T) @ T
        there = points @ T_view_camera[:3, :3].T + T_view_camera[:3, 3]
        row, column, inside = _places(view, there)
        seen = view.nearest[row[inside], column[inside]]
        slack = 4 * sigma[inside] + TOLERANCE * np.where(np.isfinite(seen), seen, 0)
        free[inside] |= np.isfinite(seen) & (there[inside, 2] < seen - slack)
    return free


def nearest_views(views: list[View], T: Transform, number: int) -> list[View]:
    """Return the views from nearest to a pose."""
    if len(views) <= number:
        return views
    away = np.linalg.norm(np.array([view.T[:3, 3] for view in views]) - T[:3, 3], axis=1)
    return [views[i] for i in np.argsort(away, kind="stable")[:number]]


def is_new(poses: list[Transform], T: Transform, metres: float, radians: float) -> bool:
    """Return whether a pose is farther from all others than this."""
    away = np.linalg.norm(np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3) - T[:3, 3], axis=1)
    return all(far_apart(T, poses[i], metres, radians) for i in np.flatnonzero(away <= metres))


def unlike(one: View, other: View) -> float:
    """Return how much two views differ at a few places: median metres, infinity where they share too few."""
    rows, columns = (np.linspace(0, size - 1, small).astype(int) for size, small in zip(GRID, SMALL, strict=True))
    apart = np.abs(one.depth - other.depth)[np.ix_(rows, columns)]
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)) if len(apart) > 0.3 * SMALL[0] * SMALL[1] else np.inf


def far_apart(one: Transform, other: Transform, metres: float, radians: float) -> bool:
    """Return whether two poses are farther apart than this."""
    turn = np.linalg.norm(rotation_vector(one[:3, :3].T @ other[:3, :3]))
    return bool(np.linalg.norm(one[:3, 3] - other[:3, 3]) > metres or turn > radians)


def contradiction(seen: View, views: list[View], deviations: float = 4.0) -> tuple[float, int]:
    """Return the share of what is seen twice that lies where a view looked through, and how many places are seen twice.

    Each way: surfaces of the image in front of what the nearest views saw, and theirs in front of what it sees.
    """
    pairs = [(a, b) for view in nearest_views(views, seen.T, NEAR) for a, b in ((seen, view), (view, seen))]
    through, same = np.sum([_seen_through(a, b, deviations) for a, b in pairs], axis=0) if pairs else (0, 0)
    return through / max(through + same, 1), int(through + same)


def _seen_through(one: View, other: View, deviations: float) -> tuple[int, int]:
    """Return how many points of one view the other looks through, and how many it sees as well."""
    T = inverse(other.T) @ one.T
    points = one.points @ T[:3, :3].T + T[:3, 3]
    row, column, inside = _places(other, points)
    z, seen = points[inside, 2], other.depth[row[inside], column[inside]]
    slack = deviations * one.sigma[inside] + TOLERANCE * seen
    return int((z < seen - slack).sum()), int((np.abs(z - seen) <= slack).sum())


def _places(view: View, points: NDArray[np.floating]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.bool_]]:
    """Return row and column in a view's grid of points (N, 3) in its camera's frame, and which lie in it."""
    inside = points[:, 2] > 0.05
    away = np.where(inside, points[:, 2], 1.0)
    column, row = (
        np.floor((points[:, axis] / away / view.slope[axis] + 1) / 2 * GRID[1 - axis]).astype(np.intp)
        for axis in (0, 1)
    )
    for place, size in ((column, GRID[1]), (row, GRID[0])):
        inside &= (place >= 0) & (place < size)
    return row, column, inside
