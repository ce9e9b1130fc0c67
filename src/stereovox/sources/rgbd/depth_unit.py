# SPDX-License-Identifier: Apache-2.0
"""The unit of depth images without one: found by how well images agree with each other at their poses.

Poses are in metres. If the camera moves sideways or forward, the points of one image fall onto the surfaces in
another only if the depths are in the right unit; a pure rotation does not constrain the unit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.geometry.se3 import Transform, apart, inverse
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
PAIRS, SEARCHED = 8, 60
"""Pairs of images that are compared, and most images after the first of a pair that are searched for the second."""
MOVED_M, TURNED = 0.3, 0.5
"""Metres that the camera should have moved between the images of a pair, and most radians it may have turned."""
POINTS_ACROSS = 80
"""Points across an image that are compared."""
CLEARLY = 0.8, 1.25
"""A unit clearly beats another if it fits better in this share of the pairs, and this many times better overall."""
FEW_PAIRS = 1.0, 2.5
"""The same for fewer pairs than `MIN_PAIRS`."""
MIN_PAIRS = 3
OVERLAP = 0.2
"""Share of an image's points that must be visible in another for a comparison."""
STILL = 1e6
"""A unit so large that the camera appears not to move."""
WORST = 0.06
"""Largest median relative difference of depths of images that agree."""
LIKELY_M = 0.25, 40.0
"""Plausible median depths of a scene in metres, used if there is no other evidence."""

TUM_UNIT, ROOM_M = 1 / 5000, (0.7, 8.0)
"""TUM's unit, and usual median depths of images of rooms."""
IN_FIVES, FIVES_FROM = 0.999, 2500.0
"""Share of values that are multiples of five, and their smallest median, that identify TUM's unit."""


class DepthUnit(NamedTuple):
    """Unit of depth images.

    scale: metres per unit. sure: whether the images themselves confirm it. why: the evidence, in words.
    plausible: whether the median depth is one that scenes usually have.
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
        expected: Metres per unit by convention, kept unless the images contradict it.

    Returns:
        The unit: other than `expected` only if it is certain, and half the depths are not kilometres away: images
        in millimetres whose poses are in millimetres too agree in metres.
    """
    units = [expected, *(unit for unit in UNITS if abs(unit / expected - 1) > 1e-6)]
    tried = [*units, STILL]  # last: as if the camera had not moved, which pose noise favours
    medians = np.array([[_median(first, second, camera, unit) for unit in tried] for first, second in pairs])
    if not len(pairs) or not np.isfinite(medians).any():
        return _unchecked(pairs, expected)
    best = int(np.argmin(np.median(medians, axis=0)[:-1]))
    beaten = [_beats(medians[:, best], medians[:, k]) for k in range(len(tried)) if k != best]
    fits = float(np.median(medians[:, best]))
    moves = np.mean(medians[:, best] < medians[:, -1]) >= CLEARLY[0]
    if fits > WORST or not moves or (best and not _beats(medians[:, best], medians[:, 0])):
        return _unchecked(pairs, expected)
    second = float(np.delete(np.median(medians, axis=0), best).min())
    why = f"depths differ by {100 * fits:.1f} % from image to image, in any other unit by {_percent(second)}"
    far = _middle(pairs, units[best])
    if far <= LIKELY_M[1]:
        return DepthUnit(units[best], all(beaten), why)
    if best:
        return _unchecked(pairs, expected)
    return DepthUnit(expected, all(beaten), f"{why}; but half the depths are beyond {far:.3g} m", False)


def unit_by_values(images: Sequence[Depth], expected: float, told: bool = False) -> DepthUnit:
    """Find the unit of images without poses by their values alone: millimetres, TUM's 1/5000 m, or the expected one.

    TUM's images of real cameras are millimetres times five. Any other choice is not certain, unless the expected unit
    is `told` by the recording; floats are metres.
    """
    if told or all(image.dtype.kind == "f" for image in images):
        return DepthUnit(expected, True, "as the recording says")
    values = np.concatenate([np.empty(0), *(image[_usable(image)] for image in images if image.dtype.kind in "ui")])
    if not len(values):
        return DepthUnit(expected, False, "no image has a value")
    if np.mean(values % 5 == 0) > IN_FIVES and float(np.median(values)) > FIVES_FROM:
        return DepthUnit(TUM_UNIT, True, "all values are multiples of five")
    units = [expected, *(unit for unit in (0.001, TUM_UNIT) if unit != expected and expected in (0.001, TUM_UNIT))]
    middles = [float(np.median(values)) * unit for unit in units]
    usual = next((k for k, middle in enumerate(middles) if ROOM_M[0] <= middle <= ROOM_M[1]), 0)
    why = f"half the depths are then below {middles[usual]:.3g} m, and nothing else can check it"
    return DepthUnit(units[usual], False, why, ROOM_M[0] <= middles[usual] <= ROOM_M[1])


def _percent(share: float) -> str:
    return f"{100 * share:.1f} % or more" if np.isfinite(share) else "far more"


def _beats(one: NDArray[np.float64], other: NDArray[np.float64]) -> bool:
    """Return whether the medians (pairs,) of one unit are clearly less than another's."""
    wins, less = CLEARLY if len(one) >= MIN_PAIRS else FEW_PAIRS
    return bool(np.mean(one < other) >= wins and less * np.median(one) < np.median(other))


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
            continue  # reported when it is read
    return found


def _second(first: int, count: int, pose: Callable[[int], Transform]) -> int | None:
    """Return the number of the next image taken far enough away, None if missing."""
    best, farthest = None, 0.1 * MOVED_M
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


def _median(first: View, second: View, camera: PinholeCamera, unit: float) -> float:
    """Return the median relative difference of two images at their common points; inf if they share few."""
    T_second_first = inverse(second.T_world_camera) @ first.T_world_camera
    differences, points = difference(first.depth, second.depth, camera, T_second_first, unit)
    return float(np.median(differences)) if len(differences) > OVERLAP * points else np.inf


def difference(
    depth: Depth, other: Depth, camera: PinholeCamera, T_other_this: Transform, unit: float
) -> tuple[NDArray[np.float64], int]:
    """Return the relative differences between the depths of one image's points and another image.

    depth, other: (height, width), times `unit` metres; 0, negative, not finite and 65535 in uint16: no value.
    Returns the differences (K,) of common points, and the number of points of the first.
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


def is_likely(pairs: Sequence[tuple[View, View]], unit: float) -> bool:
    """Return whether the median depth is usual for a scene."""
    return LIKELY_M[0] <= _middle(pairs, unit) <= LIKELY_M[1]


def _middle(pairs: Sequence[tuple[View, View]], unit: float) -> float:
    """Return the median depth in metres, NaN if missing."""
    depths = [view.depth[_usable(view.depth)] for pair in pairs for view in pair]
    return float(np.median(np.concatenate(depths))) * unit if any(map(len, depths)) else np.nan


def _unchecked(pairs: Sequence[tuple[View, View]], expected: float) -> DepthUnit:
    """Return the expected unit, judged by the range of the depths."""
    middle = _middle(pairs, expected)
    if np.isnan(middle):
        return DepthUnit(expected, False, "no two posed images are far enough apart to check it")
    plausible = LIKELY_M[0] <= middle <= LIKELY_M[1]
    why = f"half the depths are below {middle:.3g} m" + ("" if plausible else ", which is unusual")
    return DepthUnit(expected, False, why, plausible)
