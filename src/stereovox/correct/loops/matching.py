# SPDX-License-Identifier: Apache-2.0
"""Whether two submaps show one place: each is registered to the other, and both results must agree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.correct.loops.submaps import Shape
from stereovox.geometry.se3 import Transform, inverse
from stereovox.track.fit import Stage, deviations, motion_between, solve_stages
from stereovox.track.surfels import CONVERGED, Level, Patches, SurfelMap
from stereovox.track.views import View, contradiction

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
