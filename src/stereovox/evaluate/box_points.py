# SPDX-License-Identifier: Apache-2.0
"""Which points lie in an annotated box (Valenti 2018, Appendix A)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry import transform_points
from stereovox.sources.lidar import Box

Corners = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]
"""p0 and its three neighbours p1, p3, p4 along the edges of a box; (3,) each."""


def inside(points: NDArray[np.floating], corners: Corners) -> NDArray[np.bool_]:
    """Tell which points (N, 3) lie in the box with these corners, its faces included (Valenti 2018, Eq A.1-A.3).

    As printed the test can never hold: u, v and w cannot all three point from p0 to the other corners, whatever their
    order, since (p0 - p1) x (p0 - p4) is the negative of what is meant, and Eq A.2 compares x, y, z where p belongs.
    Here v is turned round, and all three where the corners follow each other left-handed.
    """
    p0, p1, p3, p4 = corners
    a, b, c = p1 - p0, p3 - p0, p4 - p0
    hand = np.sign(np.dot(np.cross(a, b), c))
    found = np.ones(len(points), bool)
    for normal, far in ((np.cross(b, c), p1), (np.cross(c, a), p3), (np.cross(a, b), p4)):
        along = points @ (hand * normal)
        found &= (along >= hand * normal @ p0) & (along <= hand * normal @ far)
    return found


def corners_of(box: Box, margin: float = 0.0) -> Corners:
    """Return four corners of `box` in the world, grown by `margin` metres on each side."""
    half = np.array(box.size) / 2 + margin
    signs = [(-1, -1, -1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
    p0, p1, p3, p4 = transform_points(box.T_world_box, signs * half)
    return p0, p1, p3, p4


def in_any_box(points: NDArray[np.floating], boxes: Iterable[Box], margin: float = 0.0) -> NDArray[np.bool_]:
    """Tell which points (N, 3), metres in the world, lie in one of `boxes` grown by `margin` metres on each side."""
    found = np.zeros(len(points), bool)
    for box in boxes:
        found |= inside(points, corners_of(box, margin))
    return found
