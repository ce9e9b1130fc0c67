# SPDX-License-Identifier: Apache-2.0
"""The simulated floors: `plan=corridors` and `plan=testbed`, after the 5th and the 8th floor of IST 2019."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereovox.simulate.floors.drive import Stop, zigzag
from stereovox.simulate.floors.plan import CEILING, FloorPlan, Obstacle, Rectangle, block, post

SHIFT = (0.0137, 0.0219)
"""Offset in metres of the whole floor, so that no wall is exactly on a cell's face for any round cell size."""
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
"""Distinctive zones (IST 2019, III-D)."""
OPEN = ((10.25, SOUTH), (16.25, SOUTH), (11.95, NORTH))
"""Open doors of 0.9 m: x from, and the row of offices."""
SHUT = ((14.55, SOUTH), (7.65, NORTH), (16.25, NORTH))
BEHIND: Rectangle = (1.0, 2.08, 2.8, 7.6)
"""The stairs' corridor, from the middle of its door on."""
TESTBED_FREE: tuple[Rectangle, ...] = (
    (0.0, 0.0, 12.0, 9.0),  # hall
    (12.0, 6.2, 13.2, 8.2),  # alcove
    (-5.0, 3.6, -0.15, 5.4),  # corridor that leads there
    (-0.15, 3.9, 0.0, 5.1),
    (-3.3, 5.4, -2.4, 5.5),  # shut doors in the corridor
    (-4.2, 3.5, -3.3, 3.6),
)
TESTBED_STOPS = tuple(Stop(*numbers) for numbers in [
    (-4.3, 4.5, 360), (-3.5, 4.5), (-2.4, 4.8), (-1.2, 4.3), (0.7, 4.5, 180), (0.8, 3.4, -90), (0.75, 1.5),
    (2.6, 1.2, 90), (3.2, 3.0), (4.8, 1.3, 90), (5.4, 3.2), (7.6, 3.4), (7.7, 1.2, -180), (7.9, 3.0),
    (9.6, 3.3, -360), (11.0, 1.9), (10.9, 3.0), (11.05, 4.7), (11.4, 5.4), (11.4, 6.4), (12.3, 7.1, 360),
    (11.2, 7.0), (9.6, 7.9), (9.4, 6.2), (7.4, 5.8, 180), (6.6, 4.6), (4.9, 4.9), (4.8, 6.6), (4.7, 7.9, -360),
    (4.7, 6.5), (2.6, 5.9, 90), (0.9, 6.3), (0.9, 8.2, 180), (0.9, 6.0), (2.8, 3.7), (6.0, 3.7, 180),
    (7.4, 5.3), (9.2, 5.2, -180), (6.0, 5.0), (2.6, 5.2), (0.8, 4.5), (-1.2, 4.6), (-3.6, 4.5),
])  # fmt: skip
"""Criss-cross through the hall, with returns."""


def table(
    name: str, x: float, y: float, size: tuple[float, float] = (1.6, 0.8), turn_deg: float = 0.0
) -> list[Obstacle]:
    """Return a table centred at (x, y): four thin legs, and a top that a low lidar does not see."""
    half_x, half_y = size[0] / 2, size[1] / 2
    about = (x, y)
    top = block("tables", f"{name}: top", _round(x, y, half_x, half_y), (0.70, 0.74), turn_deg, about)
    legs = [
        block("tables", f"{name}: leg {n}", _round(x + a, y + b, 0.025, 0.025), (0.0, 0.70), turn_deg, about)
        for n, (a, b) in enumerate(_four(half_x - 0.05, half_y - 0.05), 1)
    ]
    return [top, *legs]


def chair(name: str, x: float, y: float, turn_deg: float = 0.0) -> list[Obstacle]:
    """Return a chair centred at (x, y), whose sitter faces along x turned by `turn_deg`."""
    about = (x, y)
    seat = block("chairs", f"{name}: seat", _round(x, y, 0.21, 0.21), (0.43, 0.47), turn_deg, about)
    back = block("chairs", f"{name}: back", (x - 0.21, y - 0.2, x - 0.18, y + 0.2), (0.47, 0.88), turn_deg, about)
    legs = [
        block("chairs", f"{name}: leg {n}", _round(x + a, y + b, 0.018, 0.018), (0.0, 0.43), turn_deg, about)
        for n, (a, b) in enumerate(_four(0.18, 0.18), 1)
    ]
    return [seat, back, *legs]


def shelf(name: str, where: tuple[float, float, float, float]) -> list[Obstacle]:
    """Return a shelf on two sides, its lowest board 35 cm up: a lidar sees below it, except for the sides."""
    x0, y0, x1, y1 = where
    ends = ((x0, y0, x0 + 0.03, y1), (x1 - 0.03, y0, x1, y1))
    sides = [block("shelf", f"{name}: side {n}", end, (0.0, 1.9)) for n, end in enumerate(ends, 1)]
    boards = [
        block("shelf", f"{name}: board {n}", where, (z, z + 0.03)) for n, z in enumerate((0.35, 0.8, 1.25, 1.7), 1)
    ]
    return [*sides, *boards]


