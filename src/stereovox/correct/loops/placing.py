# SPDX-License-Identifier: Apache-2.0
"""Global alignment of a second recording with the first, by their common view, without an initial guess.

Some of its submaps are searched in the whole first recording, at all headings. Each match that does not look the same a
short distance away votes for the transform between the worlds; it is accepted if several submaps agree, and no other
transform gets nearly as many votes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.correct.loops.closer import Loop, LoopCloser
from stereovox.correct.loops.drift import difference
from stereovox.correct.loops.search import Peak, Search, apart
from stereovox.correct.loops.submaps import matched
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import Transform, inverse
from stereovox.track.views import View

SOUGHT = 12
"""Submaps of the second recording that are searched, evenly chosen."""
UP_M = 1.5
"""Metres by which the heights of two worlds may differ."""
BEYOND_M = 3.0
"""Metres by which the second camera may leave the area of the first one."""
CELL_M, AREA_M = 0.4, 40.0
"""Cell size of the search in a whole map, and largest side of its parts, in metres."""
PEAKS = 8
"""Candidates refined for each."""
NEAREST = 3
"""Submaps of the first recording to which it is registered at each candidate."""
AGREE_M, AGREE_RAD = 0.5, np.radians(8)
"""Tolerance within which two findings agree on the transform; drift of the second adds a share of its path."""
DRIFT = 0.05
LEAST = 3
"""Fewest submaps that must agree."""
RIVAL = 0.5
"""Largest share of the agreeing submaps that may support another transform."""


@dataclass(frozen=True, eq=False)
class Placed:
    """The alignment of a second recording.

    Attributes:
        T_first_second: (4, 4) maps its world into the first one's.
        loops: The matches, one for each pair; `first` is an index of the first recording's submaps,
            `second` of the second's.
    """

    T_first_second: Transform
    loops: Sequence[Loop]


@dataclass(frozen=True, eq=False)
class _Vote:
    loop: Loop
    T_first_second: Transform


def placed(
    first: LoopCloser, second: LoopCloser, progress: Callable[[int, int], object] = lambda done, total: None
) -> Placed:
    """Find the transform of a second recording into the world of the first.

    Args:
        first: All of the first recording.
        second: All of the second.
        progress: Called with the number of searches done, and the total.

    Raises:
        StereovoxError: Too little fits, or it also fits elsewhere.
    """
    numbers = sorted({round(i) for i in np.linspace(0, len(second.submaps) - 1, SOUGHT)})
    votes = list[_Vote]()
    for number, places in _places(first, second, numbers, progress).items():
        votes += _votes(first, second, number, places)
    groups = sorted((_agreeing(vote, votes, second) for vote in votes), key=_submaps, reverse=True)
    if not groups or _submaps(groups[0]) < LEAST:
        found = _submaps(groups[0]) if groups else 0
        raise StereovoxError(
            f"the transform between the maps is unknown: {found} of {len(numbers)} places of it were found "
            f"in the first, {LEAST} must agree; give it (--transform)"
        )
    best = groups[0]
    rivals = [group for group in groups if not set(group) & set(best)]
    if rivals and _submaps(rivals[0]) > RIVAL * _submaps(best):
        raise StereovoxError(
            f"the second map fits the first in two ways ({_submaps(best)} and {_submaps(rivals[0])} of {len(numbers)} "
            "places); give the right one (--transform)"
        )
    best = sorted(best, key=lambda vote: vote.loop.match.shared)
    pairs = {(vote.loop.first, vote.loop.second): vote.loop for vote in best}  # several places may lead to one
    return Placed(best[-1].T_first_second, list(pairs.values()))


def _votes(first: LoopCloser, second: LoopCloser, number: int, places: Sequence[Transform]) -> list[_Vote]:
    """Return a submap's votes for the transform between the worlds, from its candidate poses in the first."""
    submap, votes = second.submaps[number], list[_Vote]()
    shape, middles = second.shapes[submap], np.array([one.middle for one in first.submaps])
    assert shape is not None
    for T in places:
        away = np.linalg.norm(middles - (T[:3, :3] @ submap.centre + T[:3, 3]), axis=1)
        for i in np.argsort(away)[:NEAREST]:
            earlier, T_map_first = first.shapes[first.submaps[i]], first.submaps[i].T_map_anchor
            if earlier is None or len(first.repeats.shifts([first.submaps[i].middle])):
                continue
            match = matched(earlier, shape, inverse(T_map_first) @ T)
            if match is not None and match.held:
                T_first_second = T_map_first @ match.T_earlier_later @ inverse(submap.T_map_anchor)
                votes.append(_Vote(Loop(int(i), number, match, 0.0, 0.0), T_first_second))
    return votes


