# SPDX-License-Identifier: Apache-2.0
"""Checks whether poses belong to their images or clouds, by how well these agree with each other at their poses.

Poses that are inverted, of a camera with other axes, or not in metres put each surface in another place from image to
image. If the images agree under another reading of the same poses, that reading is right.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.poses.tracker import AXES
from stereovox.sources.rgbd.depth_files import Depth
from stereovox.sources.rgbd.depth_unit import View, difference, find_unit, is_likely, pairs_of
from stereovox.sources.rgbd.pose_files import in_optical_axes, in_other_hand

if TYPE_CHECKING:
    from scipy.spatial import KDTree

POSE_SCALES = (1.0, 0.001, 0.01)
"""Metres per unit of poses that are tried."""
AGREES = 0.03
"""Largest relative difference of depths on the same surface."""
FAR_OFF, FEW, SEEN_TWICE = 0.06, 0.25, 0.1
"""Poses do not fit if the median relative difference of depths is larger, a smaller share of the points agrees, and
at least this share is visible in both images, so that the result is significant."""
BETTER, CLOSER, ENOUGH = 1.5, 2.0, 0.2
"""Factor by which more points must agree under another reading of the poses, factor by which the median difference must
be smaller, and the smallest share of all points that must agree."""
MIN_PAIRS = 2
"""Pairs of images needed to support another reading."""
SURELY = 0.4
"""Share of the points that must agree before no other unit is tried."""
SAME = 0.5
"""Share of the points that stay in place in images of a static camera."""
CLOUD_PAIRS, LATER, CLOUD_TURN, KEPT, ASKED, FEW_POINTS = 6, 10, 0.15, 20_000, 500, 100
"""Pairs of clouds that are compared, at most how much later the second is and by how many radians it turned, and points
of each: kept, compared, and least."""
NEIGHBOURS, FLAT = 8, 0.1
"""Points of a local plane, and least ratio of its second to its first variance."""
SURE_PAIRS, CLOUDS_MOVE, OFF_SURFACE = 0.7, 1.2, 0.1
"""Share of the pairs that must support another reading, by how much it must fit better than a lidar at rest, and metres
by which points are off if a lidar at rest fits better: on a straight road its rings always do."""
OFF_LEVEL, ALL_ABOVE = 0.3, 0.9
"""Metres by which points are above or below a lidar, and by how much more are above if it is upside down."""


class Reading(NamedTuple):
    """Interpretation of poses.

    axes: a key of `AXES`. invert: whether they are world to camera. poses_scale: metres per unit of their positions.
    """

    axes: str = "optical"
    invert: bool = False
    poses_scale: float = 1.0

    def pose(self, T: Transform) -> Transform:
        """Return T_world_camera (4, 4) in metres and optical axes from a pose (4, 4) as in a file."""
        if self == Reading():
            return T
        scaled = T.copy()
        scaled[:3, 3] *= self.poses_scale
        return in_optical_axes(scaled, self.axes, self.invert)

    def options(self, other: Reading) -> str:
        """Return the options behind a folder's name that change this reading into another."""
        changes = {"invert": "01"[other.invert], "axes": other.axes, "poses_scale": f"{other.poses_scale:g}"}
        return "&".join(f"{key}={text}" for key, text in changes.items() if getattr(self, key) != getattr(other, key))


class Images(NamedTuple):
    """The images of a recording.

    number: their number. pose: pose (4, 4) by number as in the file; read: image by number; both may raise
    FrameRefused. camera: the camera of all.
    """

    number: int
    pose: Callable[[int], Transform]
    read: Callable[[int], Depth]
    camera: PinholeCamera

    def pairs(self, reading: Reading) -> list[tuple[View, View]]:
        """Return pairs of images at their poses, see `pairs_of`."""
        return pairs_of(self.number, lambda i: reading.pose(self.pose(i)), self.read)

    def mirrored(self) -> Images:
        """Return the same with poses of a camera whose y points up, in a left-handed world (or the reverse)."""
        return self._replace(pose=lambda i: in_other_hand(self.pose(i)))


