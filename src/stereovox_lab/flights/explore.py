# SPDX-License-Identifier: Apache-2.0
"""Autonomous missions of a simulated quadrotor: find the middle of a room and look around, and explore a hall.

Each goal is reached by a known free path, and the vehicle faces where it flies; during flight, the path ahead is
checked against the newest map, and if it is no longer free the vehicle stops and replans.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict, dataclass, field
from math import inf
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.products.frontiers import Frontier
from stereovox.products.level_ways import Leg, LevelPlanner, Waypoints, frontiers_around
from stereovox.products.path_check import check_path, path_length, point_along
from stereovox_lab.flights.air import Air
from stereovox_lab.flights.flight import STEP_S, World
from stereovox_lab.flights.quadrotor import Airframe, Quadrotor

LOOK_S = 8.0
"""Seconds of a turn in place."""
ARRIVED, AHEAD = 0.15, 0.5
"""Metres from the end of a path at which it counts as flown, and look-ahead distance along the path."""
CHECK_M, CHECK_S = 1.0, 0.2
"""Metres of the path that are checked, and seconds between checks."""
FACING = 0.5
"""It flies once it faces along its path within this many radians."""
NEAR_M, SHORT_M = 0.5, 2.0
"""A path leads to within NEAR_M of a frontier's viewpoint; if none does, one that ends SHORT_M short brings the vehicle
nearer, and it looks from there."""
SEEN_AGAIN, TRIES = 0.6, 3
"""A look from within this many metres of an earlier place at a target within as many metres of the earlier one shows
nothing new. A path there that had to be abandoned this often is not tried again."""
ROUND_M, ROUNDS = 1.5, 3
"""Metres between places from which it looks around, and most such looks in a row without a reachable frontier."""
UNSEEN, NO_WAY, LOOKED_AT = "seen from nowhere", "no way to it", "looked at already"
"""Reasons why a frontier remains."""


@dataclass(frozen=True)
class Cruise:
    """Settings of a mission.

    Attributes:
        scene: Simulation; `{seed}` in it is replaced by the flight's seed.
        seconds: Longest time of a mission.
        speed: m/s along paths.
        turn: Radians a second.
        voxel_size: Of the map, metres.
        camera_hz: Images a second.
        delay_s: Delay from the image to the map.
        margin: Metres between the propellers and cells not known to be free.
        half_height: Metres above and below the vehicle that must be free.
        own_radius: As in `SectorRules`.
        airframe: The quadrotor.
    """

    scene: str = "sim:hall?plan={seed}"
    seconds: float = 300.0
    speed: float = 0.6
    turn: float = 1.0
    voxel_size: float = 0.1
    camera_hz: float = 10.0
    delay_s: float = 0.06
    margin: float = 0.1
    half_height: float = 0.3
    own_radius: float = 0.75
    airframe: Airframe = field(default_factory=Airframe)

    @property
    def radius(self) -> float:
        """Radius of the ball whose path must be free."""
        return self.airframe.radius + self.margin


class Mission(Protocol):
    """Chooses goals.

    Attributes:
        left: When done: number of remaining goals that it cannot reach, by reason.
    """

    left: dict[str, int]

    def next(self, voxel_map: VoxelMap, planner: LevelPlanner) -> Leg | None:
        """Return a path (N, 3) and the place (3,) to look at from its end, NaN to look all around; None when done."""
        ...


class MiddleOfRoom:
    """Find the middle of a room and look around there, until its position no longer changes."""

    def __init__(self, looks: int = 3):
        self._looks_left, self._last = looks, np.full(3, inf)
        self.room_m = 0.0
        self.left: dict[str, int] = {}

    def next(self, voxel_map: VoxelMap, planner: LevelPlanner) -> Leg | None:
        """Return the path to the middle as currently known."""
        found = planner.middle()
        if found is None or not self._looks_left or np.linalg.norm(found[0] - self._last) < 2 * ARRIVED:
            return None
        (self._last, self.room_m), self._looks_left = found, self._looks_left - 1
        way = planner.path_to(self._last)
        return None if way is None else (way, np.full(3, np.nan))


class Frontiers:
    """Explore: go to the frontier nearest along the path and look at it; if none is reachable, look all around from as
    near as possible to one, the largest first, until that was in vain ROUNDS times."""

    def __init__(self) -> None:
        self._looks: list[tuple[NDArray[np.float64], NDArray[np.float64], bool]] = []
        self._rounds: list[NDArray[np.float64]] = []
        self._in_vain = 0
        self.left: dict[str, int] = {}

    def next(self, voxel_map: VoxelMap, planner: LevelPlanner) -> Leg | None:
        """Return the path to the nearest frontier's viewpoint, or to a place to look all around."""
        self._rounds = self._rounds or [planner.start]  # it turned once at the start
        found = frontiers_around(voxel_map, planner)
        if self._looks:  # the last was seen only if it reached the end of the path
            place, end, _ = self._looks[-1]
            self._looks[-1] = place, end, bool(np.linalg.norm((planner.start - end)[:2]) < 2 * ARRIVED)
        best = self._nearest(found, planner, NEAR_M) or self._nearest(found, planner, SHORT_M)
        self._in_vain = 0 if best is not None else self._in_vain + 1
        if best is None and self._in_vain <= ROUNDS:
            best = self._round(found, planner)
        if best is None:
            self.left = self._why_left(found, planner)
        else:
            self._looks.append((best[1], best[0][-1], False))
        return best

    def _is_done(self, place: NDArray[np.float64], end: NDArray[np.float64]) -> bool:
        """Return whether a frontier was seen from about there, or the path there was abandoned TRIES times."""
        same = [
            looked
            for at, from_, looked in self._looks
            if np.linalg.norm(place - at) < SEEN_AGAIN and np.linalg.norm(end - from_) < SEEN_AGAIN
        ]
        return any(same) or len(same) >= TRIES

    def _nearest(self, found: list[Frontier], planner: LevelPlanner, near: float) -> Leg | None:
        """Return the shortest path to within `near` metres of a frontier's viewpoint, and the frontier's middle."""
        best: Leg | None = None
        for one in found:
            way = None if one.look_from is None else planner.path_to(one.look_from, near)
            if way is None or self._is_done(one.centroid, way[-1]):
                continue
            if best is None or path_length(way) < path_length(best[0]):
                best = way, one.centroid
        return best

    def _round(self, found: list[Frontier], planner: LevelPlanner) -> Leg | None:
        """Return the path to a look around from as near as possible to a frontier, the largest first."""
        for one in found:
            way = planner.path_to(one.centroid, inf)
            if way is not None and all(np.linalg.norm((way[-1] - place)[:2]) > ROUND_M for place in self._rounds):
                self._rounds.append(way[-1])
                return way, np.full(3, np.nan)
        return None

    def _why_left(self, found: list[Frontier], planner: LevelPlanner) -> dict[str, int]:
        """Count the remaining frontiers, by the reason they are not goals."""
        why = []
        for one in found:
            if one.look_from is None:
                why.append(UNSEEN)
            else:
                why.append(NO_WAY if planner.path_to(one.look_from, SHORT_M) is None else LOOKED_AT)
        return {reason: why.count(reason) for reason in (UNSEEN, NO_WAY, LOOKED_AT)}


