# SPDX-License-Identifier: Apache-2.0
"""Views kept for relocalization: which are similar, and whether an image belongs where it seems to fit."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform, inverse, rotation_matrix, rotation_vector
from stereovox.track import _sightings

GRID = (30, 40)
"""Rows and columns of a view's depths."""
SMALL = (12, 16)
"""Grid on which the similarity of views is computed."""
FEW, NEAR = 4, 12
"""Number of nearest views that an image is compared with: usually, and when a place must be certain."""
WIDEST = 4.0
"""Half width and half height of the grid at one metre, at most: of a wider camera, the part ahead."""
TOLERANCE = 0.04
"""Share of the depth by which two observations may differ, besides four standard deviations."""
DEVIATIONS, SLACK = np.float32(4), np.float32(TOLERANCE)
EDGE, SAME = 3, 0.06
"""Radius in the grid within which neighbours of moving points move too, and largest relative depth difference."""
TURNED_M = 2.0
"""Metres added to a view's distance if it looks across; twice that if it looks back."""


class View(NamedTuple):
    """The depths of one image. T: T_map_camera (4, 4). depth: GRID metres along the optical axis, NaN if missing.

    nearest: the least depth in each place of the grid and its neighbours, infinity if none. points: (N, 3)
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
    """Return which points (N, 3) of an image at T_map_camera are in the free space of near views.

    sigma: (N,) their standard deviations.

    Such a point has moved there since, or the pose is wrong.
    """
    free = np.zeros(len(points), bool)
    for view in nearest_views(views, T, FEW):
        _sightings.stood_free(points, sigma, *_into(view, T), view.nearest, DEVIATIONS, SLACK, free)
    return free


def with_edges(free: NDArray[np.bool_], points: NDArray[np.float32], T: Transform) -> NDArray[np.bool_]:
    """Return which points (N, 3) of an image are `free`, or lie next to one on what seems to be the same object.

    Views have holes and coarse depths: parts of a person who walks in are where no view looked before.
    """
    view = view_of(points, np.zeros(len(points), np.float32), T)
    row, column, inside = _places(view, points)
    moving = np.full(GRID, np.nan)
    moving[row[inside & free], column[inside & free]] = points[inside & free, 2]
    for _ in range(EDGE):
        around = sliding_window_view(np.pad(moving, 1, constant_values=np.nan), (3, 3)).reshape(*GRID, 9)
        apart = np.abs(around - view.depth[..., None]) < SAME * view.depth[..., None]
        moving = np.where(np.isnan(moving) & apart.any(axis=2), view.depth, moving)
    there = np.where(inside, moving[np.where(inside, row, 0), np.where(inside, column, 0)], np.nan)
    return free | (np.abs(there - points[:, 2]) < SAME * points[:, 2])


def passed_through(here: View, views: list[View], number: int, step: int = 1) -> float:
    """Return the share of the nearest views' surfaces that an image looks through, of all that it sees again."""
    found = np.array(
        [_seen_through(view, here, float(DEVIATIONS), step) for view in nearest_views(views, here.T, number)]
    )
    return float(found[:, 0].sum() / max(found.sum(), 1)) if len(found) else 0.0


def nearest_views(views: list[View], T: Transform, number: int) -> list[View]:
    """Return the views nearest to a pose, by distance and viewing direction (`TURNED_M`)."""
    if len(views) <= number:
        return views
    poses = np.array([view.T[:3, 2:] for view in views])
    away = np.linalg.norm(poses[:, :, 1] - T[:3, 3], axis=1) + TURNED_M * (1 - poses[:, :, 0] @ T[:3, 2])
    return [views[i] for i in np.argsort(away, kind="stable")[:number]]


def is_new(poses: list[Transform], T: Transform, metres: float, radians: float) -> bool:
    """Return whether a pose is farther than this from all others."""
    away = np.linalg.norm(np.array([pose[:3, 3] for pose in poses]).reshape(-1, 3) - T[:3, 3], axis=1)
    return all(far_apart(T, poses[i], metres, radians) for i in np.flatnonzero(away <= metres))


def unlike(one: View, other: View) -> float:
    """Return how much two views differ at a few places: median metres, infinity if they share too few."""
    rows, columns = (np.linspace(0, size - 1, small).astype(int) for size, small in zip(GRID, SMALL, strict=True))
    apart = np.abs(one.depth - other.depth)[np.ix_(rows, columns)]
    apart = apart[np.isfinite(apart)]
    return float(np.median(apart)) if len(apart) > 0.3 * SMALL[0] * SMALL[1] else np.inf


def far_apart(one: Transform, other: Transform, metres: float, radians: float) -> bool:
    """Return whether two poses are farther apart than this."""
    turn = np.linalg.norm(rotation_vector(one[:3, :3].T @ other[:3, :3]))
    return bool(np.linalg.norm(one[:3, 3] - other[:3, 3]) > metres or turn > radians)


def turned(T: Transform, angles: NDArray[np.float64]) -> list[Transform]:
    """Return a camera's pose turned by angles in radians about the axis that points down in its image."""
    out = []
    for angle in angles:
        aside = np.eye(4)
        aside[:3, :3] = rotation_matrix([0.0, angle, 0.0])
        out.append(T @ aside)
    return out


def contradiction(seen: View, views: list[View], deviations: float = 4.0) -> tuple[float, int]:
    """Return the share of twice-seen places that lie in a view's free space, and how many are seen twice.

    Both directions count: surfaces of the image in front of the nearest views', and theirs in front of its own.
    """
    pairs = [(a, b) for view in nearest_views(views, seen.T, NEAR) for a, b in ((seen, view), (view, seen))]
    through, same = np.sum([_seen_through(a, b, deviations) for a, b in pairs], axis=0) if pairs else (0, 0)
    return through / max(through + same, 1), int(through + same)


def _seen_through(one: View, other: View, deviations: float, step: int = 1) -> tuple[int, int]:
    """Return how many of every `step`th point of one view the other looks through, and how many it confirms."""
    found = np.zeros(2, np.int64)
    into = _into(other, one.T)
    _sightings.seen_through(one.points, one.sigma, *into, other.depth, np.float32(deviations), SLACK, step, found)
    return int(found[0]), int(found[1])


def _into(view: View, T: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return rotation and shift from a camera at T_map_camera into a view's, and the view's slope."""
    T_view_camera = inverse(view.T) @ T
    return np.ascontiguousarray(T_view_camera[:3, :3]), np.ascontiguousarray(T_view_camera[:3, 3]), view.slope


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
