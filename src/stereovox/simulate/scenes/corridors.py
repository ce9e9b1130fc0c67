# SPDX-License-Identifier: Apache-2.0
"""Walls of corridors with niches, doors, pilasters and furniture, no two of them alike.

Frame of a wall: x along it, y from its surface into the corridor, z up from the floor, metres.

`sim:loop`: a ring of corridors, walked round several times. Frame of the plan: origin in the ring's middle.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform, transform_points
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.flight import walk
from stereovox.simulate.scene import Scene, Solid, box, cylinder
from stereovox.simulate.stage import SHIFT, Face, Stage, moved, rectangle, within

HEIGHT = 2.6
"""Height of corridors."""
THICKNESS = 0.6
"""Thickness of walls: niches fit into them."""
DEEP = 0.46
"""Largest depth of furniture in front of a wall."""
PLAIN = 0.8
"""Metres of bare wall at both ends of each wall."""
BAY = (2.2, 3.4)
"""Smallest and largest length of a bay."""


@dataclass(frozen=True)
class Opening:
    """A recess in a wall: its start and end, height and depth."""

    start: float
    end: float
    top: float
    deep: float


Bay = tuple[Opening | None, list[Solid]]
"""A recess in the wall, if any, and the objects in or in front of it."""


def wall(name: str, length: float, random: np.random.Generator) -> list[Solid]:
    """Return a wall of `length` metres, at least 2, with all objects in and in front of it, in its frame."""
    bays = max(1, round((length - 2 * PLAIN) / np.mean(BAY)))
    widths = random.uniform(*BAY, bays)
    starts = PLAIN + (length - 2 * PLAIN) * np.append(0, np.cumsum(widths)) / widths.sum()
    solids, at = [], 0.0
    kinds: list[Callable[[str, float, float, np.random.Generator], Bay]] = []
    for n, (start, end) in enumerate(itertools.pairwise(starts.tolist()), 1):
        kinds = kinds or [KINDS[k] for k in random.permutation(len(KINDS))]
        opening, things = kinds.pop()(f"{name}, bay {n}", start, end, random)
        solids += things
        if opening:
            solids += _pierced(f"{name}, bay {n}", at, opening)
            at = opening.end
    return [*solids, box("walls", f"{name}, end", (at, -THICKNESS, 0), (length, 0, HEIGHT))]


def _pierced(name: str, at: float, hole: Opening) -> list[Solid]:
    """Return the wall from `at` to the end of the recess."""
    return [
        box("walls", f"{name}: before the opening", (at, -THICKNESS, 0), (hole.start, 0, HEIGHT)),
        box("walls", f"{name}: above the opening", (hole.start, -THICKNESS, hole.top), (hole.end, 0, HEIGHT)),
        box("walls", f"{name}: behind the opening", (hole.start, -THICKNESS, 0), (hole.end, -hole.deep, hole.top)),
    ]


def _niche(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, wide = _place(start, end, random.uniform(0.7, 1.4), random)
    deep = random.uniform(0.2, 0.45)
    thing, tall = random.uniform(0.2, wide - 0.2), random.uniform(0.2, 1.2)
    inside = box("things", f"{name}: in the niche", (x + 0.1, -deep, 0), (x + 0.1 + thing, -0.1, tall))
    return Opening(x, x + wide, random.uniform(1.6, 2.4), deep), [inside]


def _door(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, wide = _place(start, end, random.uniform(0.8, 1.2), random)
    deep, top, jamb, out = random.uniform(0.06, 0.2), random.uniform(1.95, 2.2), random.uniform(0.05, 0.1), 0.03
    frame = [
        box("door frames", f"{name}: first jamb", (x - jamb, 0, 0), (x, out, top)),
        box("door frames", f"{name}: second jamb", (x + wide, 0, 0), (x + wide + jamb, out, top)),
        box("door frames", f"{name}: head", (x - jamb, 0, top), (x + wide + jamb, out, top + jamb)),
    ]
    return Opening(x, x + wide, top, deep), frame


def _pilaster(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, wide = _place(start, end, random.uniform(0.3, 0.7), random)
    return None, [box("pilasters", f"{name}: pilaster", (x, 0, 0), (x + wide, random.uniform(0.12, 0.35), HEIGHT))]


def _cabinet(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, wide = _place(start, end, random.uniform(0.6, 1.5), random)
    deep, top = random.uniform(0.3, 0.45), random.uniform(0.6, 1.9)
    left, right = x + np.sort(random.uniform(0.1, wide - 0.1, 2))
    tall = random.uniform(0.1, 0.5)
    return None, [
        box("furniture", f"{name}: cabinet", (x, 0, 0), (x + wide, deep, top)),
        box("things", f"{name}: on it", (left, 0.05, top), (right, deep - 0.05, top + tall)),
    ]


def _shelf(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, wide = _place(start, end, random.uniform(0.7, 1.4), random)
    deep, top = random.uniform(0.25, 0.4), random.uniform(1.2, 2.0)
    boards = np.linspace(0.1, top - 0.03, int(random.integers(3, 6)))
    return None, [
        box("furniture", f"{name}: shelf, first side", (x, 0, 0), (x + 0.03, deep, top)),
        box("furniture", f"{name}: shelf, second side", (x + wide - 0.03, 0, 0), (x + wide, deep, top)),
        *(
            box("furniture", f"{name}: board {n}", (x + 0.03, 0, z), (x + wide - 0.03, deep, z + 0.03))
            for n, z in enumerate(boards.tolist(), 1)
        ),
        *(
            box("things", f"{name}: books {n}", (x + 0.05, 0, z + 0.03), (x + random.uniform(0.2, 0.6), 0.22, z + 0.25))
            for n, z in enumerate(boards[:-1].tolist(), 1)
        ),
    ]


def _bench(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, wide = _place(start, end, random.uniform(0.9, 1.6), random)
    deep, top = random.uniform(0.3, 0.44), random.uniform(0.4, 0.5)
    return None, [
        box("furniture", f"{name}: bench", (x, 0.02, top - 0.05), (x + wide, deep, top)),
        *(
            box("furniture", f"{name}: leg {n}", (x + at, 0.05, 0), (x + at + 0.06, deep - 0.03, top - 0.05))
            for n, at in enumerate((0.1, wide - 0.16), 1)
        ),
        box("boards", f"{name}: picture", (x + 0.2, 0, 1.3), (x + random.uniform(0.5, 0.9), 0.04, 1.9)),
    ]


def _parcels(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, _ = _place(start, end, 1.4, random)
    solids, z = [], 0.0
    for n, shrunk in enumerate((1.0, 0.8, 0.65)[: int(random.integers(1, 4))], 1):
        wide, deep, tall = shrunk * random.uniform([0.35, 0.25, 0.3], [0.5, 0.33, 0.5])
        low, high = (x + 0.3 - wide / 2, 0.23 - deep / 2, z), (x + 0.3 + wide / 2, 0.23 + deep / 2, z + tall)
        solids.append(box("things", f"{name}: parcel {n}", low, high, turn=random.uniform(-0.25, 0.25)))
        z += tall
    x, thick, tall = x + random.uniform(0.8, 1.3), random.uniform(0.15, 0.4), random.uniform(0.4, 1.5)
    return None, [*solids, cylinder("things", f"{name}: bin", (x, 0.23, 0), (x, 0.23, tall), thick)]


def _pipe(name: str, start: float, end: float, random: np.random.Generator) -> Bay:
    x, _ = _place(start, end, 1.2, random)
    thick, wide = random.uniform(0.06, 0.16), random.uniform(0.4, 0.9)
    return None, [
        cylinder("things", f"{name}: pipe", (x, 0.12, 0), (x, 0.12, HEIGHT), thick),
        box("boards", f"{name}: board", (x + 0.2, 0, random.uniform(0.9, 1.2)), (x + 0.2 + wide, 0.05, 1.9)),
    ]


def _place(start: float, end: float, wide: float, random: np.random.Generator) -> tuple[float, float]:
    """Return start and width of an object in a bay, with the width limited to what fits."""
    wide = min(wide, end - start - 0.4)
    return random.uniform(start + 0.2, end - 0.2 - wide), wide


KINDS = (_niche, _door, _pilaster, _cabinet, _shelf, _bench, _parcels, _pipe)
"""Possible contents of a bay; all are used before one repeats."""


HALF = 1.0
"""Half width of the corridors."""
SWAY = HALF - DEEP - 0.4
"""Largest distance of the walker from the middle: at least 0.4 m from all objects."""
LONG = 0.6
"""Share of the ring's length that its two long sides take."""
STEP, BEYOND = 1.5, 2
"""Metres from waypoint to waypoint, and number of waypoints of the last lap beyond the start."""
TURN_DEG = 45.0
"""Mean degrees a second at corners."""
HZ, IMAGE_WIDTH = 10.0, 212
SIDES = ("south", "east", "north", "west")


