# SPDX-License-Identifier: Apache-2.0
"""Correlative search for a submap's pose on an earlier one, over shifts and headings on a coarse grid (Olson 2009).

Self-similarity of a recording a short distance away, such as between shelves of a warehouse.

Each submap is registered to its immediate predecessors, whose relative pose is certain. A match at another place is a
repeat: surfaces alone cannot tell the two apart, wherever the camera returns.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.correct.loops import _search
from stereovox.correct.loops.submaps import COARSE_M, Shape, Shapes, Submap, matched
from stereovox.geometry.se3 import Transform, inverse, rotation_matrix, transform_points
from stereovox.track.views import GRID, View

SEEDS = 300
"""Number of points used of the later submap."""
ON, BESIDE, THROUGH = 2, 1, -2
"""Scores of a point in a cell with a surface, next to one, and in a cell seen through."""
BEHIND_M = 0.4
"""A cell is seen through if it is nearer than the surface behind it by this."""
TURN_STEP = np.radians(3.5)
PEAKS = 4
"""Usual number of candidates refined."""
SAME_M, SAME_RAD = 0.5, np.radians(12)
"""Metres and radians within which two places are the same."""
AT_ONCE = 1 << 20
"""Cells processed at once, so that large grids need little memory."""
LEAST = 0.12
"""Least score, of at most 1, of a place."""


class Search:
    """Finds candidate poses of submaps on an earlier one.

    Args:
        points: (N, 3) points on its surfaces.
        views: The views of its frames.
        R_level_earlier: (3, 3) turns its frame so that z points up.
        cell: Side of a cell of the grid, in metres.
    """

    def __init__(
        self,
        points: NDArray[np.floating],
        views: Iterable[View],
        R_level_earlier: NDArray[np.float64],
        cell: float = COARSE_M,
    ):
        self._cell, self._turn = cell, TURN_STEP * cell / COARSE_M
        self._T = np.eye(4)
        self._T[:3, :3] = R_level_earlier
        points = points @ R_level_earlier.T
        self._low = np.floor(points.min(axis=0) / self._cell).astype(np.int64) - 1
        self._grid = np.zeros(np.floor(points.max(axis=0) / self._cell).astype(np.int64) + 2 - self._low, np.int8)
        self._mark_free(views)
        self._mark_surfaces(points)

    def places(
        self, later: Shape, guess: Transform, reach: NDArray[np.float64], turn: float, most: int = PEAKS
    ) -> list[Transform]:
        """Return the likeliest poses T_earlier_later (4, 4), best first; arguments as for `peaks`."""
        return [
            inverse(self._T) @ peak.T_level_later for peak in apart(self.peaks(later, guess, reach, turn, most), most)
        ]

    def peaks(self, later: Shape, guess: Transform, reach: NDArray[np.float64], turn: float, most: int) -> list[Peak]:
        """Return the likeliest places of each heading.

        Args:
            later: A submap.
            guess: (4, 4) T_earlier_later where the search starts.
            reach: (3,) half size of the search in metres: across and up.
            turn: Radians by which its heading may be off.
            most: Most places per heading.
        """
        seeds = later.points[:: max(1, len(later.points) // SEEDS)]
        steps = int(np.ceil(turn / self._turn))
        window = 2 * np.ceil(reach / self._cell).astype(int) + 1
        rows, peaks = np.ascontiguousarray(self._grid.transpose(0, 2, 1)), list[Peak]()
        found = np.empty(window[[0, 2, 1]], np.int32)
        for angle in self._turn * np.arange(-steps, steps + 1):
            T = self._T @ guess
            T[:3, :3] = rotation_matrix([0, 0, angle]) @ T[:3, :3]
            cells = np.floor((seeds @ T[:3, :3].T + T[:3, 3]) / self._cell).astype(np.int64) - self._low
            _search.scores(rows, cells.astype(np.int32), found)
            by_axis = np.ascontiguousarray(found.transpose(0, 2, 1))
            for place, score in self._highest(by_axis, LEAST * ON * len(seeds), most):
                shift = self._cell * (np.array(place) - window // 2)
                peaks.append(Peak(score, angle, T[:3, 3] + shift, T[:3, :3]))
        return peaks

    def _highest(self, found: NDArray[np.int32], least: float, most: int) -> list[tuple[tuple[int, ...], int]]:
        """Return the places and values of the highest scores, none near another; `found` is overwritten."""
        highest, near = list[tuple[tuple[int, ...], int]](), int(np.ceil(SAME_M / self._cell))
        while len(highest) < most:
            place = tuple(int(i) for i in np.unravel_index(found.argmax(), found.shape))
            if found[place] <= least:
                break
            highest.append((place, int(found[place])))
            found[tuple(slice(max(i - near, 0), i + near + 1) for i in place)] = np.iinfo(np.int32).min
        return highest

    def _mark_free(self, views: Iterable[View]) -> None:
        """Mark cells that views saw through."""
        seen, (count, *others) = list(views), self._grid.shape
        step = max(1, AT_ONCE // max(1, others[0] * others[1]))
        for first in range(0, count, step):
            self._mark_free_in(self._grid[first : first + step], first, seen)

    def _mark_free_in(self, slab: NDArray[np.int8], first: int, views: Iterable[View]) -> None:
        """Mark the cells of a slab of the grid, which starts at `first` along the first axis."""
        starts = np.array([first, 0, 0]) + self._low + 0.5
        x, y, z = (self._cell * (np.arange(n) + start) for n, start in zip(slab.shape, starts, strict=True))
        for view in views:
            T = inverse(self._T @ view.T)
            middles = [(x * a)[:, None, None] + (y * b)[:, None] + (z * c + d) for a, b, c, d in T[:3]]
            ahead = np.flatnonzero(middles[2] > self._cell)
            away = middles[2].reshape(-1)[ahead]
            column, row = (
                np.floor((middles[axis].reshape(-1)[ahead] / away / view.slope[axis] + 1) / 2 * GRID[1 - axis])
                for axis in (0, 1)
            )
            inside = (column >= 0) & (column < GRID[1]) & (row >= 0) & (row < GRID[0])
            nearest = view.nearest[row[inside].astype(np.intp), column[inside].astype(np.intp)]
            free = np.isfinite(nearest) & (away[inside] < nearest - BEHIND_M)
            slab.reshape(-1)[ahead[inside][free]] = THROUGH

    def _mark_surfaces(self, points: NDArray[np.float64]) -> None:
        """Mark cells with a surface, and those next to them."""
        from scipy.ndimage import binary_dilation

        there = np.zeros(self._grid.shape, bool)
        there[tuple((np.floor(points / self._cell).astype(np.int64) - self._low).T)] = True
        beside: NDArray[np.bool_] = np.array(binary_dilation(there, np.ones((3, 3, 3), bool)), bool)
        self._grid[beside] = BESIDE
        self._grid[there] = ON


@dataclass(frozen=True, eq=False)
class Peak:
    """A candidate place of a submap in a search, in its axes turned so that z points up.

    Attributes:
        score: Its score there.
        angle: Radians by which its heading is turned from the guess.
        place: (3,) metres.
        R: (3, 3) its rotation.
    """

    score: int
    angle: float
    place: NDArray[np.float64]
    R: NDArray[np.float64]

    @property
    def T_level_later(self) -> Transform:  # noqa: N802
        """Its pose (4, 4)."""
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = self.R, self.place
        return T


def apart(peaks: Sequence[Peak], most: int) -> list[Peak]:
    """Return at most `most` peaks from high to low, without peaks near a higher one."""
    kept = list[Peak]()
    for peak in sorted(peaks, key=lambda peak: -peak.score):
        if not any(_is_same(peak, other) for other in kept):
            kept.append(peak)
        if len(kept) == most:
            break
    return kept


def _is_same(one: Peak, other: Peak) -> bool:
    turned = abs((one.angle - other.angle + np.pi) % (2 * np.pi) - np.pi)
    return bool(turned < SAME_RAD and np.abs(one.place - other.place).max() < SAME_M)


RECENT_M = 0.5, 12.0
"""Least and largest path in metres to the submaps that one is compared with."""
REACH = np.array([6.0, 6.0, 0.4]), 0.12
"""Metres across and up, and radians, within which a repeat is searched."""
REPEAT_PEAKS = 6
"""Candidates refined."""
NEAR_M = 6.0
"""Metres from a place within which repeats count for it: repeating structures continue."""
SEEN_BY, SHARE = 3, 0.2
"""Submaps near a place, and share of them, that must have found the same repeat: single ones are chance."""
ALIKE_M = 0.2
"""Metres within which two repeats are the same."""


class _Repeat(NamedTuple):
    """A submap that looks the same when shifted by `shift` (3,), in its own axes."""

    submap: Submap
    shift: NDArray[np.float64]


class Repeats:
    """The repeats of a recording.

    Args:
        shapes: Surfaces of submaps.
        R_level_map: (3, 3) turns the map so that z points up.
    """

    def __init__(self, shapes: Shapes, R_level_map: NDArray[np.float64]):
        self._shapes, self._R_level_map = shapes, R_level_map
        self._found, self._looked = list[_Repeat](), list[Submap]()

    def look(self, submaps: Sequence[Submap]) -> None:
        """Compare the last of the submaps with those before it."""
        *before, last = submaps
        later, (least, most) = self._shapes[last], RECENT_M
        recent = [one for one in before if least < last.travelled - one.travelled < most]
        shown = [(one, shape) for one in recent if (shape := self._shapes[one]) is not None]
        if later is None or not shown:
            return
        self._looked.append(last)
        search = Search(_points(shown, last), [], self._R_level_map @ last.T_odom_anchor[:3, :3])
        for T in search.places(later, np.eye(4), *REACH, REPEAT_PEAKS):
            if np.linalg.norm(T[:3, 3]) > SAME_M and (shift := _refined(shown, last, later, T)) is not None:
                self._found.append(_Repeat(last, shift))

    def shifts(self, places: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the shifts (N, 3) in metres, in the map's axes, by which the surroundings of places (3,) repeat."""
        looked = sum(_is_near(submap, places) for submap in self._looked)
        near = [one for one in self._found if _is_near(one.submap, places)]
        shifts = np.reshape([one.submap.T_map_anchor[:3, :3] @ one.shift for one in near], (-1, 3))
        needed = max(SEEN_BY, SHARE * looked)
        return shifts[[len(_agreeing(near, shifts, shift)) >= needed for shift in shifts]]


