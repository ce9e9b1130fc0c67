# SPDX-License-Identifier: Apache-2.0
"""`sim:floor?plan=corridors`: corridors in a loop, after the 5th floor of IST 2019 (IV-B)."""

from __future__ import annotations

from stereovox.sources.floor_drive import Stop, zigzag
from stereovox.sources.floor_layout import SHIFT, Layout
from stereovox.sources.floor_plan import CEILING, FloorPlan, Rectangle, Thing, block, post
from stereovox.sources.floor_things import chair, table

OFFICES = {"a": 7.35, "b": 11.65, "c": 15.95}
"""x at which the offices of both rows begin; they are 4.1 m wide, and all alike."""
WIDTH = 4.1
SOUTH, NORTH = (2.15, 4.70), (4.85, 7.45)
"""y of the two rows of offices: doors of the first lead to the south corridor, those of the second to the north one."""
CORRIDORS: tuple[Rectangle, ...] = (
    (0.0, 0.0, 22.0, 2.0),  # south
    (20.2, 0.0, 22.0, 9.2),  # east
    (5.6, 7.6, 22.0, 9.2),  # north
    (5.6, 0.0, 7.2, 9.2),  # west
)
CORNERS: tuple[Rectangle, ...] = (
    (1.2, 2.2, 2.6, 7.4),  # the stairs' corridor and its door
    (1.45, 2.0, 2.35, 2.2),
    (9.0, -2.9, 12.4, -0.15),  # toilets and their door
    (10.3, -0.15, 11.2, 0.0),
    (16.2, -1.2, 18.8, 0.0),  # niche before two elevators
    (16.5, -1.28, 17.35, -1.2),
    (17.65, -1.28, 18.5, -1.2),
    (13.4, 9.2, 14.8, 9.75),  # niche of a copier
)
"""Zones that are like no other (IST 2019, III-D)."""
OPEN = ((10.25, SOUTH), (16.25, SOUTH), (11.95, NORTH))
"""Doors of 0.9 m that stand open: x from, and the row of offices."""
SHUT = ((14.55, SOUTH), (7.65, NORTH), (16.25, NORTH))
BEHIND: Rectangle = (1.0, 2.08, 2.8, 7.6)
"""The stairs' corridor, from the middle of its door on."""


def layout(shut: bool) -> Layout:
    """Return the floor and a drive of about 110 m. shut: the stairs' door is closed, and the robot drives past it."""
    rooms = [(x, row[0], x + WIDTH, row[1]) for row in (SOUTH, NORTH) for x in OFFICES.values()]
    doors = [_door(x, row, 0.15) for x, row in OPEN] + [_door(x, row, 0.1) for x, row in SHUT]
    things = [*_corridor_things(), *_corner_things(), *_office_things()]
    if shut:
        things.append(block("doors", "door to the stairs", (1.45, 2.08, 2.35, 2.12), (0.0, CEILING)))
    plan = FloorPlan([*CORRIDORS, *CORNERS, *rooms, *doors], things)
    return Layout(plan, _stops(shut), BEHIND).moved(*SHIFT)


def _door(x: float, row: tuple[float, float], deep: float) -> Rectangle:
    """Return the opening of a door, or the recess before a shut one."""
    return (x, 2.0, x + 0.9, 2.0 + deep) if row == SOUTH else (x, 7.6 - deep, x + 0.9, 7.6)


def _corridor_things() -> list[Thing]:
    return [
        block("corridor", "bin", (3.0, 0.03, 3.3, 0.33), (0.0, 0.6)),
        block("corridor", "cabinet", (13.2, 1.66, 14.2, 1.98), (0.0, 1.2)),
        block("corridor", "bench", (21.6, 3.0, 21.97, 4.6), (0.42, 0.46)),
        block("corridor", "bench, leg 1", (21.65, 3.1, 21.92, 3.16), (0.0, 0.42)),
        block("corridor", "bench, leg 2", (21.65, 4.44, 21.92, 4.5), (0.0, 0.42)),
        block("corridor", "extinguisher", (18.2, 9.03, 18.4, 9.18), (0.0, 0.8)),
        block("corridor", "pillar", (5.62, 4.0, 5.9, 4.4), (0.0, CEILING)),
        post("corridor", "plant", (21.65, 0.35), 0.4, 1.0),
    ]