def stage(*, length: float = 60.0, laps: int = 2, plan: int = 0, speed: float = 1.2) -> Stage:
    """Return a rectangular ring of corridors, `length` metres round, and a walk of `laps` laps at `speed` m/s.

    plan: seed of niches, doors, pilasters and furniture, no two of which are alike, and of the walker's distance from
    the middle. The walk begins in the middle of the south side, goes anticlockwise, faces forward and ends 3 m or less
    beyond its start. Images are 212 pixels wide, 10 a second. World: z up, corridors along x and y, 2 m wide, floor at
    0 and the origin in the ring's middle except for odd millimetres. Parts: `walls`, `floor`, `ceiling`, `beams`, `door
    frames`, `pilasters`, `furniture`, `things`, `boards`. faces: the walls of all sides, named `south outer` and the
    like; niches and doors are holes in them, with objects in front of them. Raises SourceError for values out of range.
    """
    within("length", length, 30, 1000)
    within("laps", laps, 1, 100)
    within("plan", plan, 0, 2**31)
    within("speed", speed, 0.1, 3)
    size = np.array([LONG, 1 - LONG]) * length / 2
    T_world_plan = np.eye(4)
    T_world_plan[:3, 3] = SHIFT
    path, seconds = walk(_waypoints(size, laps, np.random.default_rng([plan, 1])), speed, TURN_DEG)

    def build() -> Scene:
        return moved(Scene(_ring(size, np.random.default_rng([plan, 0]))), T_world_plan)

    return Stage(
        build,
        lambda share: T_world_plan @ path(share),
        round(seconds * HZ) + 1,
        HZ,
        device=D435(camera=depth_camera(IMAGE_WIDTH)),
        faces=tuple(Face(face.name, transform_points(T_world_plan, face.corners)) for face in _faces(size)),
    )