def _places(
    first: LoopCloser, second: LoopCloser, numbers: Sequence[int], progress: Callable[[int, int], object]
) -> dict[int, list[Transform]]:
    """Return candidate poses (4, 4) of these submaps of the second recording in the first one's world.

    The first recording is searched part by part, so that time and memory grow with its path, not with the area that
    it spans.
    """
    shapes = {number: shape for number in numbers if (shape := second.shapes[second.submaps[number]]) is not None}
    beyond = max((float(np.linalg.norm(shape.points, axis=1).max()) for shape in shapes.values()), default=0.0)
    shown, areas = _Shown(first), _areas(first)
    peaks: dict[int, list[Peak]] = {number: [] for number in shapes}
    for done, (middle, half) in enumerate(areas):
        search = shown.search(middle, half + beyond)
        for n, (number, shape) in enumerate(shapes.items(), 1):
            T = second.submaps[number].T_map_anchor
            guess = np.eye(4)
            guess[:3, :3] = first.R_level_map.T @ second.R_level_map @ T[:3, :3]
            guess[:3, 3] = first.R_level_map.T @ [*middle, (second.R_level_map @ T[:3, 3])[2]]
            if search is not None:
                peaks[number] += search.peaks(shape, guess, np.array([*half, UP_M]), np.pi, PEAKS)
            progress(done * len(shapes) + n, len(areas) * len(shapes))
    T_map_level = np.eye(4)
    T_map_level[:3, :3] = first.R_level_map.T
    return {n: [T_map_level @ peak.T_level_later for peak in apart(found, PEAKS)] for n, found in peaks.items()}


def _areas(closer: LoopCloser) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Return the parts of the area near a recording's path in which another camera is searched.

    They are rectangles, given by middle and half size (2,) in metres, levelled.
    """
    level = np.array([one.T_map_anchor[:3, 3] for one in closer.submaps]) @ closer.R_level_map.T[:, :2]
    low, high = level.min(axis=0) - BEYOND_M, level.max(axis=0) + BEYOND_M
    count = np.ceil((high - low) / AREA_M).astype(int)
    half = (high - low) / count / 2
    middles = (low + half * (2 * np.array(place) + 1) for place in np.ndindex(*count))
    return [(middle, half) for middle in middles if (np.abs(level - middle) <= half + BEYOND_M).all(axis=1).any()]


class _Shown:
    """The surfaces and views of a recording, levelled."""

    def __init__(self, closer: LoopCloser):
        self._R_level_map = closer.R_level_map
        points, self._views = [], list[View]()
        for submap in closer.submaps:
            shape, T = closer.shapes[submap], submap.T_map_anchor
            if shape is not None:
                points.append((shape.points @ T[:3, :3].T + T[:3, 3]).astype(np.float32))
                view = shape.views[len(shape.views) // 2]
                self._views.append(view._replace(T=T @ view.T))
        if not points:
            raise StereovoxError("the first map shows no surfaces")
        self._points = np.concatenate(points)

    def search(self, middle: NDArray[np.float64], half: NDArray[np.float64]) -> Search | None:
        """Return the search in a part of it, given by middle (2,) and half size (2,); None if it has no surfaces."""
        near = (np.abs(self._points @ self._R_level_map.T[:, :2] - middle) <= half).all(axis=1)
        return Search(self._points[near], self._seeing(middle, half), self._R_level_map, CELL_M) if near.any() else None

    def _seeing(self, middle: NDArray[np.float64], half: NDArray[np.float64]) -> list[View]:
        """Return the views that reach into a part."""
        at = np.array([view.T[:3, 3] for view in self._views]) @ self._R_level_map.T[:, :2]
        away = np.linalg.norm(np.maximum(np.abs(at - middle) - half, 0), axis=1)
        deepest = np.array([view.nearest[np.isfinite(view.nearest)].max(initial=0) for view in self._views])
        far = deepest * np.sqrt(1 + np.array([view.slope @ view.slope for view in self._views]))
        return [view for view, reaches in zip(self._views, away <= far, strict=True) if reaches]


def _agreeing(vote: _Vote, votes: Sequence[_Vote], second: LoopCloser) -> list[_Vote]:
    """Return the votes that agree with one, allowing for the second recording's drift."""
    found = []
    here = second.submaps[vote.loop.second]
    for other in votes:
        there = second.submaps[other.loop.second]
        moved = difference(vote.T_first_second @ there.T_map_anchor, other.T_first_second @ there.T_map_anchor)
        way = DRIFT * float(np.linalg.norm(here.T_map_anchor[:3, 3] - there.T_map_anchor[:3, 3]))
        if np.linalg.norm(moved[3:]) < AGREE_M + way and np.linalg.norm(moved[:3]) < AGREE_RAD:
            found.append(other)
    return found


def _submaps(votes: Sequence[_Vote]) -> int:
    """Return how many submaps of the second recording voted."""
    return len({vote.loop.second for vote in votes})
