# SPDX-License-Identifier: Apache-2.0
"""Paths of a vehicle at one height through known free space, the middle of that space, and a tour of waypoints."""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import shown
from stereovox.maps import State, VoxelMap
from stereovox.maps.query.queries import points_of
from stereovox.products.frontiers import Frontier, frontiers
from stereovox.products.path_check import path_length

CLEAR = 0.3
"""A step costs its length times 1 + this (metres) over the clearance: paths keep to the middle."""
SIDES = ((1, 0), (0, 1), (1, 1), (1, -1))
"""Steps to neighbours; each also counts in reverse."""
NEARER_M, SAME_M, TRIES, NEAR_M = 0.3, 0.6, 3, (0.5, 2.0)
"""A path towards a waypoint ends nearer to it than all before by NEARER_M, or leads to within NEAR_M of the viewpoint
of a frontier that is SAME_M from all that were looked at. A waypoint, or a frontier, to which TRIES known paths had to
be abandoned is given up."""
FRONTIER_CELLS, BAND = 15, 0.6
"""Fewest cells of a frontier on the way, and metres above and below the vehicle in which it is sought."""
NO_PATH, ABANDONED = "no path to it", "paths to it abandoned"
"""Reasons why a waypoint was given up."""


Leg = tuple[NDArray[np.float64], NDArray[np.float64]]
"""A path (N, 3) in metres, and the place (3,) to look at from its end."""


