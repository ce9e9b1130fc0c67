# SPDX-License-Identifier: Apache-2.0
"""Submaps: short runs of a map's frames, taken as rigid, and their surfaces.

Whether two submaps show one place: each is registered to the other, and both results must agree.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.geometry.se3 import Transform, inverse, rotation_vector
from stereovox.maps.record.kept_frames import KeptFrame
from stereovox.track.fit import Stage, deviations, motion_between, solve_stages
from stereovox.track.surfaces import Surfaces
from stereovox.track.surfels import CONVERGED, Level, Patches, SurfelMap
from stereovox.track.views import View, contradiction, view_of

LONG_M, LONG_RAD = 0.8, np.radians(40)
"""Largest motion from a submap's first frame to its last."""
USED = 5
"""Frames used of a submap, evenly chosen."""
MAX_PATCHES = 4000
"""Most patches of a submap used in registration."""
COARSE_M = 0.2
"""Size of cells that give one point each for the search."""
HALF = 1 << 20
"""Cells to each side of a submap with distinct numbers."""
IN_MEMORY = 48
"""Submaps whose surfaces stay in memory; others are rebuilt from their frames."""


@dataclass(eq=False)
class Submap:
    """A run of frames, in the order they entered the map, whose relative poses are taken as exact.

    Attributes:
        frames: The frames, with their original poses.
        T_odom_frames: Their poses (4, 4), exactly rigid.
        anchor: Index of the frame whose axes are the submap's: the middle one.
        T_map_anchor: (4, 4) current pose of that frame.
        travelled: Metres of the path up to there.
        turned: Radians of turning up to there.
        centre: (3,) mean of its surfaces, in its axes.
    """

    frames: Sequence[KeptFrame]
    T_odom_frames: Sequence[Transform]
    T_map_anchor: Transform
    travelled: float = 0.0
    turned: float = 0.0
    centre: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))

    @property
    def anchor(self) -> int:
        """Index of the frame whose axes are the submap's."""
        return len(self.frames) // 2

    @property
    def T_odom_anchor(self) -> Transform:  # noqa: N802
        """Return the original pose (4, 4) of the anchor."""
        return self.T_odom_frames[self.anchor]

    @property
    def stamp_ns(self) -> int:
        """Time of the anchor."""
        return self.frames[self.anchor].stamp_ns

    @property
    def middle(self) -> NDArray[np.float64]:
        """Return the mean (3,) of its surfaces, in the map."""
        return self.T_map_anchor[:3, :3] @ self.centre + self.T_map_anchor[:3, 3]

    @property
    def bend(self) -> Transform:
        """Return the motion (4, 4) from original to current poses near the anchor."""
        return self.T_map_anchor @ inverse(self.T_odom_anchor)


