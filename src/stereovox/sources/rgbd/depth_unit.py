# SPDX-License-Identifier: Apache-2.0
"""The unit of depth images that do not say it: found by how well images agree with each other at their poses.

Poses are in metres. Where the camera moves sideways or forward, the points of one image fall onto the surfaces that
another sees only if the depths are in the right unit; a turn alone says nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.se3 import Transform, apart, inverse
from stereovox.sources.rgbd.depth_files import Depth

UNITS = {
    1.0: "metres",
    1 / 100: "centimetres",
    1 / 256: "1/256 m (KITTI)",
    1 / 1000: "millimetres",
    1 / 4000: "1/4000 m",
    1 / 5000: "1/5000 m (TUM)",
    1 / 6553.5: "1/6553.5 m (Replica)",
    1 / 10000: "1/10000 m",
}
"""Usual units of depth images, in metres."""
PAIRS, SEARCHED = 6, 60
"""Pairs of images that are compared, and most images after the first of a pair in which the second is looked for."""
MOVED_M, TURNED = 0.15, 0.6
"""Metres that the camera should have moved between the images of a pair, and radians it may have turned."""
POINTS_ACROSS = 80
"""Points of an image, across, that are compared."""
AGREES = 0.03
"""Relative difference of depths that are of the same surface."""
SURE = 0.4, 1.15, 2.0
"""Share of points that must agree, how many times more than in any other unit, and how many times less the median
difference must be."""
LIKELY_M = 0.25, 40.0
"""Median depth in metres of a scene that a unit is plausible for, where there is nothing else to go by."""


class DepthUnit(NamedTuple):
    """Unit of depth images.

    scale: metres per unit. sure: whether the images themselves confirm it. why: what speaks for it, in words.
    plausible: whether half of the depths are nearer than a distance that scenes usually have.
    """

    scale: float
    sure: bool
    why: str
    plausible: bool = True

    @property
    def words(self) -> str:
        """The unit in words."""
        return unit_words(self.scale)


class View(NamedTuple):
    """An image and its pose: depth (height, width) in its own unit, T_world_camera (4, 4) metres."""

    depth: Depth
    T_world_camera: Transform


def unit_words(scale: float) -> str:
    """Return metres per unit in words."""
    known = next((words for unit, words in UNITS.items() if abs(scale / unit - 1) < 1e-6), None)
    return known or (f"1/{1 / scale:g} m" if scale < 1 else f"{scale:g} m")


def find_unit(pairs: Sequence[tuple[View, View]], camera: PinholeCamera, expected: float) -> DepthUnit:
    """Find the unit in which images agree with each other.

    Args:
        pairs: Images of the same place, see `pairs_of`.
        camera: The camera of all.
        expected: Metres per unit by convention, kept where the images do not contradict it.

    Returns:
        The unit: another than `expected` only where it is sure.
    """
    units = [expected, *(unit for unit in UNITS if abs(unit / expected - 1) > 1e-6)]
    found = [_differences(pairs, camera, unit) for unit in units]
    medians = np.array([np.median(differences) if len(differences) else np.inf for differences, _ in found])
    agree = np.array([np.sum(differences < AGREES) / max(points, 1) for differences, points in found])
    best = int(np.argmax(agree))
    needed, more, less = SURE
    others, differ = np.delete(agree, best).max(), np.delete(medians, best).min()
    if agree[best] >= max(needed, more * others) and differ > less * max(medians[best], 1e-4):
        why = f"{100 * agree[best]:.0f} % of the points agree from image to image, in other units {100 * others:.0f} %"
        return DepthUnit(units[best], True, why)
    return _unchecked(pairs, expected)


def pairs_of(count: int, pose: Callable[[int], Transform], read: Callable[[int], Depth]) -> list[tuple[View, View]]:
    """Return pairs of images between which the camera moved enough, spread over a recording of `count` images.

    pose, read: pose and image by number; both may raise FrameRefused.
    """
    found = []
    for first in np.unique(np.linspace(0, count - 1, PAIRS + 1).astype(int))[:-1].tolist():
        second = _second(first, count, pose)
        try:
            if second is not None:
                found.append((View(read(first), pose(first)), View(read(second), pose(second))))
        except FrameRefused:
            continue  # it is reported when its turn comes
    return found


def _second(first: int, count: int, pose: Callable[[int], Transform]) -> int | None:
    """Return the number of the next image that was taken far enough away, None where there is none."""
    best, farthest = None, 0.2 * MOVED_M
    try:
        start = _numbers(pose(first))
    except FrameRefused:
        return None
    for number in range(first + 1, min(count, first + SEARCHED)):
        try:
            moved, turned = apart(start, _numbers(pose(number)))
        except FrameRefused:
            continue
        if not turned <= TURNED:
            continue
        if moved > farthest:
            best, farthest = number, moved
        if moved >= MOVED_M:
            break
    return best


def _numbers(T: Transform) -> tuple[float, ...]:
    return tuple(T[:3].ravel().tolist())


def _differences(
    pairs: Sequence[tuple[View, View]], camera: PinholeCamera, unit: float
) -> tuple[NDArray[np.float64], int]:
    """Return relative differences (K,) of depths of points seen twice, and the number of all points."""
    found, points = [np.empty(0)], 0
    for first, second in pairs:
        T_second_first = inverse(second.T_world_camera) @ first.T_world_camera
        differences, of = difference(first.depth, second.depth, camera, T_second_first, unit)
        found.append(differences)
        points += of
    return np.concatenate(found), points


def difference(
    depth: Depth, other: Depth, camera: PinholeCamera, T_other_this: Transform, unit: float
) -> tuple[NDArray[np.float64], int]:
    """Return by how much the depths of points of one image differ from what another image shows there.

    depth, other: (height, width), times `unit` metres; 0, negative, not finite and 65535 in uint16: no value.
    Returns relative differences (K,) of the points that both show, and the number of points of the first.
    """
    step = max(1, depth.shape[1] // POINTS_ACROSS)
    v, u = (index.ravel() for index in np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step])
    usable = _usable(depth[v, u])
    v, u = v[usable], u[usable]
    z = depth[v, u].astype(float) * unit
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
    x, y, z = (points @ T_other_this[:3, :3].T + T_other_this[:3, 3]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
        inside = (z > 0) & (abs(column - camera.width / 2) < camera.width / 2 - 1)
        inside &= abs(row - camera.height / 2) < camera.height / 2 - 1
    seen = other[np.rint(row[inside]).astype(int), np.rint(column[inside]).astype(int)]
    both = _usable(seen)
    there = seen[both].astype(float) * unit
    return np.abs(z[inside][both] - there) / there, len(u)


def _usable(depth: Depth) -> NDArray[np.bool_]:
    usable = np.isfinite(depth) & (depth > 0)
    return usable & (depth < 65535) if depth.dtype == np.uint16 else usable


def _unchecked(pairs: Sequence[tuple[View, View]], expected: float) -> DepthUnit:
    """Return the expected unit, with what the range of the depths says about it."""
    depths = [view.depth[_usable(view.depth)] for pair in pairs for view in pair]
    if not any(map(len, depths)):
        return DepthUnit(expected, False, "no two posed images are far enough apart to check it")
    middle = float(np.median(np.concatenate(depths))) * expected
    plausible = LIKELY_M[0] <= middle <= LIKELY_M[1]
    why = f"half the depths are below {middle:.3g} m" + ("" if plausible else ", which is unusual")
    return DepthUnit(expected, False, why, plausible)