def _waypoints(size: NDArray[np.float64], laps: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return x, y and yaw in degrees (N, 3) of a walk in the middle of the corridors; size: (2,) of the ring."""
    points, start = [], 0
    for leg in range(4 * laps + 1):
        T, long = _leg(size, leg % 4), size[leg % 2]
        count = 2 * math.ceil((long / 2 - HALF) / STEP) + 1  # one of them in the middle
        along = np.linspace(HALF, long - HALF, count)
        aside = random.uniform(-SWAY, SWAY, count)
        on_leg = transform_points(T, np.column_stack([along, aside, 0 * along]))[:, :2]
        start = len(points) + count // 2
        points += [(x, y, 90.0 * leg) for x, y in on_leg.tolist()]
    first = math.ceil((size[0] / 2 - HALF) / STEP)
    return np.array(points[first : start + 1 + BEYOND])


def _leg(size: NDArray[np.float64], leg: int) -> Transform:
    """Return T_plan_leg: x along the middle of a side from the corner where it begins, y to the inside."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[leg]
    T = np.eye(4)
    T[:2, :2] = [[cosine, -sine], [sine, cosine]]
    T[:2, 3] = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)][leg]) * size / 2
    return T


def _walls(size: NDArray[np.float64], leg: int) -> tuple[tuple[Transform, float], tuple[Transform, float]]:
    """Return T_plan_wall and length of a side's outer and inner wall, as visible from the corridor."""
    outer, inner = np.eye(4), np.diag([-1.0, -1, 1, 1])
    outer[:2, 3] = -HALF, -HALF
    inner[:2, 3] = size[leg % 2] - HALF, HALF
    T = _leg(size, leg)
    return (T @ outer, size[leg % 2] + 2 * HALF), (T @ inner, size[leg % 2] - 2 * HALF)


def _faces(size: NDArray[np.float64]) -> list[Face]:
    return [
        Face(f"{side} {name}", transform_points(T, rectangle("", (0, 0, 0), (long, 0, HEIGHT), (0, 1, 0)).corners))
        for leg, side in enumerate(SIDES)
        for name, (T, long) in zip(("outer", "inner"), _walls(size, leg), strict=True)
    ]


def _ring(size: NDArray[np.float64], random: np.random.Generator) -> list[Solid]:
    """Return all solids; at inner corners both walls fill the corner."""
    x, y = size / 2 + HALF + THICKNESS
    solids = [
        box("floor", "floor", (-x, -y, -THICKNESS), (x, y, 0)),
        box("ceiling", "ceiling", (-x, -y, HEIGHT), (x, y, HEIGHT + THICKNESS)),
    ]
    for leg, side in enumerate(SIDES):
        (T_outer, long), (T_inner, short) = _walls(size, leg)
        corner = box("walls", f"{side} corner", (-THICKNESS, -THICKNESS, 0), (0, 0, HEIGHT))
        solids += moved(Scene([corner, *wall(f"{side} outer", long, random)]), T_outer).solids
        solids += moved(Scene(wall(f"{side} inner", short, random)), T_inner).solids
        solids += moved(Scene(_beams(side, float(size[leg % 2]), random)), _leg(size, leg)).solids
    return solids


def _beams(side: str, long: float, random: np.random.Generator) -> list[Solid]:
    """Return beams across a side's ceiling, one every 4 m, in its frame."""
    count = math.ceil(long / 4)
    at = HALF + (np.arange(count) + random.random(count)) * (long - 2 * HALF - 0.4) / count
    sizes = random.uniform(0.1, 0.4, (count, 2))
    return [
        box("beams", f"{side}, beam {n}", (x, -HALF, HEIGHT - deep), (x + wide, HALF, HEIGHT))
        for n, (x, (wide, deep)) in enumerate(zip(at.tolist(), sizes.tolist(), strict=True), 1)
    ]