@dataclass(frozen=True, eq=False)
class Layout:
    """A floor, the robot's path, and the rectangle that a shut door closes off (None: no such door)."""

    plan: FloorPlan
    stops: Sequence[Stop]
    behind_door: Rectangle | None = None

    def moved(self, x: float, y: float) -> Layout:
        """Return the same floor at another place."""

        def rectangle(one: Rectangle) -> Rectangle:
            return one[0] + x, one[1] + y, one[2] + x, one[3] + y

        def obstacle(one: Obstacle) -> Obstacle:
            return replace(one, corners=one.corners + np.array([x, y]))

        plan = FloorPlan([rectangle(one) for one in self.plan.free], [obstacle(one) for one in self.plan.obstacles])
        stops = [Stop(stop.x + x, stop.y + y, stop.spin_deg) for stop in self.stops]
        return Layout(plan, stops, None if self.behind_door is None else rectangle(self.behind_door))


def corridors(shut: bool) -> Layout:
    """Return the floor and a drive of about 110 m. shut: the stairs' door is closed, and the robot drives past it."""
    rooms = [(x, row[0], x + WIDTH, row[1]) for row in (SOUTH, NORTH) for x in OFFICES.values()]
    doors = [_door(x, row, 0.15) for x, row in OPEN] + [_door(x, row, 0.1) for x, row in SHUT]
    obstacles = [*_corridor_obstacles(), *_corner_obstacles(), *_office_obstacles()]
    if shut:
        obstacles.append(block("doors", "door to the stairs", (1.45, 2.08, 2.35, 2.12), (0.0, CEILING)))
    plan = FloorPlan([*CORRIDORS, *CORNERS, *rooms, *doors], obstacles)
    return Layout(plan, _stops(shut), BEHIND).moved(*SHIFT)


def testbed(shut: bool) -> Layout:
    """Return the hall and a drive of about 75 m. There is no door to shut: `shut` has no effect."""
    del shut
    return Layout(FloorPlan(TESTBED_FREE, _testbed_obstacles()), TESTBED_STOPS).moved(*SHIFT)


def _round(x: float, y: float, half_x: float, half_y: float) -> tuple[float, float, float, float]:
    return x - half_x, y - half_y, x + half_x, y + half_y


def _four(x: float, y: float) -> tuple[tuple[float, float], ...]:
    return (-x, -y), (x, -y), (x, y), (-x, y)


def _door(x: float, row: tuple[float, float], deep: float) -> Rectangle:
    """Return the opening of a door, or the recess in front of a shut one."""
    return (x, 2.0, x + 0.9, 2.0 + deep) if row == SOUTH else (x, 7.6 - deep, x + 0.9, 7.6)


def _corridor_obstacles() -> list[Obstacle]:
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


def _corner_obstacles() -> list[Obstacle]:
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


def _office_obstacles() -> list[Obstacle]:
    """Return the contents of the open offices: a table at the back, a chair, a cabinet away from the door."""
    obstacles = []
    for name, x, row, cabinet in (("a", 7.35, SOUTH, 0.02), ("c", 15.95, SOUTH, 3.65), ("b", 11.65, NORTH, 3.65)):
        back, towards = (row[1] - 0.45, 1) if row == SOUTH else (row[0] + 0.45, -1)
        front = row[0] + 0.15 if row == SOUTH else row[1] - 1.35
        obstacles += table(f"office {name}: table", x + 2.05, back, (1.4, 0.7))
        obstacles += chair(f"office {name}: chair", x + 2.05, back - towards * 0.5, 90.0 * towards + 12)
        obstacles.append(
            block(
                "cabinets", f"office {name}: cabinet", (x + cabinet, front, x + cabinet + 0.43, front + 1.2), (0.0, 1.2)
            )
        )
    return obstacles


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


def _testbed_obstacles() -> list[Obstacle]:
    return [
        block("pillars", "pillar west", (3.8, 4.3, 4.2, 4.7), (0.0, CEILING)),
        block("pillars", "pillar east", (7.8, 4.3, 8.2, 4.7), (0.0, CEILING)),
        *table("table 1", 2.4, 7.6, turn_deg=12),
        *chair("chair 1", 2.2, 6.95, 100),
        *chair("chair 2", 3.6, 7.9, -160),
        *table("table 2", 6.3, 7.7),
        *table("table 3", 7.9, 7.7),
        *chair("chair 3", 6.9, 7.05, 80),
        *table("table 4", 9.6, 1.5, turn_deg=75),
        *chair("chair 4", 8.9, 1.3, 10),
        *shelf("shelf", (2.6, 0.03, 4.4, 0.4)),
        block("boxes", "pallet", (1.45, 2.0, 2.25, 2.7), (0.0, 0.15), 20),
        block("boxes", "crate", (6.1, 1.7, 6.9, 2.3), (0.0, 0.5), 35),
        block("boxes", "carton, low", (5.5, 5.6, 5.9, 6.0), (0.0, 0.2), 15),
        block("boxes", "carton, high", (10.4, 5.0, 10.9, 5.5), (0.0, 0.8), -25),
        block("boxes", "stack, below", (11.3, 0.1, 11.9, 0.9), (0.0, 0.4)),
        block("boxes", "stack, above", (11.35, 0.15, 11.8, 0.8), (0.4, 0.9)),
        block("cabinets", "cabinet", (11.5, 2.6, 11.98, 4.2), (0.0, 1.5)),
        block("boxes", "hung panel", (0.02, 6.6, 0.3, 8.2), (0.6, 1.4)),
        post("posts", "column", (12.75, 7.8), 0.3, 2.0),
        post("posts", "barrel", (0.6, 0.6), 0.55, 0.9),
    ]
