# SPDX-License-Identifier: Apache-2.0
"""The demo's building: a furnished room with thin poles, a table and a doorway, and a long corridor behind it.

Plan coordinates in metres: floor at 0, x towards the corridor, y left. `SHIFT` offsets the whole building by odd
millimetres, so that no wall is exactly on a cell's face for any round cell size.
"""

from __future__ import annotations

import numpy as np

from stereovox.geometry.se3 import Transform, look_at
from stereovox.simulate.scene import Point, Scene, Solid, box, cylinder
from stereovox.simulate.stage import Stage

SHIFT = np.array([0.0137, 0.0219, -0.0123])
"""World coordinates of the plan's origin in metres."""
ROOM, CORRIDOR = (6.2, 2.6, 2.6), (6.4, 18.6, -0.25, 1.45, 2.4)
"""Inner size of the room (length, half width, height) and of the corridor (x from, x to, y from, y to, height)."""
DOOR = (0.15, 1.05, 2.05)
"""The doorway: y from, y to, height."""
WALL = 0.25
FRAMES = 240
WAYPOINTS = np.array([
    # eye x, y, z         looks at x, y, z
    [4.90, -1.55, 1.30, 2.20, -2.40, 0.50],
    [4.30, -1.30, 1.30, 0.60, -2.00, 0.55],
    [3.50, -0.95, 1.32, 0.40, -0.60, 0.60],
    [2.70, -0.75, 1.34, 0.20, 0.80, 0.80],
    [1.90, -0.75, 1.34, 0.60, 2.00, 0.95],
    [1.30, -0.65, 1.34, 1.90, 2.60, 0.95],
    [1.10, -0.35, 1.34, 3.00, 2.20, 0.65],
    [1.30, -0.55, 1.34, 3.90, 1.00, 0.55],
    [1.90, -0.85, 1.34, 4.60, -1.20, 0.50],
    [2.60, -0.95, 1.36, 5.30, -1.90, 0.70],
    [3.30, -0.75, 1.40, 6.00, -0.20, 0.85],
    [3.90, -0.40, 1.42, 5.10, 2.00, 0.95],
    [4.50, 0.10, 1.40, 6.20, 2.00, 1.10],
    [5.20, 0.55, 1.34, 8.00, 0.30, 1.20],
    [5.90, 0.60, 1.30, 9.00, 0.60, 1.20],
    [6.90, 0.62, 1.30, 10.00, 0.20, 1.10],
    [8.00, 0.75, 1.32, 10.80, -0.10, 1.05],
    [9.20, 0.85, 1.34, 11.90, 0.60, 1.15],
    [10.40, 0.85, 1.34, 13.00, 1.20, 1.20],
    [11.60, 0.70, 1.32, 14.30, 0.60, 1.50],
    [12.90, 0.55, 1.30, 15.80, 0.20, 1.30],
    [14.30, 0.50, 1.28, 17.20, 0.80, 0.90],
    [15.60, 0.55, 1.28, 18.40, 0.60, 1.00],
])  # fmt: skip
"""Plan coordinates in metres, at equal steps of time; the path runs smoothly through them."""


def stage() -> Stage:
    """Return the demo's stage: room and corridor, 8 s at 30 Hz."""
    from scipy.interpolate import CubicSpline

    way = CubicSpline(np.linspace(0, 1, len(WAYPOINTS)), WAYPOINTS + np.tile(SHIFT, 2))

    def path(share: float) -> Transform:
        point = way(share)
        return look_at(point[:3], point[3:])

    return Stage(room, path, FRAMES)


def room() -> Scene:
    """Return the furnished room and its corridor."""
    house = (_room_shell, _corridor_shell, _door, _window)
    furniture = (_poles, _table, _chairs, _sofa, _shelf, _lamp, _corridor_furniture)
    solids = [solid for build in (*house, *furniture) for solid in build()]
    return Scene([Solid(solid.part, solid.name, solid.triangles + SHIFT) for solid in solids])


def _room_shell() -> list[Solid]:
    length, half, height = ROOM
    y0, y1, top = DOOR
    return [
        box("floor", "room floor", (-WALL, -half - WALL, -WALL), (CORRIDOR[0], half + WALL, 0)),
        box("ceiling", "room ceiling", (-WALL, -half - WALL, height), (CORRIDOR[0], half + WALL, height + WALL)),
        box("walls", "back wall", (-WALL, -half, 0), (0, half, height)),
        box("walls", "right wall", (-WALL, -half - WALL, 0), (CORRIDOR[0], -half, height)),
        box("walls", "left wall, back", (-WALL, half, 0), (1.4, half + WALL, height)),
        box("walls", "left wall, front", (3.0, half, 0), (CORRIDOR[0], half + WALL, height)),
        box("walls", "left wall, below the window", (1.4, half, 0), (3.0, half + WALL, 0.9)),
        box("walls", "left wall, above the window", (1.4, half, 2.1), (3.0, half + WALL, height)),
        box("walls", "front wall, right of the door", (length, -half, 0), (CORRIDOR[0], y0, height)),
        box("walls", "front wall, left of the door", (length, y1, 0), (CORRIDOR[0], half, height)),
        box("walls", "front wall, above the door", (length, y0, top), (CORRIDOR[0], y1, height)),
    ]