def _corner_things() -> list[Thing]:
    steps = [
        block("stairs", f"step {n}", (1.22, 6.2 + 0.3 * n, 2.58, 7.38), (0.17 * n, 0.17 * (n + 1))) for n in range(4)
    ]
    panels = [
        block("toilets", f"panel {n}", (x, -2.88, x + 0.04, -1.7), (0.15, 2.0)) for n, x in enumerate((10.1, 11.25))
    ]
    return [
        *steps,
        *panels,
        block("toilets", "basin", (9.02, -1.4, 9.45, -0.5), (0.75, 0.9)),
        block("corridor", "copier", (13.5, 9.25, 14.3, 9.72), (0.0, 1.1)),
    ]


def _office_things() -> list[Thing]:
    """Return what stands in the offices that are open: a table at the back, a chair, a cabinet away from the door."""
    things = []
    for name, x, row, cabinet in (("a", 7.35, SOUTH, 0.02), ("c", 15.95, SOUTH, 3.65), ("b", 11.65, NORTH, 3.65)):
        back, towards = (row[1] - 0.45, 1) if row == SOUTH else (row[0] + 0.45, -1)
        front = row[0] + 0.15 if row == SOUTH else row[1] - 1.35
        things += table(f"office {name}: table", x + 2.05, back, (1.4, 0.7))
        things += chair(f"office {name}: chair", x + 2.05, back - towards * 0.5, 90.0 * towards + 12)
        things.append(
            block(
                "cabinets", f"office {name}: cabinet", (x + cabinet, front, x + cabinet + 0.43, front + 1.2), (0.0, 1.2)
            )
        )
    return things


def _stops(shut: bool) -> list[Stop]:
    stairs = [] if shut else [Stop(1.9, 2.8), Stop(1.9, 4.9, 180), Stop(1.9, 2.8), Stop(1.9, 1.0)]
    return [
        Stop(0.9, 1.0),
        Stop(1.9, 1.0, 360),
        *stairs,
        *zigzag((2.4, 1.0), (10.0, 1.0), 0.4),
        *(Stop(10.75, 1.0), Stop(10.75, -0.95, 360), Stop(10.75, 1.0)),
        *(Stop(10.7, 2.85), Stop(9.2, 2.9, -360), Stop(10.7, 2.85), Stop(10.7, 1.0)),
        *zigzag((11.2, 1.0), (16.2, 1.0), -0.35),
        *(Stop(16.7, 1.0), Stop(16.7, 2.85), Stop(18.2, 2.9, 360), Stop(16.7, 2.85), Stop(16.7, 1.0)),
        Stop(17.5, 0.7, -360),
        *zigzag((17.9, 0.9), (21.0, 1.1), 0.3),
        Stop(21.0, 1.2, 270),
        *zigzag((21.0, 1.8), (21.0, 8.2), 0.25),
        Stop(21.0, 8.4, -270),
        *zigzag((20.6, 8.4), (12.9, 8.4), 0.25),
        *(Stop(12.4, 8.3), Stop(12.4, 6.75), Stop(13.9, 6.7, 360), Stop(12.4, 6.75), Stop(12.4, 8.3)),
        *zigzag((11.9, 8.4), (6.9, 8.4), 0.25),
        Stop(6.4, 8.4, -270),
        *zigzag((6.45, 7.9), (6.45, 1.6), 0.2),
        *(Stop(6.4, 1.0), Stop(9.5, 1.0, -180), Stop(6.4, 1.1), Stop(2.4, 1.0, 180), Stop(4.4, 1.0)),
    ]
