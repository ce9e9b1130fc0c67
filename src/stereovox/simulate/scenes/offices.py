# SPDX-License-Identifier: Apache-2.0
"""`sim:offices`: a corridor with identical offices on both sides, some of which are visited again.

An office with its half of the corridor is built once and placed at `office_pose` of each number. Frame of
an office: origin on the floor in the middle of the corridor, x through the middle of the door into the office, y left,
z up. Even numbers are on the left of the corridor (+y), odd ones opposite.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.geometry.se3 import Transform, transform_points
from stereovox.simulate import flight
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Point, Scene, Solid, box, cylinder
from stereovox.simulate.scenes.apartment import chair
from stereovox.simulate.stage import SHIFT, Face, Stage, moved, rectangle, within

HALF, BAY, DEEP, HEIGHT = 1.0, 3.6, 4.0, 2.6
"""Half width of the corridor; distance of doors along it; inner length of an office from its door; height of all."""
WALL, FLOOR = 0.12, 0.2
"""Thickness of walls, and of floor and ceiling."""
DOOR, LINTEL = 0.5, 2.05
"""Half width and height of the doors."""
BACK = HALF + WALL + DEEP
"""Back of an office, in its frame."""
SIDE = (BAY - WALL) / 2
"""Half width of an office."""
BEFORE = 0.9
"""Metres from a door at which the walker turns to it and, later, has turned away."""
START = 0.6
"""Start and end of the walk: metres from the corridor's end."""
VISIT = np.array([
    # x, y, yaw in degrees, in the office's frame; variation of the position in metres and of yaw in degrees
    [0.35, 0.0, 0, 0, 0],
    [1.06, 0.0, 0, 0, 0],  # door
    [2.10, 0.1, 50, 0.1, 10],
    [2.80, 0.1, 0, 0.1, 10],
    [3.10, -0.2, -60, 0.1, 10],
    [2.90, -0.3, -120, 0.1, 10],
    [2.20, -0.1, -180, 0.1, 10],
    [1.06, 0.0, -180, 0, 0],
    [0.35, 0.0, -180, 0, 0],
])  # fmt: skip
"""Into an office, once round, and out again."""
SWAY = 0.1
"""Largest distance of the walker from the corridor's middle."""
TURN_DEG = 50.0
HZ, IMAGE_WIDTH = 10.0, 212
FURNITURE: dict[str, tuple[str, Point, Point]] = {
    "desk": ("desks", (4.35, 0.1, 0.71), (5.1, 1.7, 0.75)),
    "drawers": ("desks", (4.45, 1.2, 0), (5.05, 1.65, 0.71)),
    "screen": ("desks", (4.9, 0.5, 0.85), (4.94, 1.1, 1.2)),
    "screen stand": ("desks", (4.86, 0.75, 0.75), (4.98, 0.85, 0.85)),
    "cabinet": ("cabinets", (1.14, 0.8, 0), (1.6, 1.72, 1.2)),
    "box on the cabinet": ("cabinets", (1.2, 1.1, 1.2), (1.5, 1.5, 1.45)),
    "shelf, first side": ("shelves", (2.8, -SIDE, 0), (2.83, -1.42, 1.9)),
    "shelf, second side": ("shelves", (4.17, -SIDE, 0), (4.2, -1.42, 1.9)),
    **{
        f"board {n}": ("shelves", (2.83, -SIDE, z), (4.17, -1.42, z + 0.03))
        for n, z in enumerate((0.1, 0.55, 1.0, 1.45, 1.87), 1)
    },
    "books, low": ("shelves", (2.9, -SIDE, 0.58), (3.5, -1.48, 0.83)),
    "books, high": ("shelves", (3.3, -SIDE, 1.03), (4.1, -1.48, 1.26)),
    "bench": ("corridor", (0.65, -1.6, 0.4), (0.98, -0.95, 0.45)),
    "bench, first leg": ("corridor", (0.7, -1.55, 0), (0.95, -1.5, 0.4)),
    "bench, second leg": ("corridor", (0.7, -1.05, 0), (0.95, -1.0, 0.4)),
    "notice board": ("corridor", (0.96, 0.8, 1.1), (1.0, 1.5, 1.9)),
}
"""Part, lowest and highest corner by name, in the office's frame."""


