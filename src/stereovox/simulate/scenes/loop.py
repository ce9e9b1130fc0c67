# SPDX-License-Identifier: Apache-2.0
"""`sim:loop`: a ring of corridors, walked round several times. Frame of the plan: origin in the ring's middle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform, transform_points
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box
from stereovox.simulate.scenes.corridors import DEEP, HEIGHT, THICKNESS, wall
from stereovox.simulate.stage import SHIFT, Face, Stage, moved, rectangle, within
from stereovox.simulate.walking import walk

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