class Shape:
    """The surfaces of a submap, in its anchor's frame.

    Attributes:
        surfels: Its surfaces.
        patches: A sample of them, for registration to other submaps.
        views: The views of its frames.
        points: (N, 3) one point for each coarse cell with a surface.
    """

    def __init__(self, seen: Sequence[tuple[Patches, Transform]]):
        self.surfels = SurfelMap()
        self.views: list[View] = []
        for patches, T in seen:
            self.surfels.add(patches, T)
            self.views.append(view_of(patches.points, patches.sigma, T))
        together = _joined(seen)
        self.patches = together.thinned(max(1, -(-len(together.points) // MAX_PATCHES)))
        cells = np.floor(together.points / COARSE_M).astype(np.int64) + HALF
        _, first = np.unique((cells[:, 0] * 2 * HALF + cells[:, 1]) * 2 * HALF + cells[:, 2], return_index=True)
        self.points = together.points[np.sort(first)]


class Shapes:
    """The shapes of submaps, built on demand; the latest used are cached."""

    def __init__(self, config: Config):
        self._surfaces = Surfaces(config)
        self._held: OrderedDict[Submap, Shape | None] = OrderedDict()

    def __getitem__(self, submap: Submap) -> Shape | None:
        """Return the shape of a submap; None if it has too few surfaces."""
        if submap not in self._held:
            self._held[submap] = self._made(submap)
            while len(self._held) > IN_MEMORY:
                self._held.popitem(last=False)
        self._held.move_to_end(submap)
        return self._held[submap]

    def _made(self, submap: Submap) -> Shape | None:
        chosen = sorted({round(i) for i in np.linspace(0, len(submap.frames) - 1, USED)})
        T_anchor_odom = inverse(submap.T_odom_anchor)
        seen = []
        for i in chosen:
            try:
                patches = self._surfaces.see(submap.frames[i].frame()).patches
            except FrameRefused:
                continue
            seen.append((patches, T_anchor_odom @ submap.T_odom_frames[i]))
        return Shape(seen) if seen else None


def is_long(T_odom_frames: Sequence[Transform], T_odom_next: Transform) -> bool:
    """Return whether a submap of these frames of one sensor is complete before another one of it."""
    if not T_odom_frames:
        return False
    T = inverse(T_odom_frames[0]) @ T_odom_next
    return bool(np.linalg.norm(T[:3, 3]) > LONG_M or np.linalg.norm(rotation_vector(T[:3, :3])) > LONG_RAD)


def _joined(seen: Sequence[tuple[Patches, Transform]]) -> Patches:
    """Return all patches, moved by their poses into one frame."""
    points = [patches.points @ T[:3, :3].T + T[:3, 3] for patches, T in seen]
    normals = [patches.normals @ T[:3, :3].T for patches, T in seen]
    sigma = [patches.sigma for patches, _ in seen]
    return Patches(*(np.concatenate(parts).astype(np.float32) for parts in (points, normals, sigma)))


FLOOR = np.diag(np.repeat([np.radians(0.3), 0.01], 3) ** 2)
"""Covariance added to a match's own: submaps are not quite rigid."""
DOUBT = np.diag(np.repeat([0.15, 0.4], 3) ** 2)
"""Prior covariance of a match: wide, so that only surfaces count."""
LEVELS = 3
"""Number of surfel sizes used, from the coarsest: a few frames have too few of the finest."""
SHARED = 0.25
"""Least share of each submap's surface that the other has seen."""
USUAL = 0.8
"""Least inlier share of that."""
LOOKED_THROUGH, CLOSE = 0.05, 0.6
"""Largest share of the common view in the other's free space, by more than this many deviations."""
MUTUAL = 30.0
"""Largest squared deviations, of six, between the two registrations."""
HELD_RAD, HELD_M = np.radians(2), 0.04
"""Standard deviations beyond which a match is open along some direction, as in a corridor."""


@dataclass(frozen=True, eq=False)
class Match:
    """The registration of a submap to an earlier one.

    Attributes:
        T_earlier_later: (4, 4).
        covariance: (6, 6) of it: rotation and shift in the later one's axes.
        shared: Share of the surface of either that the other has seen.
        held: Whether surfaces constrain it in all directions.
    """

    T_earlier_later: Transform
    covariance: NDArray[np.float64]
    shared: float
    held: bool


class _Laid(NamedTuple):
    T: Transform
    covariance: NDArray[np.float64]
    shared: float


def matched(earlier: Shape, later: Shape, guess: Transform) -> Match | None:
    """Return the registration of two submaps near T_earlier_later (4, 4); None if they do not show one place."""
    there = _laid(earlier.surfels, later.patches, guess)
    back = None if there is None else _laid(later.surfels, earlier.patches, inverse(there.T))
    if there is None or back is None:
        return None
    covariance = there.covariance + FLOOR
    apart = motion_between(there.T, inverse(back.T))
    by_both = covariance + _seen_from(there.T, back.covariance) + FLOOR
    if apart @ np.linalg.solve(by_both, apart) > MUTUAL:
        return None
    if _looked_through(earlier.views, later.views, there.T) > LOOKED_THROUGH:
        return None
    turn, shift = deviations(covariance)
    is_held = turn < HELD_RAD and shift < HELD_M
    return Match(there.T, _own_axes(covariance, there.T), min(there.shared, back.shared), is_held)


def _laid(surfels: SurfelMap, patches: Patches, guess: Transform) -> _Laid | None:
    """Return the pose that registers patches to surfels; None if too few have one, or fit it."""
    levels = surfels.levels(patches)[:LEVELS]
    middle = levels[1]

    def stages() -> Iterator[Stage]:
        for level in levels:
            yield Stage(level, CONVERGED * level.size)
            if level is middle and not _is_one_place(middle):
                return  # skip the finer ones, which take longest

    T, covariance = solve_stages(stages(), guess, DOUBT)
    return _Laid(T, covariance, middle.known) if _is_one_place(middle) else None


def _is_one_place(level: Level) -> bool:
    return level.known >= SHARED and level.inlier_share >= USUAL


def _looked_through(earlier: list[View], later: list[View], T: Transform) -> float:
    """Return the share of the common view that is in the other's free space."""
    found = [contradiction(view._replace(T=T @ view.T), earlier, CLOSE) for view in later]
    number = sum(count for _, count in found)
    return sum(share * count for share, count in found) / max(number, 1)


def _own_axes(covariance: NDArray[np.float64], T: Transform) -> NDArray[np.float64]:
    """Return a covariance (6, 6) along the map's axes as one along those of the pose (4, 4)."""
    R = np.kron(np.eye(2), T[:3, :3].T)
    return R @ covariance @ R.T


def _seen_from(T: Transform, back: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the covariance of T_earlier_later (4, 4) from `back` (6, 6), the covariance of its inverse.

    Both as `Fit.covariance`: rotation about the second's origin, then shift, along the first's axes.
    """
    R, (x, y, z) = T[:3, :3], T[:3, 3]
    across = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    J = np.block([[-R, np.zeros((3, 3))], [across @ R, -R]])
    return J @ back @ J.T
