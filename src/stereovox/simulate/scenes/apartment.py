# SPDX-License-Identifier: Apache-2.0
"""`sim:apartment`: five rooms round a hall, with straight walls and right angles (Chien 2020, 4.4.2.1).

Plan coordinates in metres: floor at 0, x east, y north. `SHIFT` offsets everything by odd millimetres, so that no wall
is exactly on a cell's face for any round cell size.
"""

from __future__ import annotations

import numpy as np

from stereovox.geometry.se3 import transform_points
from stereovox.simulate.flight import walk
from stereovox.simulate.scene import Point, Scene, Solid, box, cylinder
from stereovox.simulate.stage import SHIFT, Face, Stage, moved, rectangle, within

HZ = 15.0
"""Images a second: the rate at which Chien 2020 wanted to map."""
WAYPOINTS = np.array([
    # x, y, yaw in degrees (0: east, 90: north; the camera never jumps from 180 to -180)
    [0.90, 1.60, 0],  # living room, once round clockwise
    [1.90, 1.60, -50],
    [2.30, 1.50, -140],
    [2.20, 1.60, -230],
    [2.60, 1.55, -320],
    [3.60, 1.42, -360],
    [4.66, 1.40, -360],  # passage
    [5.60, 1.50, -330],  # kitchen, once round anticlockwise
    [6.30, 1.60, -270],
    [6.40, 1.70, -180],
    [6.30, 1.60, -90],
    [6.10, 1.80, 0],
    [5.45, 2.30, 80],
    [5.43, 3.26, 90],  # door
    [5.50, 3.90, 60],
    [6.00, 3.92, 10],  # hall, east end
    [6.38, 4.10, 80],
    [6.38, 4.58, 90],  # door
    [6.60, 5.60, 60],  # study, once round clockwise
    [6.75, 5.70, -30],
    [6.70, 5.60, -120],
    [6.60, 5.50, -210],
    [6.50, 5.40, -270],
    [6.40, 5.30, -270],
    [6.38, 4.58, -270],  # backwards through the door
    [6.20, 3.95, -230],
    [5.40, 3.92, -180],
    [4.70, 4.00, -250],
    [4.63, 4.58, -270],  # door
    [4.60, 5.40, -270],  # bath, once round anticlockwise
    [4.60, 5.50, -180],
    [4.62, 5.50, -90],
    [4.60, 5.45, 0],
    [4.63, 5.30, 90],
    [4.63, 4.58, 90],  # backwards through the door
    [4.50, 3.95, 130],
    [3.80, 3.92, 180],
    [2.90, 4.00, 110],
    [2.83, 4.58, 90],  # door
    [2.70, 5.30, 100],  # bedroom, once round anticlockwise
    [2.40, 5.50, 190],
    [2.40, 5.45, 280],
    [2.45, 5.40, 370],
    [2.70, 5.30, 450],
    [2.83, 4.58, 450],  # backwards through the door
    [2.60, 3.95, 500],
    [1.70, 3.92, 540],  # hall, west end
    [1.50, 3.92, 630],
    [2.20, 3.92, 715],
    [3.50, 3.90, 700],
    [3.73, 3.80, 640],
    [3.73, 3.26, 630],  # door
    [3.60, 2.30, 600],
    [2.70, 1.60, 550],  # living room again: it sees what it has seen
    [1.60, 1.60, 630],
    [0.90, 1.60, 720],
])  # fmt: skip
BOXES: dict[str, dict[str, tuple[Point, Point]]] = {
    "sofa": {
        "seat": ((1.2, 0.25, 0.1), (3.1, 0.9, 0.42)),
        "back": ((1.2, 0.02, 0.1), (3.1, 0.25, 0.84)),
        "arm, west": ((1.02, 0.02, 0.1), (1.2, 0.9, 0.6)),
        "arm, east": ((3.1, 0.02, 0.1), (3.28, 0.9, 0.6)),
    },
    "shelf": {
        "side, west": ((0.5, 2.88, 0), (0.53, 3.18, 1.9)),
        "side, east": ((1.67, 2.88, 0), (1.7, 3.18, 1.9)),
        **{f"board {n}": ((0.53, 2.88, z), (1.67, 3.18, z + 0.03)) for n, z in enumerate((0.1, 0.55, 1.0, 1.45, 1.87))},
        "books, low": ((0.6, 2.95, 0.58), (1.2, 3.15, 0.83)),
        "books, high": ((0.9, 2.95, 1.03), (1.6, 3.15, 1.26)),
    },
    "low table": {
        "top": ((1.7, 2.15, 0.38), (2.6, 2.65, 0.42)),
        **{
            f"leg {n}": ((x, y, 0), (x + 0.05, y + 0.05, 0.38))
            for n, (x, y) in enumerate(((1.72, 2.17), (2.53, 2.17), (1.72, 2.58), (2.53, 2.58)), 1)
        },
    },
    "kitchen": {
        "counter": ((5.3, 0.02, 0), (7.7, 0.62, 0.9)),
        "wall cupboard": ((5.3, 0.02, 1.45), (7.0, 0.37, 2.1)),
        "fridge": ((7.72, 0.02, 0), (8.36, 0.66, 1.85)),
        "table": ((7.35, 1.75, 0.71), (8.15, 2.65, 0.75)),
    },
    "bed": {
        "mattress": ((0.1, 6.0, 0.2), (2.1, 7.6, 0.55)),
        "head": ((0.02, 5.95, 0), (0.1, 7.65, 1.0)),
        "wardrobe": ((2.95, 6.0, 0), (3.57, 7.75, 2.1)),
    },
    "bath": {
        "tub": ((3.76, 7.0, 0), (5.56, 7.76, 0.55)),
        "basin": ((3.74, 5.6, 0.75), (4.16, 6.2, 0.88)),
        "washing machine": ((4.98, 6.1, 0), (5.57, 6.7, 0.85)),
    },
    "desk": {
        "top": ((7.6, 5.4, 0.71), (8.35, 7.1, 0.75)),
        "screen": ((8.1, 5.9, 0.85), (8.14, 6.5, 1.2)),
        "drawers": ((7.7, 6.6, 0), (8.3, 7.05, 0.7)),
        "bookcase": ((5.76, 6.6, 0), (6.06, 7.7, 1.8)),
    },
    "hall things": {
        "shoe rack": ((7.4, 3.36, 0), (8.3, 3.62, 0.5)),
        "chest": ((0.06, 3.36, 0), (0.5, 4.1, 0.8)),
    },
}
"""Lowest and highest corner by part and name."""
HEIGHT, OUTSIDE = 2.5, 0.25
"""Height of the rooms; thickness of the outer walls. Inner walls fill the gaps between the rooms: 0.12 m."""
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
"""Width and height of the openings; width of the frames in them, which protrude by 2 cm on either side."""
PASSAGE = (0.9, 1.9)
"""Opening between living room and kitchen: y from, y to."""