def stage(*, offices: int = 8, visits: int = 10, walk: int = 0, speed: float = 1.0) -> Stage:
    """Return a corridor with identical `offices` on both sides, and a walk that visits some of them again.

    All bays of the corridor are also the same, from either direction; only its two ends have a wall. walk: seed of the
    random order of `visits` visits, never to the same office twice in a row, and of small
    differences in position and heading. In each office the walker turns once round; the walk begins and ends at the
    corridor's end, at `speed` m/s. `place` names the place of a pose. Images are 212 pixels wide, 10 a second. World: z
    up,
    x along the corridor from its end, origin on the floor in its middle except for odd millimetres. Parts: `walls`,
    `floor`, `ceiling`, `door frames`, `desks`, `chairs`, `cabinets`, `shelves`, `corridor`. faces: the corridor's four
    walls; doors are holes in them. Raises SourceError for values out of range.
    """
    within("offices", offices, 2, 200)
    if offices % 2:
        raise SourceError(f"offices={offices} must be even: they are on both sides of the corridor")
    within("visits", visits, 1, 1000)
    within("walk", walk, 0, 2**31)
    within("speed", speed, 0.1, 2)
    waypoints = _waypoints(offices, visits, np.random.default_rng(walk))
    path, seconds = flight.walk(waypoints, speed, TURN_DEG)
    T_world_plan = np.eye(4)
    T_world_plan[:3, 3] = SHIFT
    return Stage(
        lambda: Scene(_building(offices)),
        lambda share: T_world_plan @ path(share),
        round(seconds * HZ) + 1,
        HZ,
        device=D435(camera=depth_camera(IMAGE_WIDTH)),
        faces=tuple(Face(face.name, transform_points(T_world_plan, face.corners)) for face in _faces(offices)),
    )