class LevelPlanner:
    """Shortest paths of a ball at one height through known free columns of cells.

    A column is free if all its cells in a band around the height are. The map's `up` must be z.

    Args:
        voxel_map: The map, as it is now; later changes are not seen.
        start: (3,) metres, position of the ball.
        radius: Its radius in metres.
        half_height: Metres above and below it within which cells must be free.
        own_radius: Horizontal metres around the start within which unknown and tentative cells count as its own place.

    Attributes:
        start: (3,) metres.

    Raises:
        StereovoxError: The map is empty or has another `up`, or the numbers make no sense.
    """

    def __init__(
        self, voxel_map: VoxelMap, start: ArrayLike, radius: float, half_height: float = 0.3, own_radius: float = 0.0
    ):
        if voxel_map.config.up != "z":
            raise StereovoxError(f"the map's up is {voxel_map.config.up}, not z; map with --level")
        if not (0 <= radius < np.inf and 0 <= half_height < np.inf and 0 <= own_radius < np.inf):
            raise StereovoxError(f"radius {radius}, half_height {half_height}, own_radius {own_radius}: give metres")
        here = points_of(start, "start", wanted="(3,) metres, x y z").astype(float).ravel()
        bounds = voxel_map.bounds()
        if bounds is None or here.shape != (3,) or not np.isfinite(here).all():
            raise StereovoxError(f"start {start}: give a point X, Y, Z in metres, and a map that is not empty")
        self.start, self._radius, self._cell = here, radius, np.array(voxel_map.config.cell)
        free, own = self._columns(voxel_map, bounds, half_height, own_radius)
        self._room = _room(free | own, self._cell)

    def middle(self) -> tuple[NDArray[np.float64], float] | None:
        """Return the reachable place (3,) with the most clearance, and that clearance in metres.

        This is the middle of the known part of a room (Chien 2020, 5.1). None if it cannot move at all.
        """
        room = np.where(np.isfinite(self._search[0].reshape(self._room.shape)), self._room, -1)
        best = np.unravel_index(np.argmax(room), room.shape)
        return (self._place(np.array(best)), float(room[best])) if room[best] > 0 else None

    def path_to(self, goal: ArrayLike, near: float = 0.3) -> NDArray[np.float64] | None:
        """Return the path (N, 3) in metres from the start to the place nearest to a goal.

        Args:
            goal: (3,) metres; only x and y count.
            near: Metres by which the end may miss the goal.

        Returns:
            Places at the start's height; None if there is no path.
        """
        reached = np.flatnonzero(np.isfinite(self._search[0]))
        if not len(reached):
            return None
        places = self._place(np.column_stack(np.unravel_index(reached, self._room.shape)))
        away = np.linalg.norm(places[:, :2] - np.asarray(goal, float)[:2], axis=1)
        return None if away.min() > near else self._way(int(reached[np.argmin(away)]))

    def _way(self, column: int) -> NDArray[np.float64]:
        """Return the path (N, 3) from the start to a reached column."""
        before, columns = self._search[1], [column]
        while before[columns[-1]] >= 0:
            columns.append(int(before[columns[-1]]))
        return np.vstack([self.start, self._place(np.column_stack(np.unravel_index(columns[::-1], self._room.shape)))])

    def _columns(
        self, voxel_map: VoxelMap, bounds: NDArray[np.float64], half_height: float, own_radius: float
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which columns (n, m) are free, and which are the vehicle's own place."""
        low, high = np.minimum(bounds[0], self.start), np.maximum(bounds[1], self.start)
        low[2], high[2] = self.start[2] - half_height, self.start[2] + half_height
        first, last = (np.floor(corner / self._cell).astype(int) for corner in (low, high))
        self._first, shape = first, tuple(last - first + 1)
        centres = (np.indices(shape).reshape(3, -1).T + first + 0.5) * self._cell
        states = voxel_map.state(centres).reshape(shape)
        away = np.linalg.norm(centres.reshape(*shape, 3)[:, :, 0, :2] - self.start[:2], axis=2)
        own = (away <= own_radius) & (states != State.OCCUPIED).all(axis=2)
        return (states == State.FREE).all(axis=2), own

    @cached_property
    def _search(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return path costs to all columns (n * m,), infinite if there is none, and the column before each."""
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra

        fits, number = self._room > self._radius, self._room.size
        start = np.floor(self.start / self._cell).astype(int)[:2] - self._first[:2]
        fits[tuple(start)] = True  # the vehicle is there, whatever the map says
        rows, columns, costs = [], [], []
        index = np.arange(number).reshape(self._room.shape)
        for step in SIDES:
            here, there = _beside(step)
            both = fits[here] & fits[there]
            room = np.minimum(self._room[here], self._room[there])[both]
            rows.append(index[here][both])
            columns.append(index[there][both])
            costs.append(np.hypot(*(np.array(step) * self._cell[:2])) * (1 + CLEAR / np.maximum(room, 0.05)))
        graph = csr_array(
            (np.concatenate(costs), (np.concatenate(rows), np.concatenate(columns))), shape=(number, number)
        )
        lengths, before = dijkstra(graph, False, index[tuple(start)], return_predecessors=True)
        return lengths, before

    def _place(self, columns: NDArray[np.integer]) -> NDArray[np.float64]:
        """Return the middles (..., 3) of columns (..., 2) at the start's height."""
        flat = (columns + self._first[:2] + 0.5) * self._cell[:2]
        return np.concatenate([flat, np.full((*flat.shape[:-1], 1), self.start[2])], axis=-1)


class Waypoints:
    """A tour of places, and the path home, through space that is known to be free.

    The loop that flies or drives calls `next` once the vehicle has stopped: at the end of a path, or where it had to be
    abandoned. If no known path reaches a place, the vehicle approaches it and explores, until no frontier is left to
    look at.

    Args:
        places: (N, 2) or (N, 3) metres in the map's frame, in order; heights are ignored.
        near: Metres within which a place counts as reached.
        home: Whether to return to the place of the first call.

    Attributes:
        reached: For each place, whether it was reached.
        is_home: Whether the tour ended at home.
        left: Number of places given up, home included, by reason.

    Raises:
        StereovoxError: The places have another shape or are not finite, or `near` is not above 0.
    """

    def __init__(self, places: ArrayLike, near: float = 0.3, home: bool = True):
        try:
            goals = np.asarray(places, float)
        except (TypeError, ValueError):
            raise StereovoxError(f"waypoints {shown(places)}: give (N, 2) or (N, 3) metres") from None
        if goals.ndim != 2 or goals.shape[1] not in (2, 3) or not np.isfinite(goals).all():
            raise StereovoxError(f"waypoints of shape {goals.shape}: give (N, 2) or (N, 3) finite metres")
        if not 0 < near < np.inf:
            raise StereovoxError(f"near {near}: give metres above 0")
        self.reached, self.is_home, self.left = [False] * len(goals), False, dict[str, int]()
        self._goals, self._near, self._returns, self._began = list(goals[:, :2]), near, home, False
        self._current, self._tries, self._best = 0, 0, np.inf
        self._looks: list[_Look] = []

    def next(self, voxel_map: VoxelMap, planner: LevelPlanner) -> Leg | None:
        """Return the next path.

        Args:
            voxel_map: The map, as it is now.
            planner: A planner on it, whose start is the vehicle's position.

        Returns:
            The path (N, 3) in metres, and the place (3,) to look at from its end; None once the tour is done.

        Raises:
            StereovoxError: As `frontiers`.
        """
        self._look(planner.start)
        if not self._began:
            self._began = True
            self._goals += [planner.start[:2].copy()] * self._returns
        while self._current < len(self._goals):
            goal = self._goals[self._current]
            if np.linalg.norm(planner.start[:2] - goal) <= self._near:
                self._arrive()
            elif (found := self._towards(goal, voxel_map, planner)) is not None:
                return found
            else:
                reason = ABANDONED if self._tries >= TRIES else NO_PATH
                self.left = dict(Counter(self.left) + Counter([reason]))
                self._go_on()
        return None

    def _arrive(self) -> None:
        if self._current < len(self.reached):
            self.reached[self._current] = True
        else:
            self.is_home = True
        self._go_on()

    def _go_on(self) -> None:
        self._current, self._tries, self._best, self._looks = self._current + 1, 0, np.inf, []

    def _towards(self, goal: NDArray[np.float64], voxel_map: VoxelMap, planner: LevelPlanner) -> Leg | None:
        """Return the path to a place, or one that reveals more of the route; None: give it up."""
        target = np.array([*goal, planner.start[2]])
        if (path := planner.path_to(target, self._near)) is not None:
            self._tries += 1
            return (path, target) if self._tries <= TRIES else None
        path = planner.path_to(target, np.inf)
        if path is not None and (away := float(np.linalg.norm(path[-1][:2] - goal))) < self._best - NEARER_M:
            self._best = away
            return path, target
        return self._explore(target, voxel_map, planner)

    def _explore(self, target: NDArray[np.float64], voxel_map: VoxelMap, planner: LevelPlanner) -> Leg | None:
        """Return the path to the frontier with the shortest route to a place, of those not looked at."""
        found = frontiers_around(voxel_map, planner)
        left = [one for one in found if not any(look.settles(one.centroid) for look in self._looks)]
        for near in NEAR_M:
            routes = []
            for one in left:
                path = None if one.look_from is None else planner.path_to(one.look_from, near)
                if path is not None:
                    away = float(np.linalg.norm(one.centroid - target))
                    routes.append((path_length(path) + away, path, one.centroid))
            if routes:
                _, path, place = min(routes, key=lambda route: route[0])
                self._looks.append(_Look(place, path[-1]))
                return path, place
        return None

    def _look(self, here: NDArray[np.float64]) -> None:
        """Record whether the last frontier was looked at, or how often the path to it was abandoned."""
        if self._looks and not self._looks[-1].tries:
            last = self._looks[-1]
            arrived = np.linalg.norm((here - last.end)[:2]) < NEARER_M
            before = sum(look.tries for look in self._looks if np.linalg.norm(look.place - last.place) < SAME_M)
            self._looks[-1] = last._replace(tries=TRIES if arrived else before + 1)


class _Look(NamedTuple):
    """A frontier (3,) to which a path led, and the path's end (3,).

    tries: TRIES if it was looked at, else how many paths there were abandoned; 0 until the next call.
    """

    place: NDArray[np.float64]
    end: NDArray[np.float64]
    tries: int = 0

    def settles(self, place: NDArray[np.float64]) -> bool:
        """Return whether a frontier there need not be looked at again."""
        return self.tries >= TRIES and bool(np.linalg.norm(place - self.place) < SAME_M)


def frontiers_around(voxel_map: VoxelMap, planner: LevelPlanner) -> list[Frontier]:
    """Return the frontiers at about the height of the vehicle, as seen from free space that it reaches."""
    heights, floor = (0.0, 2 * BAND), planner.start[2] - BAND
    return frontiers(voxel_map, FRONTIER_CELLS, heights=heights, floor=floor, start=planner.start, radius=0.2)


def _room(free: NDArray[np.bool_], cell: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a lower bound on the distance from any point of each column (n, m) to the nearest non-free one."""
    from scipy.ndimage import distance_transform_edt

    closed = np.pad(free, 1)  # everything outside is unknown
    between = np.asarray(distance_transform_edt(closed, sampling=cell[:2]))[1:-1, 1:-1]
    return np.maximum(between - np.hypot(*cell[:2]), 0)


def _beside(step: tuple[int, int]) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return the parts of an array whose columns have a neighbour at `step`, and those neighbours."""
    here = tuple(slice(max(-d, 0), -d if d > 0 else None) for d in step)
    there = tuple(slice(max(d, 0), d if d < 0 else None) for d in step)
    return (here[0], here[1]), (there[0], there[1])