def stage(*, speed: float = 0.8) -> Stage:
    """Return the furnished apartment and a scan of all rooms at walking `speed` (m/s), 15 images a second.

    The path begins and ends at the same place, so that a drifting tracker revisits it. The camera sways as in a hand.
    World: z up, walls along x and y. Parts: `walls`, `floor`, `ceiling`, `door frames` and the furniture. faces: the
    four sides of every room, named `kitchen west` and the like; doors are holes in them, and furniture stands in front
    of them. Raises SourceError for values out of range.
    """
    within("speed", speed, 0.1, 5)
    T_world_plan = np.eye(4)
    T_world_plan[:3, 3] = SHIFT
    path, seconds = walk(WAYPOINTS, speed)
    faces = tuple(Face(face.name, transform_points(T_world_plan, face.corners)) for face in _sides())

    def build() -> Scene:
        return moved(Scene([*_shell(), *_walls(), *_frames(), *furniture()]), T_world_plan)

    return Stage(build, lambda share: T_world_plan @ path(share), round(seconds * HZ) + 1, HZ, faces=faces)


def furniture() -> list[Solid]:
    """Return all furniture: axis-aligned boxes, round legs, and chairs turned by odd angles."""
    boxes = [
        box(part, f"{part}: {name}", *corners) for part, things in BOXES.items() for name, corners in things.items()
    ]
    return [
        *boxes,
        cylinder("kitchen", "kitchen: table foot", (7.75, 2.2, 0), (7.75, 2.2, 0.71), 0.08),
        cylinder("lamp", "lamp: stand", (4.25, 0.35, 0), (4.25, 0.35, 1.5), 0.03),
        cylinder("lamp", "lamp: shade", (4.25, 0.35, 1.5), (4.25, 0.35, 1.75), 0.3),
        cylinder("desk", "desk: leg, south", (7.68, 5.48, 0), (7.68, 5.48, 0.71), 0.05),
        *chair("kitchen chair", 7.1, 2.3, 0.35),
        *chair("desk chair", 7.35, 6.15, -0.5),
    ]


def chair(name: str, x: float, y: float, turn: float) -> list[Solid]:
    """Return a chair whose sitter faces along +x turned by `turn` radians."""

    def part(label: str, low: Point, high: Point) -> Solid:
        (x0, y0, z0), (x1, y1, z1) = low, high
        return box("chairs", f"{name}: {label}", (x + x0, y + y0, z0), (x + x1, y + y1, z1), turn, about=(x, y))

    return [
        part("seat", (-0.2, -0.2, 0.43), (0.2, 0.2, 0.47)),
        part("back", (-0.2, -0.2, 0.47), (-0.165, 0.2, 0.9)),
        *(
            part(f"leg {n}", (a, b, 0), (a + 0.035, b + 0.035, 0.43))
            for n, (a, b) in enumerate(((-0.2, -0.2), (0.165, -0.2), (-0.2, 0.165), (0.165, 0.165)), 1)
        ),
    ]


def _sides() -> list[Face]:
    """Return the visible walls of the rooms, in plan coordinates."""
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