class Agreement(NamedTuple):
    """Agreement of images with each other.

    share: of all points, those with the expected depth in the other image. median: of the relative differences of
    depths, infinity without any. seen: share of the points visible in both images.
    """

    share: float
    median: float
    seen: float


def misfit(images: Images, unit: float, expected: float, now: Reading) -> str:
    """Report that poses do not fit the images, and how to read them so that they do.

    Args:
        images: The images and their poses.
        unit: Metres per unit of the images, as found.
        expected: The same by convention.
        now: The current reading of the poses.

    Returns:
        The problem and a suggestion, in words; "" if the poses are plausible.
    """
    pairs = images.pairs(now)
    if not pairs:
        return _standing(images, unit, now)
    usual = agreement(pairs, images.camera, expected)
    if usual.share * BETTER > 1:
        return ""
    as_it_is = usual if unit == expected else agreement(pairs, images.camera, unit)
    words = f"poses do not fit the images: only {100 * as_it_is.share:.0f} % of the points agree from image to image"
    better = _better(images, expected, now)
    if better is not None:
        reading, scale, found = better
        same = usual if reading == now else agreement(pairs, images.camera, scale)
        if found.share > max(as_it_is.share, BETTER * same.share) and same.median > CLOSER * found.median:
            options = [now.options(reading), "" if scale == expected else f"depth_scale={1 / scale:g}"]
            return f"{words}; try ?{'&'.join(filter(None, options))}, with which {100 * found.share:.0f} % agree"
    mirrored = _best(images.camera, [(now, expected, images.mirrored().pairs(now))])
    if mirrored is not None and mirrored[2].share > max(as_it_is.share, BETTER * usual.share):
        share = f"{100 * mirrored[2].share:.0f} %"
        return f"{words}; try a camera file with fy below 0, for poses of a left-handed world, with which {share} agree"
    if as_it_is.median > FAR_OFF and as_it_is.share < FEW and as_it_is.seen > SEEN_TWICE:
        return f"{words}; check that poses, camera and depth unit belong to these images"
    return ""


def agreement(pairs: Sequence[tuple[View, View]], camera: PinholeCamera, unit: float) -> Agreement:
    """Return how well images of pairs agree if their unit is `unit` metres."""
    found, points = [np.empty(0)], 0
    for first, second in pairs:
        T_second_first = inverse(second.T_world_camera) @ first.T_world_camera
        differ, of = difference(first.depth, second.depth, camera, T_second_first, unit)
        found.append(differ)
        points += of
    differ = np.concatenate(found)
    median = float(np.median(differ)) if len(differ) else np.inf
    return Agreement(float(np.sum(differ < AGREES)) / max(points, 1), median, len(differ) / max(points, 1))


def _better(images: Images, expected: float, now: Reading) -> tuple[Reading, float, Agreement] | None:
    """Return the other reading of the poses, and unit of the images, that agree best; None without any.

    Units other than `expected` are tried if that fits poorly, and accepted if the images confirm them.
    """
    readings = [Reading(*names) for names in product(AXES, (False, True), POSE_SCALES)]
    found = [(reading, expected, images.pairs(reading)) for reading in readings if reading != now]
    best = _best(images.camera, found)
    if best is None or best[2].share < SURELY:
        units = [(reading, find_unit(pairs, images.camera, expected), pairs) for reading, _, pairs in found if pairs]
        units += [(now, find_unit(images.pairs(now), images.camera, expected), images.pairs(now))]
        others = _best(images.camera, [(reading, unit.scale, pairs) for reading, unit, pairs in units if unit.sure])
        best = max((one for one in (best, others) if one is not None), key=lambda one: one[2].share, default=None)
    return best