def _points(shown: Sequence[tuple[Submap, Shape]], last: Submap) -> NDArray[np.float64]:
    """Return points (N, 3) on the surfaces of submaps, in the axes of the last one."""
    motions = [inverse(last.T_odom_anchor) @ one.T_odom_anchor for one, _ in shown]
    return np.concatenate([transform_points(T, shape.points) for T, (_, shape) in zip(motions, shown, strict=True)])


def _is_near(submap: Submap, places: Sequence[NDArray[np.float64]]) -> bool:
    return min(float(np.linalg.norm(submap.middle - at)) for at in places) < NEAR_M


def _agreeing(repeats: Sequence[_Repeat], shifts: NDArray[np.float64], shift: NDArray[np.float64]) -> set[Submap]:
    """Return the submaps that found a shift, in either direction."""
    away = np.minimum(np.linalg.norm(shifts - shift, axis=1), np.linalg.norm(shifts + shift, axis=1))
    return {one.submap for one, metres in zip(repeats, away, strict=True) if metres < ALIKE_M}


def _refined(
    shown: Sequence[tuple[Submap, Shape]], last: Submap, later: Shape, T: Transform
) -> NDArray[np.float64] | None:
    """Return the shift (3,) at which a submap fits, near T_last_place (4, 4); None if it does not."""
    T_odom_place = last.T_odom_anchor @ T
    here = transform_points(T_odom_place, last.centre)
    away = [np.linalg.norm(transform_points(one.T_odom_anchor, one.centre) - here) for one, _ in shown]
    earlier, shape = shown[int(np.argmin(away))]
    match = matched(shape, later, inverse(earlier.T_odom_anchor) @ T_odom_place)
    if match is None or not match.held:
        return None
    shift = (inverse(last.T_odom_anchor) @ earlier.T_odom_anchor @ match.T_earlier_later)[:3, 3]
    return shift if np.linalg.norm(shift) > SAME_M else None
