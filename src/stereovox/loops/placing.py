# SPDX-License-Identifier: Apache-2.0
"""Where a second recording lies in the first one's world, by what both saw, with no guess to begin with.

Some of its submaps are sought in all that the first one shows, at all headings. What fits there, and does not look the
same a short way on, votes for how the two worlds lie; they are believed to lie so where several submaps agree, and no
other way is nearly as good.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stereovox.errors import StereovoxError
from stereovox.loops.closer import Loop, LoopCloser
from stereovox.loops.drift import difference
from stereovox.loops.matching import matched
from stereovox.loops.search import Search
from stereovox.loops.submaps import Shape
from stereovox.se3 import Transform, inverse

SOUGHT = 12
"""Submaps of the second recording that are sought, spread evenly over it."""
UP_M = 1.5
"""Metres by which the heights of two worlds may differ."""
BEYOND_M = 3.0
"""Metres by which the second camera may be outside of where the first one was."""
CELL_M = 0.4
"""Cells in which a place is sought in a whole map."""
PEAKS = 8
"""Places that are looked at closely for each."""
NEAREST = 3
"""Submaps of the first recording that one is laid onto at each of them."""
AGREE_M, AGREE_RAD = 0.5, np.radians(8)
"""Within which two findings say the same of how the worlds lie, and what the second's drift adds: share of the way."""
DRIFT = 0.05
LEAST = 3
"""Submaps that must agree."""
RIVAL = 0.5
"""Share of the submaps that agree that may say something else together."""


@dataclass(frozen=True, eq=False)
class Placed:
    """Where a second recording lies.

    Attributes:
        T_first_second: (4, 4) maps its world into the first one's.
        loops: What was found, once for each pair; `first` is a number of the first recording's submaps,
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
    """Find out where a second recording lies in the world of the first.

    Args:
        first: All of the first recording.
        second: All of the second.
        progress: Called with how many submaps were sought, and their number.

    Raises:
        StereovoxError: Too little fits, or it fits elsewhere as well.
    """
    numbers = sorted({round(i) for i in np.linspace(0, len(second.submaps) - 1, SOUGHT)})
    search, votes = _whole(first), list[_Vote]()
    for done, number in enumerate(numbers, 1):
        shape = second.shapes[second.submaps[number]]
        if shape is not None:
            votes += _votes(first, second, number, shape, search)
        progress(done, len(numbers))
    groups = sorted((_agreeing(vote, votes, second) for vote in votes), key=_submaps, reverse=True)
    if not groups or _submaps(groups[0]) < LEAST:
        found = _submaps(groups[0]) if groups else 0
        raise StereovoxError(
            f"where the second map lies in the first is not known: {found} of {len(numbers)} places of it were found "
            f"there, {LEAST} must agree; say it (--transform)"
        )
    best = groups[0]
    rivals = [group for group in groups if not set(group) & set(best)]
    if rivals and _submaps(rivals[0]) > RIVAL * _submaps(best):
        raise StereovoxError(
            f"the second map fits the first in two ways ({_submaps(best)} and {_submaps(rivals[0])} of {len(numbers)} "
            "places); say which one (--transform)"
        )
    best = sorted(best, key=lambda vote: vote.loop.match.shared)
    pairs = {(vote.loop.first, vote.loop.second): vote.loop for vote in best}  # several places may lead to one
    return Placed(best[-1].T_first_second, list(pairs.values()))


def _whole(closer: LoopCloser) -> Search:
    """Return the search in all that a recording shows."""
    points, views = [], []
    for submap in closer.submaps:
        shape, T = closer.shapes[submap], submap.T_map_anchor
        if shape is not None:
            points.append(shape.points @ T[:3, :3].T + T[:3, 3])
            views.append(shape.views[len(shape.views) // 2]._replace(T=T @ shape.views[len(shape.views) // 2].T))
    if not points:
        raise StereovoxError("the first map shows no surfaces")
    return Search(np.concatenate(points), views, closer.R_level_map, CELL_M)


def _votes(first: LoopCloser, second: LoopCloser, number: int, shape: Shape, search: Search) -> list[_Vote]:
    """Return what a submap of the second recording says of how the worlds lie."""
    submap, votes = second.submaps[number], list[_Vote]()
    for T in _places(first, second, number, shape, search):
        centre = T[:3, :3] @ submap.centre + T[:3, 3]
        away = np.linalg.norm(np.array([one.middle for one in first.submaps]) - centre, axis=1)
        for i in np.argsort(away)[:NEAREST]:
            earlier, T_map_first = first.shapes[first.submaps[i]], first.submaps[i].T_map_anchor
            if earlier is None or len(first.repeats.shifts([first.submaps[i].middle])):
                continue
            match = matched(earlier, shape, inverse(T_map_first) @ T)
            if match is not None and match.held:
                T_first_second = T_map_first @ match.T_earlier_later @ inverse(submap.T_map_anchor)
                votes.append(_Vote(Loop(int(i), number, match, 0.0, 0.0), T_first_second))
    return votes


def _places(first: LoopCloser, second: LoopCloser, number: int, shape: Shape, search: Search) -> list[Transform]:
    """Return where a submap of the second recording may lie in the first one's world (4, 4)."""
    submap, R_first_second = second.submaps[number], first.R_level_map.T @ second.R_level_map
    level = first.R_level_map @ np.array([one.T_map_anchor[:3, 3] for one in first.submaps]).T
    low, high = level.min(axis=1), level.max(axis=1)
    here = second.R_level_map @ submap.T_map_anchor[:3, 3]
    guess = np.eye(4)
    guess[:3, :3] = R_first_second @ submap.T_map_anchor[:3, :3]
    guess[:3, 3] = first.R_level_map.T @ [*(low + high)[:2] / 2, here[2]]
    reach = np.array([*(high - low)[:2] / 2 + BEYOND_M, UP_M])
    return search.places(shape, guess, reach, np.pi, PEAKS)


def _agreeing(vote: _Vote, votes: Sequence[_Vote], second: LoopCloser) -> list[_Vote]:
    """Return the votes that say the same as one, where the second recording's drift is allowed for."""
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