@dataclass(frozen=True)
class Explored:
    """The result of a mission.

    Attributes:
        seed: Seed of hall, start and noise.
        collided_s: Time in seconds of a propeller's contact; None: no contact.
        seconds: Flight time.
        done: Whether the mission ended by itself.
        metres: Distance flown.
        goals: Number of paths flown, or begun.
        clearance_m: Least distance between its middle and a surface.
        coverage: (seconds, share of the scene's air known to be free) every ten seconds.
        place: (3,) metres, its last position.
        path: (3,) metres every second.
        room_m: Horizontal clearance at its last position in metres, `half_height` above and below.
        most_room_m: The largest such clearance in the scene's air at its height.
        left: Number of goals left (frontiers, or waypoints and home), by reason; empty if it did not end by itself.
        reached: Number of waypoints reached, and home: whether it returned; None for other missions.
    """

    seed: int
    collided_s: float | None
    seconds: float
    done: bool
    metres: float
    goals: int
    clearance_m: float
    coverage: list[tuple[float, float]]
    place: list[float]
    path: list[list[float]]
    room_m: float
    most_room_m: float
    left: dict[str, int]
    reached: int | None = None
    home: bool | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return all values as plain types for JSON."""
        return asdict(self)


def fly(
    seed: int, mission: Mission, cruise: Cruise | None = None, world: World | None = None
) -> tuple[Explored, VoxelMap]:
    """Fly a mission.

    Args:
        seed: Seed of hall, start and noise.
        mission: Chooses goals.
        cruise: Settings; by default `Cruise()`.
        world: The scene, if already built.

    Returns:
        The result, and the map.
    """
    cruise = cruise or Cruise()
    flown = _Mission(seed, mission, cruise, world or World(cruise.scene.format(seed=seed)))
    return flown.run(), flown.map


class _Mission:
    """The parts of a mission and the times at which they act."""

    def __init__(self, seed: int, mission: Mission, cruise: Cruise, world: World):
        self._seed, self._mission, self._cruise, self._world = seed, mission, cruise, world
        draw = np.random.default_rng([seed, 1])
        place = world.start(draw)
        self._quad = Quadrotor(place, draw.uniform(-np.pi, np.pi), cruise.airframe)
        self._height = float(place[2])
        self._mapper = Mapper("default", voxel_size=cruise.voxel_size)
        self._air = Air(world.camera.scene, cruise.voxel_size, place)
        self._under_way: deque[tuple[float, Transform]] = deque()
        self._images = self._goals = 0
        self._way: NDArray[np.float64] | None = None
        self._look_at = np.full(3, np.nan)
        self._look_left = 2 * np.pi
        self._checked = 0.0

    @property
    def map(self) -> VoxelMap:
        """The map so far."""
        return self._mapper.map

    def run(self) -> Explored:
        """Fly until the mission is done, time is up, or a collision."""
        metres, least, collided, done, coverage, now = 0.0, inf, None, False, [], 0.0
        path: list[list[float]] = []
        for step in range(round(self._cruise.seconds / STEP_S)):
            now = step * STEP_S
            self._see(now)
            if not step % round(10 / STEP_S):
                coverage.append((now, self._air.known(self._mapper.map)))
            if not step % round(1 / STEP_S):
                path.append(self._quad.position.round(3).tolist())
            if self._way is None and self._look_left <= 0 and not self._choose():
                done = True
                break
            before = self._quad.position.copy()
            self._steer(now)
            metres += float(np.linalg.norm(self._quad.position - before))
            room = self._world.clearance.at(self._quad.position, 2.0)
            least = min(least, room)
            if room < self._quad.frame.radius:
                collided = now
                break
        coverage.append((now, self._air.known(self._mapper.map)))
        place = self._quad.position
        room_m, most_m = self._air.room(place, self._cruise.half_height)
        course = (metres, self._goals, least, coverage, place.tolist(), path, room_m, most_m, self._mission.left)
        tour = self._mission if isinstance(self._mission, Waypoints) else None
        reached, home = (None, None) if tour is None else (sum(tour.reached), tour.is_home)
        return Explored(self._seed, collided, now, done, *course, reached, home)

    def _see(self, now: float) -> None:
        """Take an image if one is due, and add images to the map whose delay has passed."""
        if now >= self._images / self._cruise.camera_hz:
            self._under_way.append((now, self._quad.T_world_body))
            self._images += 1
        while self._under_way and now >= self._under_way[0][0] + self._cruise.delay_s:
            taken, T = self._under_way.popleft()
            number = self._seed * 1_000_000 + round(taken * 1000)
            self._mapper.add(self._world.camera.frame_from(T, number, round(1e9 * taken)))

    def _choose(self) -> bool:
        """Choose the next path; return whether there is one."""
        cruise = self._cruise
        here = np.array([*self._quad.position[:2], self._height])
        planner = LevelPlanner(self._mapper.map, here, cruise.radius, cruise.half_height, cruise.own_radius)
        found = self._mission.next(self._mapper.map, planner)
        if found is None:
            return False
        (self._way, self._look_at), self._goals = found, self._goals + 1
        return True

    def _steer(self, now: float) -> None:
        """Fly one step along the path, or turn."""
        quad, cruise = self._quad, self._cruise
        if self._way is None:
            rate = self._turning()
            quad.step(np.zeros(2), self._height, rate, STEP_S)
            return
        along = _passed(self._way, quad.position)
        target = point_along(self._way, along + AHEAD)
        off = _turn(quad.yaw, target - quad.position)
        rate = float(np.clip(2 * off, -cruise.turn, cruise.turn))
        if path_length(self._way) - along < ARRIVED or not self._free_ahead(now, along):
            self._way, rate = None, 0.0
            self._look_left = 2 * np.pi if np.isnan(self._look_at).any() else 1.0
        flown = np.zeros(2)
        if self._way is not None and abs(off) < FACING:
            step = (target - quad.position)[:2]
            flown = (
                step / max(float(np.linalg.norm(step)), 1e-9) * min(cruise.speed, path_length(self._way) - along + 0.1)
            )
        quad.step(flown, self._height, rate, STEP_S)

    def _turning(self) -> float:
        """Return the rate of a full turn, or of a turn towards a place that is then faced for a second."""
        if np.isnan(self._look_at).any():
            rate = 2 * np.pi / LOOK_S
            self._look_left -= rate * STEP_S
            return rate
        off = _turn(self._quad.yaw, self._look_at - self._quad.position)
        if abs(off) < 0.2:
            self._look_left -= STEP_S
        return float(np.clip(2 * off, -self._cruise.turn, self._cruise.turn))

    def _free_ahead(self, now: float, along: float) -> bool:
        """Return whether the next metre of the path is free in the newest map, except the vehicle's own place."""
        if self._way is None or now - self._checked < CHECK_S:
            return True
        self._checked, cruise = now, self._cruise
        start, end = along + cruise.own_radius, min(along + cruise.own_radius + CHECK_M, path_length(self._way))
        if end <= start:
            return True
        places = [point_along(self._way, metres) for metres in np.linspace(start, end, 6)]
        return check_path(self._mapper.map, places, cruise.airframe.radius).free


def _passed(way: NDArray[np.float64], place: NDArray[np.float64]) -> float:
    """Return the distance along a path of its point nearest to a place."""
    a, b = way[:-1, :2], way[1:, :2]
    share = ((place[:2] - a) * (b - a)).sum(axis=1) / np.maximum(((b - a) ** 2).sum(axis=1), 1e-12)
    share = np.clip(share, 0, 1)
    near = int(np.argmin(np.linalg.norm(a + share[:, None] * (b - a) - place[:2], axis=1)))
    lengths = np.linalg.norm(b - a, axis=1)
    return float(lengths[:near].sum() + share[near] * lengths[near])


def _turn(yaw: float, towards: NDArray[np.float64]) -> float:
    """Return the turn to the left from a yaw to a direction, -pi to pi."""
    return float((np.arctan2(towards[1], towards[0]) - yaw + np.pi) % (2 * np.pi) - np.pi)
