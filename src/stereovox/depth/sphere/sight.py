# SPDX-License-Identifier: Apache-2.0
"""Queries of a spherical grid: how far a vehicle may fly in a direction. Unknown is never free."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.depth.sphere.grid import SphereGrid, SphereLayout
from stereovox.errors import StereovoxError
from stereovox.frame import Reason

MAIN_DIRECTIONS = {
    "front": (1.0, 0.0, 0.0),
    "left": (0.0, 1.0, 0.0),
    "back": (-1.0, 0.0, 0.0),
    "right": (0.0, -1.0, 0.0),
    "up": (0.0, 0.0, 1.0),
    "down": (0.0, 0.0, -1.0),
}
"""Unit vectors in the frame of the body."""


@dataclass(frozen=True)
class Sight:
    """The nearest range in a cone of directions.

    range_m: the smallest range seen, metres. surface: whether that is a surface; if not, there is none up to that
        range. stamp_ns: when that range was measured. oldest_ns: the oldest measurement of all.
    seen: share (0 to 1) of the directions, by solid angle, that were seen.
    """

    range_m: float
    surface: bool
    stamp_ns: int
    oldest_ns: int
    seen: float

    def age_s(self, now_ns: int) -> float:
        """Return how old the range is at `now_ns`, seconds."""
        return (now_ns - self.stamp_ns) / 1e9


def range_in(grid: SphereGrid, direction: ArrayLike, half_angle_deg: float = 0.0, unseen: float = 0.0) -> Sight | None:
    """Return the free distance towards `direction`, None if unknown.

    direction: (3,) in the frame of the body, of any length. half_angle_deg: of a cone round it, all of which must be
    free; each cell that the cone touches counts. unseen: largest share of the cone that may be unknown; more than 0
    accepts that an obstacle may be there.
    Raises StereovoxError for a direction without length and for angles outside [0, 180].
    """
    sight = sight_of(grid, direction, half_angle_deg)
    return None if sight is None or 1 - sight.seen > unseen + 1e-9 else sight


def sight_of(grid: SphereGrid, direction: ArrayLike, half_angle_deg: float = 0.0) -> Sight | None:
    """Return the nearest range in a cone, even if only part of the cone was seen; None if nothing was.

    Unseen parts may hold nearer obstacles: see `Sight.seen`. Arguments and errors as for `range_in`.
    """
    return _nearest(grid, *_cone(grid, direction, half_angle_deg))


def surroundings(grid: SphereGrid, half_angle_deg: float = 45.0) -> dict[str, Sight | None]:
    """Return the nearest range round each of the six main directions of the body; None if nothing was seen."""
    return {name: sight_of(grid, direction, half_angle_deg) for name, direction in MAIN_DIRECTIONS.items()}


def _nearest(grid: SphereGrid, touched: NDArray[np.bool_], missing: float) -> Sight | None:
    known = touched & grid.known
    if not known.any():
        return None
    solid = np.broadcast_to(np.sin(grid.layout.polar()), grid.layout.shape)
    seen = solid[known].sum() / (solid[touched].sum() + missing)
    place = np.flatnonzero(known)[np.argmin(grid.range_m[known])]
    return Sight(
        float(grid.range_m.flat[place]),
        bool(grid.reason.flat[place] != Reason.TOO_FAR),
        int(grid.stamp_ns.flat[place]),
        int(grid.stamp_ns[known].min()),
        float(min(seen, 1.0)),
    )


def _cone(grid: SphereGrid, direction: ArrayLike, half_angle_deg: float) -> tuple[NDArray[np.bool_], float]:
    """Return the cells (azimuths, polars) that a cone touches, and how much of it is outside the grid.

    The latter is a sum of sin(polar angle) over cells, the measure of solid angle used here.
    """
    axis = np.asarray(direction, float).reshape(-1)
    length = float(np.linalg.norm(axis)) if axis.shape == (3,) and np.isfinite(axis).all() else 0.0
    if not length > 0:
        raise StereovoxError(f"direction {direction!r}: give three finite numbers, not all zero, for example (1, 0, 0)")
    if not 0 <= half_angle_deg <= 180:
        raise StereovoxError(f"half angle {half_angle_deg} deg must lie between 0 and 180")
    layout, whole = grid.layout, grid.layout.whole()
    near = np.zeros(whole.shape, bool)
    if half_angle_deg > 0:
        reach = math.radians(half_angle_deg) + whole.step / math.sqrt(2)  # from a cell's centre to its corners
        near = _chords(whole, axis / length) <= 2 * math.sin(min(reach, math.pi) / 2)
    near.flat[whole.cells_of(axis)] = True
    touched = near[np.ix_(*layout.places_in(whole))]
    return touched, float((near * np.sin(whole.polar())).sum() - (touched * np.sin(layout.polar())).sum())


def _chords(layout: SphereLayout, axis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance of each cell's unit vector from `axis`."""
    return np.linalg.norm(_directions(layout) - axis, axis=-1)


@lru_cache(maxsize=4)
def _directions(layout: SphereLayout) -> NDArray[np.float64]:
    return layout.directions()