def _best(
    camera: PinholeCamera, tried: Sequence[tuple[Reading, float, list[tuple[View, View]]]]
) -> tuple[Reading, float, Agreement] | None:
    best: tuple[Reading, float, Agreement] | None = None
    for reading, unit, pairs in tried:
        found = agreement(pairs, camera, unit)
        fits = len(pairs) >= MIN_PAIRS and found.median < AGREES and found.share > ENOUGH and is_likely(pairs, unit)
        if fits and (best is None or found.share > best[2].share):
            best = reading, unit, found
    return best


def _standing(images: Images, unit: float, now: Reading) -> str:
    """Report that poses stand still while the images change; "" otherwise."""
    last = images.number - 1
    try:
        first, *others = [View(images.read(i), now.pose(images.pose(i))) for i in sorted({0, last // 2, last})]
    except FrameRefused:
        return ""
    alike = [np.allclose(first.T_world_camera, view.T_world_camera, atol=1e-6) for view in others]
    found = agreement([(first, view) for view in others], images.camera, unit)
    if not others or not all(alike) or not found.seen or found.share > SAME * found.seen:
        return ""
    return (
        f"poses are all equal, but the images change: only {100 * found.share / found.seen:.0f} % of the points stay "
        "in place; give the poses of a moving camera"
    )


def clouds_misfit(read: Callable[[int], NDArray[np.floating]], raw: Callable[[int], Transform], count: int,
                  now: CloudReading) -> str:  # fmt: skip
    """Report that poses do not fit clouds, and under which other reading they do; "" if they fit or nothing shows it.

    Args:
        read: Points (N, 3) in the lidar's frame, by number; may raise FrameRefused.
        raw: Pose of the body (4, 4) as in the file, by number; may raise FrameRefused.
        count: Number of clouds.
        now: The current reading of the poses.
    """
    from scipy.spatial import KDTree

    pairs, below = [], list[float]()
    for first in np.unique(np.linspace(0, count - 2, CLOUD_PAIRS).astype(int)).tolist() if count > 1 else []:
        with suppress(FrameRefused):
            second = _next_turned(first, count, raw)
            ours, theirs = (_some(read(i)) for i in (first, second))
            if min(len(ours), len(theirs)) >= FEW_POINTS:
                pairs.append((ours[:: max(1, len(ours) // ASKED)], KDTree(theirs), raw(first), raw(second)))
                heights = (ours @ now.pose(raw(first))[:3, :3].T)[:, 2]
                below.append(float(np.mean(heights < -OFF_LEVEL) - np.mean(heights > OFF_LEVEL)))
    if len(pairs) < MIN_PAIRS:
        return ""
    fits = {reading: np.array([_apart(pair, reading) for pair in pairs]) for reading in (now, *now.others())}
    best = min(fits, key=lambda reading: float(np.median(fits[reading])))
    still = np.array([_off_surface(ours, tree) for ours, tree, *_ in pairs])
    usual, found = (float(np.median(fits[reading])) for reading in (now, best))
    said = f"poses do not fit the clouds: points are {usual:.2g} m apart from cloud to cloud"
    clearly = CLOSER * found < usual and np.mean(CLOSER * fits[best] < fits[now]) > SURE_PAIRS
    if clearly and np.median(still) > CLOUDS_MOVE * found:
        return f"{said}; try ?{now.options(best)}, with which they are {found:.2g} m apart"
    if usual > OFF_SURFACE and (clearly or CLOSER * np.median(still) < usual):
        return f"{said}, {np.median(still):.2g} m if the lidar had not moved; check that poses belong to these clouds"
    if below and np.median(below) < -ALL_ABOVE and not now.mounted:
        return f"nearly all points are above the lidar; if it is upside down, try ?{now.turned}"
    return ""


class CloudReading(NamedTuple):
    """Interpretation of the poses of a lidar's body.

    axes, invert, poses_scale: as in `Reading`; upside_down: whether the lidar is mounted so on the body. mount: its
    mount (16 numbers) by option. whole: whether `known` axes, `invert` and `poses_scale` can be chosen. place: of the
    mount that is suggested.
    """

    axes: str = "ros"
    invert: bool = False
    poses_scale: float = 1.0
    upside_down: bool = False
    mount: tuple[float, ...] = tuple(np.eye(4).ravel().tolist())
    whole: bool = True
    known: tuple[str, ...] = tuple(AXES)
    place: str = "0,0,0,0,0"

    @property
    def mounted(self) -> bool:
        """Whether an option says the mount."""
        return self.mount != CloudReading().mount

    @property
    def turned(self) -> str:
        """The option for a lidar that is upside down."""
        return f"mount={self.place},3.14159265"

    def pose(self, T: Transform) -> Transform:
        """Return T_world_lidar (4, 4) in metres of a pose (4, 4) as in the file."""
        T = inverse(T) if self.invert else T.copy()
        T[:3, 3] *= self.poses_scale
        turn = np.eye(4)
        turn[:3, :3] = AXES[self.axes].T @ AXES["ros"] @ np.diag([1, *([-1, -1] if self.upside_down else [1, 1])])
        return T @ np.reshape(self.mount, (4, 4)) @ turn

    def others(self) -> list[CloudReading]:
        """Return the readings that options can give."""
        if not self.whole:
            return [] if self.mounted else [self._replace(upside_down=True)]
        turns = (False,) if self.mounted else (False, True)
        found = [self._replace(axes=a, invert=i, poses_scale=s, upside_down=u)
                 for a, i, s, u in product(self.known, (False, True), POSE_SCALES, turns)]  # fmt: skip
        return [one for one in found if one != self and not (one.upside_down and one.axes != "ros")]

    def options(self, other: CloudReading) -> str:
        """Return the options that change this reading into another."""
        changes = {"invert": "01"[other.invert], "axes": other.axes, "poses_scale": f"{other.poses_scale:g}"}
        words = [f"{key}={text}" for key, text in changes.items() if getattr(self, key) != getattr(other, key)]
        return "&".join([*words, self.turned] if other.upside_down else words)


def _next_turned(first: int, count: int, raw: Callable[[int], Transform]) -> int:
    """Return the number of the next cloud by which the body turned enough, at most ten later."""
    last = min(count - 1, first + LATER)
    start = raw(first)[:3, :3]
    turned = (i for i in range(first + 1, last) if np.trace(start.T @ raw(i)[:3, :3]) < 1 + 2 * np.cos(CLOUD_TURN))
    return next(turned, last)


def _some(points: NDArray[np.floating]) -> NDArray[np.float64]:
    points = np.asarray(points, float)
    points = points[np.isfinite(points).all(axis=1)]
    return points[:: max(1, len(points) // KEPT)]


def _apart(pair: tuple[NDArray[np.float64], KDTree, Transform, Transform], reading: CloudReading) -> float:
    """Return the median distance in metres of one cloud's points from the other's surface."""
    points, tree, first, second = pair
    T = inverse(reading.pose(second)) @ reading.pose(first)
    return _off_surface(points @ T[:3, :3].T + T[:3, 3], tree)


def _off_surface(points: NDArray[np.float64], tree: KDTree) -> float:
    """Return the median distance of points from planes through the nearest points, or from the nearest, if these lie on
    a line or are further away than from each other.
    """
    near, which = tree.query(points, NEIGHBOURS)
    around = tree.data[which]
    middle = around.mean(axis=1)
    values, axes = np.linalg.eigh(np.einsum("nki,nkj->nij", around - middle[:, None], around - middle[:, None]))
    off = np.abs(np.einsum("ni,ni->n", points - middle, axes[:, :, 0]))
    spread = np.sqrt(values[:, 2] / NEIGHBOURS)
    plane = (values[:, 1] > FLAT * values[:, 2]) & (near[:, 0] < 2 * spread)
    return float(np.median(np.where(plane, off, near[:, 0])))