def _corridor_shell() -> list[Solid]:
    x0, x1, y0, y1, height = CORRIDOR
    return [
        box("floor", "corridor floor", (x0, y0 - WALL, -WALL), (x1 + WALL, y1 + WALL, 0)),
        box("ceiling", "corridor ceiling", (x0, y0 - WALL, height), (x1 + WALL, y1 + WALL, height + WALL)),
        box("walls", "corridor right wall", (x0, y0 - WALL, 0), (x1 + WALL, y0, height)),
        box("walls", "corridor left wall", (x0, y1, 0), (x1 + WALL, y1 + WALL, height)),
        box("walls", "corridor end", (x1, y0, 0), (x1 + WALL, y1, height)),
    ]


def _door() -> list[Solid]:
    x0, x1 = ROOM[0] - 0.06, CORRIDOR[0] + 0.06
    y0, y1, top = DOOR
    return [
        box("door_frame", "door frame, right", (x0, y0 - 0.05, 0), (x1, y0 + 0.05, top - 0.05)),
        box("door_frame", "door frame, left", (x0, y1 - 0.05, 0), (x1, y1 + 0.05, top - 0.05)),
        box("door_frame", "door frame, top", (x0, y0 - 0.05, top - 0.05), (x1, y1 + 0.05, top + 0.05)),
        box("door", "door leaf", (5.28, 1.11, 0.01), (6.12, 1.15, 1.98), turn=-0.14, about=(6.12, 1.13)),
    ]


def _window() -> list[Solid]:
    y0, y1 = ROOM[1] + 0.08, ROOM[1] + 0.14
    return [
        box("window_frame", "window frame, bottom", (1.4, y0, 0.9), (3.0, y1, 0.96)),
        box("window_frame", "window frame, top", (1.4, y0, 2.04), (3.0, y1, 2.1)),
        box("window_frame", "window frame, back", (1.4, y0, 0.96), (1.46, y1, 2.04)),
        box("window_frame", "window frame, front", (2.94, y0, 0.96), (3.0, y1, 2.04)),
        box("window_frame", "window frame, middle", (2.18, y0, 0.96), (2.22, y1, 2.04)),
    ]


def _poles() -> list[Solid]:
    height, corridor = ROOM[2], CORRIDOR[4]
    return [
        cylinder("poles", "pole 2 cm", (1.85, 0.35, 0), (1.85, 0.35, 2.0), 0.02),
        cylinder("poles", "pole 2.5 cm", (4.55, 1.65, 0), (4.55, 1.65, height), 0.025),
        cylinder("poles", "pole 3 cm", (3.7, -1.75, 0), (3.7, -1.75, height), 0.03),
        cylinder("poles", "pole 4 cm", (5.3, -0.55, 0), (5.3, -0.55, height), 0.04),
        cylinder("poles", "corridor pole 3 cm", (11.2, 0.12, 0), (11.2, 0.12, corridor), 0.03),
        cylinder("poles", "corridor bar 2.5 cm", (14.3, -0.25, 1.95), (14.3, 1.45, 1.95), 0.025),
    ]


def _table() -> list[Solid]:
    x0, x1, y0, y1, low, top, rim = 2.3, 3.9, 0.75, 1.6, 0.71, 0.75, 0.05
    feet = [(x, y) for x in (x0 + 0.06, x1 - 0.11) for y in (y0 + 0.06, y1 - 0.11)]
    legs = [
        box("table_legs", f"table leg {n}", (x, y, 0), (x + 0.05, y + 0.05, low)) for n, (x, y) in enumerate(feet, 1)
    ]
    return [
        box("table", "table top", (x0 + rim, y0 + rim, low), (x1 - rim, y1 - rim, top)),
        box("table_edge", "table edge, back", (x0, y0, low), (x0 + rim, y1, top)),
        box("table_edge", "table edge, front", (x1 - rim, y0, low), (x1, y1, top)),
        box("table_edge", "table edge, right", (x0 + rim, y0, low), (x1 - rim, y0 + rim, top)),
        box("table_edge", "table edge, left", (x0 + rim, y1 - rim, low), (x1 - rim, y1, top)),
        *legs,
        box("things", "laptop", (2.75, 1.0, top), (3.1, 1.24, top + 0.02)),
        box("things", "laptop lid", (2.75, 1.22, top + 0.02), (3.1, 1.24, top + 0.24)),
        cylinder("things", "jug", (3.5, 1.1, top), (3.5, 1.1, top + 0.22), 0.12),
    ]


def _chairs() -> list[Solid]:
    places = [(2.75, 0.5, 1.45), (3.5, 0.45, 1.75), (2.7, 1.95, -1.5), (4.3, 1.15, 3.0)]
    return [solid for n, (x, y, turn) in enumerate(places, 1) for solid in _chair(f"chair {n}", x, y, turn)]


