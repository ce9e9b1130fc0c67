# SPDX-License-Identifier: Apache-2.0
"""Self-similarity of a recording a short distance away, such as between shelves of a warehouse.

Each submap is registered to its immediate predecessors, whose relative pose is certain. A match at another place is a
repeat: surfaces alone cannot tell the two apart, wherever the camera returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.correct.loops.matching import matched
from stereovox.correct.loops.search import SAME_M, Search
from stereovox.correct.loops.submaps import Shape, Shapes, Submap
from stereovox.geometry.se3 import Transform, inverse, transform_points

RECENT_M = 0.5, 12.0
"""Least and largest path in metres to the submaps that one is compared with."""
REACH = np.array([6.0, 6.0, 0.4]), 0.12
"""Metres across and up, and radians, within which a repeat is searched."""
PEAKS = 6
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
        for T in search.places(later, np.eye(4), *REACH, PEAKS):
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