def office_pose(number: int) -> Transform:
    """Return T_world_office (4, 4); the same pose in two offices has the same view."""
    sign = -1 if number % 2 else 1
    T = np.eye(4)
    T[:2, :2] = [[0, -sign], [sign, 0]]
    T[:3, 3] = SHIFT
    T[0, 3] += (number // 2 + 0.5) * BAY
    return T


def place(T_world_camera: Transform) -> str:
    """Return the place of a true pose (4, 4), world z up: `office 3`, or `bay 1` of the corridor.

    Doorways belong to the office.
    """
    x, y, _ = T_world_camera[:3, 3] - SHIFT
    bay = int(x // BAY)
    return f"bay {bay}" if abs(y) < HALF else f"office {2 * bay + int(y < 0)}"


def _waypoints(offices: int, visits: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return x, y (metres, plan) and yaw in degrees (N, 3) of the walk."""
    x, last = 0.0, -1
    points = [np.array([[START, 0.0, 0.0]])]
    for _ in range(visits):
        last = int(random.choice([number for number in range(offices) if number != last]))
        door = (last // 2 + 0.5) * BAY
        points += [_along(x, door, random), _visit(last, random)]
        x = door
    points += [_along(x, 0.0, random), np.array([[START, SWAY, 270.0], [START, 0.0, 360.0]])]
    way = np.concatenate(points)
    return np.column_stack([way[:, :2], np.unwrap(way[:, 2], period=360)])


def _along(start: float, end: float, random: np.random.Generator) -> NDArray[np.float64]:
    """Return waypoints (N, 3) in the corridor from one door to another; none if they are opposite."""
    ahead = np.sign(end - start)
    first, last = start + BEFORE * ahead, end - BEFORE * ahead
    middles = BAY * (np.arange(min(start, end) // BAY, max(start, end) // BAY + 1) + 0.5)
    between = middles[(middles - first) * (middles - last) < 0]
    xs = np.unique(np.round([first, *between, last], 6))[:: int(ahead)] if ahead else np.empty(0, np.float64)
    yaw = 0.0 if ahead > 0 else 180.0
    return np.array([(x, random.uniform(-SWAY, SWAY), yaw) for x in xs.tolist()]).reshape(-1, 3)


def _visit(number: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return waypoints (N, 3) from the corridor in front of a door into the office and back."""
    x, y, yaw, metres, degrees = VISIT.T
    T_plan_office = office_pose(number)
    T_plan_office[:3, 3] -= SHIFT
    spot = np.column_stack([x, y, 0 * x]) + metres[:, None] * random.uniform(-1, 1, (len(x), 3))
    turned = yaw + degrees * random.uniform(-1, 1, len(x)) + np.degrees(np.arctan2(T_plan_office[1, 0], 0))
    return np.column_stack([transform_points(T_plan_office, spot)[:, :2], turned])


def _building(offices: int) -> list[Solid]:
    office = Scene(_office())
    solids = [
        replace(solid, name=f"office {number}: {solid.name}")
        for number in range(offices)
        for solid in moved(office, office_pose(number)).solids
    ]
    side = HALF + WALL
    ends = [("start wall", -WALL), ("end wall", offices // 2 * BAY)]
    walls = [box("walls", name, (x, -side, 0), (x + WALL, side, HEIGHT)) for name, x in ends]
    T_world_plan = np.eye(4)
    T_world_plan[:3, 3] = SHIFT
    return [*solids, *moved(Scene(walls), T_world_plan).solids]


def _office() -> list[Solid]:
    """Return an office and its half of the corridor, in its frame."""
    half, inner = BAY / 2, HALF + WALL
    return [
        box("floor", "floor", (0, -half, -FLOOR), (BACK + WALL, half, 0)),
        box("ceiling", "ceiling", (0, -half, HEIGHT), (BACK + WALL, half, HEIGHT + FLOOR)),
        box("walls", "wall, left of the door", (HALF, DOOR, 0), (inner, half, HEIGHT)),
        box("walls", "wall, right of the door", (HALF, -half, 0), (inner, -DOOR, HEIGHT)),
        box("walls", "wall, above the door", (HALF, -DOOR, LINTEL), (inner, DOOR, HEIGHT)),
        box("walls", "left wall", (inner, SIDE, 0), (BACK, half, HEIGHT)),
        box("walls", "right wall", (inner, -half, 0), (BACK, -SIDE, HEIGHT)),
        box("walls", "back wall", (BACK, -half, 0), (BACK + WALL, half, HEIGHT)),
        box("door frames", "left jamb", (HALF - 0.02, DOOR - 0.05, 0), (inner + 0.02, DOOR, LINTEL)),
        box("door frames", "right jamb", (HALF - 0.02, -DOOR, 0), (inner + 0.02, 0.05 - DOOR, LINTEL)),
        *(box(part, name, low, high) for name, (part, low, high) in FURNITURE.items()),
        cylinder("desks", "desk leg", (4.45, 0.2, 0), (4.45, 0.2, 0.71), 0.05),
        cylinder("cabinets", "bin", (4.8, -1.35, 0), (4.8, -1.35, 0.5), 0.35),
        *chair("chair", 4.1, 0.75, 0.4),
    ]


def _faces(offices: int) -> list[Face]:
    """Return the corridor's walls, in plan coordinates."""
    end = offices // 2 * BAY
    return [
        rectangle("left wall", (0, HALF, 0), (end, HALF, HEIGHT), towards=(0, -1, 0)),
        rectangle("right wall", (0, -HALF, 0), (end, -HALF, HEIGHT), towards=(0, 1, 0)),
        rectangle("start wall", (0, -HALF, 0), (0, HALF, HEIGHT), towards=(1, 0, 0)),
        rectangle("end wall", (end, -HALF, 0), (end, HALF, HEIGHT), towards=(-1, 0, 0)),
    ]