def _chair(name: str, x: float, y: float, turn: float) -> list[Solid]:
    """Return a chair whose sitter faces along +x turned by `turn`."""

    def part(label: str, low: Point, high: Point) -> Solid:
        moved = [(a + x, b + y, c) for a, b, c in (low, high)]
        return box("chairs", f"{name}, {label}", moved[0], moved[1], turn, about=(x, y))

    legs = [(a, b) for a in (-0.2, 0.165) for b in (-0.2, 0.165)]
    return [
        part("seat", (-0.2, -0.2, 0.43), (0.2, 0.2, 0.47)),
        part("back", (-0.2, -0.2, 0.47), (-0.165, 0.2, 0.92)),
        *(part(f"leg {n}", (a, b, 0), (a + 0.035, b + 0.035, 0.43)) for n, (a, b) in enumerate(legs, 1)),
    ]


def _sofa() -> list[Solid]:
    wall = -ROOM[1]
    return [
        box("sofa", "sofa seat", (1.0, wall + 0.22, 0.1), (2.9, wall + 0.85, 0.42)),
        box("sofa", "sofa back", (1.0, wall + 0.02, 0.1), (2.9, wall + 0.22, 0.82)),
        box("sofa", "sofa arm, back", (0.82, wall + 0.02, 0.1), (1.0, wall + 0.85, 0.6)),
        box("sofa", "sofa arm, front", (2.9, wall + 0.02, 0.1), (3.08, wall + 0.85, 0.6)),
        box("things", "cabinet", (4.4, wall + 0.02, 0), (5.7, wall + 0.47, 0.85)),
        box("things", "box on the cabinet", (4.75, wall + 0.1, 0.85), (5.15, wall + 0.38, 1.1), turn=0.4),
    ]


def _shelf() -> list[Solid]:
    x0, x1, y0, y1, top = 4.6, 5.6, ROOM[1] - 0.34, ROOM[1] - 0.02, 1.95
    boards = [0.08, 0.45, 0.82, 1.19, 1.56, top - 0.03]
    books = [(4.66, 0.34, 0.11), (5.1, 0.42, 0.48), (4.68, 0.5, 0.85), (5.25, 0.28, 1.22), (4.7, 0.3, 1.59)]
    return [
        box("shelf", "shelf side, back", (x0, y0, 0), (x0 + 0.03, y1, top)),
        box("shelf", "shelf side, front", (x1 - 0.03, y0, 0), (x1, y1, top)),
        box("shelf", "shelf rear", (x0 + 0.03, y1 - 0.02, 0), (x1 - 0.03, y1, top)),
        *(
            box("shelf", f"shelf board {n}", (x0 + 0.03, y0, z), (x1 - 0.03, y1 - 0.02, z + 0.03))
            for n, z in enumerate(boards, 1)
        ),
        *(
            box("things", f"books {n}", (x, y0 + 0.06, z), (x + width, y1 - 0.02, z + 0.24))
            for n, (x, width, z) in enumerate(books, 1)
        ),
    ]


def _lamp() -> list[Solid]:
    return [
        cylinder("lamp", "lamp cable", (3.1, 1.2, 1.85), (3.1, 1.2, ROOM[2]), 0.012),
        cylinder("lamp", "lamp shade", (3.1, 1.2, 1.62), (3.1, 1.2, 1.85), 0.4, sections=32),
    ]


def _corridor_furniture() -> list[Solid]:
    _, x1, y0, y1, _ = CORRIDOR
    frames = [("left", x, y1 - 0.04, y1) for x in (9.0, 13.0)] + [("right", x, y0, y0 + 0.04) for x in (10.6, 15.6)]
    return [
        *(solid for side, x, low, high in frames for solid in _side_door(f"{side} door at {x:g} m", x, low, high)),
        box("things", "bench seat", (7.6, y0 + 0.02, 0.42), (9.0, y0 + 0.36, 0.46)),
        box("things", "bench leg, back", (7.7, y0 + 0.06, 0), (7.76, y0 + 0.32, 0.42)),
        box("things", "bench leg, front", (8.84, y0 + 0.06, 0), (8.9, y0 + 0.32, 0.42)),
        cylinder("things", "extinguisher", (11.9, y1 - 0.12, 0.5), (11.9, y1 - 0.12, 1.05), 0.16),
        cylinder("things", "pipe", (6.42, 1.28, 2.2), (x1, 1.28, 2.2), 0.08),
        box("things", "parcel", (16.6, 0.95, 0), (17.1, 1.35, 0.4), turn=0.3),
        box("things", "parcel on parcel", (16.7, 1.0, 0.4), (17.0, 1.28, 0.65), turn=0.1),
    ]


def _side_door(name: str, x: float, low: float, high: float) -> list[Solid]:
    return [
        box("corridor_doors", f"{name}, back", (x, low, 0), (x + 0.08, high, 2.0)),
        box("corridor_doors", f"{name}, front", (x + 0.98, low, 0), (x + 1.06, high, 2.0)),
        box("corridor_doors", f"{name}, top", (x, low, 2.0), (x + 1.06, high, 2.08)),
    ]
