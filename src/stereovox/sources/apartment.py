# SPDX-License-Identifier: Apache-2.0
"""`sim:apartment`: five rooms round a hall, with straight walls and right angles (Chien 2020, 4.4.2.1).

Plan coordinates in metres: floor at 0, x east, y north. `SHIFT` moves all by odd millimetres, so that no wall lies
exactly on a cell's face for any round cell size.
"""

from __future__ import annotations

import numpy as np

from stereovox.geometry import transform_points
from stereovox.sources.apartment_walk import HZ, walk
from stereovox.sources.furniture import furniture
from stereovox.sources.scene import Point, Scene, Solid, box
from stereovox.sources.stage import Face, Stage, moved, rectangle, within

SHIFT = np.array([0.0137, 0.0219, -0.0123])
"""World coordinates of the plan's origin in metres."""
HEIGHT, OUTSIDE = 2.5, 0.25
"""Of the rooms; thickness of the outer walls. Inner walls are as thick as the gaps between the rooms: 0.12 m."""
ROOMS = {
    "living room": (0.0, 0.0, 4.6, 3.2),
    "kitchen": (4.72, 0.0, 8.4, 3.2),
    "hall": (0.0, 3.32, 8.4, 4.52),
    "bedroom": (0.0, 4.64, 3.6, 7.8),
    "bath": (3.72, 4.64, 5.6, 7.8),
    "study": (5.72, 4.64, 8.4, 7.8),
}
"""Inner size: x from, y from, x to, y to."""
SOUTH, NORTH = (3.2, 3.32), (4.52, 4.64)
"""The hall's two walls: y from, y to."""
DOORS = {
    "living room door": (3.3, *SOUTH),
    "kitchen door": (5.0, *SOUTH),
    "bedroom door": (2.4, *NORTH),
    "bath door": (4.2, *NORTH),
    "study door": (5.95, *NORTH),
}
"""Door openings in the hall's walls: x from, y from, y to."""
DOOR, LINTEL, JAMB = 0.86, 2.04, 0.05
"""Width and height of the openings; width of the frames in them, which stand out by 2 cm on either side."""
PASSAGE = (0.9, 1.9)
"""Opening between living room and kitchen: y from, y to."""


def stage(*, speed: float = 0.8) -> Stage:
    """Return the furnished apartment and a scan of all rooms at walking `speed` (m/s), 15 images a second.

    The way begins and ends at the same place, so that a tracker that drifts sees it again. The camera's sway is that of
    a hand. World: z up, walls along x and y. Parts: `walls`, `floor`, `ceiling`, `door frames` and the furniture.
    faces: the four sides of every room, named `kitchen west` and the like; doors are holes in them, and furniture
    stands before them. Raises SourceError for values out of range.
    """
    within("speed", speed, 0.1, 5)
    T_world_plan = np.eye(4)
    T_world_plan[:3, 3] = SHIFT
    path, seconds = walk(speed)
    faces = tuple(Face(face.name, transform_points(T_world_plan, face.corners)) for face in _sides())

    def build() -> Scene:
        return moved(Scene([*_shell(), *_walls(), *_frames(), *furniture()]), T_world_plan)

    return Stage(build, lambda share: T_world_plan @ path(share), round(seconds * HZ) + 1, HZ, faces=faces)


def _sides() -> list[Face]:
    """Return the walls as the rooms show them, in plan coordinates."""
    found = []
    for room, (x0, y0, x1, y1) in ROOMS.items():
        found += [
            rectangle(f"{room} west", (x0, y0, 0), (x0, y1, HEIGHT), towards=(1, 0, 0)),
            rectangle(f"{room} east", (x1, y0, 0), (x1, y1, HEIGHT), towards=(-1, 0, 0)),
            rectangle(f"{room} south", (x0, y0, 0), (x1, y0, HEIGHT), towards=(0, 1, 0)),
            rectangle(f"{room} north", (x0, y1, 0), (x1, y1, HEIGHT), towards=(0, -1, 0)),
        ]
    return found


def _shell() -> list[Solid]:
    x1, y1, t = 8.4, 7.8, OUTSIDE
    return [
        box("floor", "floor", (-t, -t, -t), (x1 + t, y1 + t, 0)),
        box("ceiling", "ceiling", (-t, -t, HEIGHT), (x1 + t, y1 + t, HEIGHT + t)),
        box("walls", "outer wall, west", (-t, -t, 0), (0, y1 + t, HEIGHT)),
        box("walls", "outer wall, east", (x1, -t, 0), (x1 + t, y1 + t, HEIGHT)),
        box("walls", "outer wall, south", (0, -t, 0), (x1, 0, HEIGHT)),
        box("walls", "outer wall, north", (0, y1, 0), (x1, y1 + t, HEIGHT)),
    ]


def _walls() -> list[Solid]:
    south = [x for x, y, _ in DOORS.values() if y == SOUTH[0]]
    north = [x for x, y, _ in DOORS.values() if y == NORTH[0]]
    (p0, p1), top = PASSAGE, HEIGHT
    return [
        *_wall_with_doors("hall's south wall", SOUTH, south),
        *_wall_with_doors("hall's north wall", NORTH, north),
        box("walls", "kitchen wall, south of the passage", (4.6, 0, 0), (4.72, p0, top)),
        box("walls", "kitchen wall, north of the passage", (4.6, p1, 0), (4.72, SOUTH[0], top)),
        box("walls", "kitchen wall, above the passage", (4.6, p0, LINTEL), (4.72, p1, top)),
        box("walls", "bath's west wall", (3.6, NORTH[1], 0), (3.72, 7.8, top)),
        box("walls", "bath's east wall", (5.6, NORTH[1], 0), (5.72, 7.8, top)),
    ]


def _wall_with_doors(name: str, across: tuple[float, float], doors: list[float]) -> list[Solid]:
    """Return a wall from the west to the east with openings that begin at `doors`."""
    y0, y1 = across
    starts, ends = [0.0, *(x + DOOR for x in doors)], [*doors, 8.4]
    spans = zip(starts, ends, strict=True)
    return [
        *(box("walls", f"{name}, part {n}", (a, y0, 0), (b, y1, HEIGHT)) for n, (a, b) in enumerate(spans, 1)),
        *(
            box("walls", f"{name}, above door {n}", (x, y0, LINTEL), (x + DOOR, y1, HEIGHT))
            for n, x in enumerate(doors, 1)
        ),
    ]


def _frames() -> list[Solid]:
    solids = [solid for name, (x, y0, y1) in DOORS.items() for solid in _frame(name, (x, y0), (x + DOOR, y1), 1)]
    return [*solids, *_frame("passage", (4.6, PASSAGE[0]), (4.72, PASSAGE[1]), 0)]


def _frame(name: str, low: tuple[float, float], high: tuple[float, float], across: int) -> list[Solid]:
    """Return the frame in an opening of a wall that is thin along the axis `across`."""

    def part(label: str, start: float, end: float, bottom: float, top: float) -> Solid:
        a: Point = (start, low[1] - 0.02, bottom) if across else (low[0] - 0.02, start, bottom)
        b: Point = (end, high[1] + 0.02, top) if across else (high[0] + 0.02, end, top)
        return box("door frames", f"{name}, {label}", a, b)

    start, end = low[1 - across], high[1 - across]
    return [
        part("first jamb", start, start + JAMB, 0, LINTEL),
        part("second jamb", end - JAMB, end, 0, LINTEL),
        part("head", start + JAMB, end - JAMB, LINTEL - JAMB, LINTEL),
    ]
