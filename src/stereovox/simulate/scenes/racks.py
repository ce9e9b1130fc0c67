# SPDX-License-Identifier: Apache-2.0
"""`sim:racks`: an aisle between identical shelves, walked back and forth. x along the aisle, y to its left."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.simulate import flight
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box
from stereovox.simulate.stage import SHIFT, Stage, moved, within

HALF, DEEP, HEIGHT = 1.2, 1.0, 3.0
"""Half width of the aisle, depth of the shelves, height of the hall, in metres."""
BOARDS = (0.5, 1.2, 1.9)
"""Heights of the boards."""
SWAY, STEP, AHEAD = 0.25, 4.0, 1.0
"""Largest distance of the walker from the middle, metres from waypoint to waypoint, and to the aisle's ends."""
HZ, IMAGE_WIDTH = 10.0, 212


def stage(*, bays: int = 24, bay: float = 1.2, passes: int = 3, walk: int = 0, speed: float = 1.2) -> Stage:
    """Return an aisle of `bays` bays of `bay` metres on both sides, walked from end to end `passes` times.

    Each bay has an upright, three boards and one box in the same place: all bays look the same,
    except at the hall's ends. walk: seed of the walker's distance from the middle. Images are 212 pixels wide, 10 a
    second. World: z up, floor at 0. Parts: `walls`, `floor`, `ceiling`, `shelves`, `boxes`. Raises SourceError for
    values out of range.
    """
    within("bays", bays, 4, 500)
    within("bay", bay, 0.6, 5)
    within("passes", passes, 1, 50)
    within("walk", walk, 0, 2**31)
    within("speed", speed, 0.1, 3)
    T_world_plan = np.eye(4)
    T_world_plan[:3, 3] = SHIFT
    path, seconds = flight.walk(_waypoints(bays * bay, passes, np.random.default_rng(walk)), speed)
    return Stage(
        lambda: moved(Scene(_hall(bays, bay)), T_world_plan),
        lambda share: T_world_plan @ path(share),
        round(seconds * HZ) + 1,
        HZ,
        device=D435(camera=depth_camera(IMAGE_WIDTH)),
    )


def _waypoints(length: float, passes: int, random: np.random.Generator) -> NDArray[np.float64]:
    """Return x, y and yaw in degrees (N, 3) of a walk back and forth."""
    forth = np.arange(AHEAD, length - AHEAD, STEP)
    ways = [forth if n % 2 == 0 else forth[::-1] for n in range(passes)]
    aside = random.uniform(-SWAY, SWAY, passes * len(forth))
    yaws = np.repeat(180.0 * np.arange(passes), len(forth))
    return np.column_stack([np.concatenate(ways), aside, yaws]).astype(float)


def _hall(bays: int, bay: float) -> list[Solid]:
    """Return all solids."""
    back, end, out = HALF + DEEP, bays * bay + AHEAD, 0.2
    solids = [
        box("floor", "floor", (-AHEAD - out, -back - out, -out), (end + out, back + out, 0)),
        box("ceiling", "ceiling", (-AHEAD - out, -back - out, HEIGHT), (end + out, back + out, HEIGHT + out)),
        box("walls", "right wall", (-AHEAD, -back - out, 0), (end, -back, HEIGHT)),
        box("walls", "left wall", (-AHEAD, back, 0), (end, back + out, HEIGHT)),
        box("walls", "start wall", (-AHEAD - out, -back - out, 0), (-AHEAD, back + out, HEIGHT)),
        box("walls", "end wall", (end, -back - out, 0), (end + out, back + out, HEIGHT)),
    ]
    for n in range(bays):
        solids += [*_bay(f"left bay {n}", n * bay, bay, 1), *_bay(f"right bay {n}", n * bay, bay, -1)]
    return solids


def _bay(name: str, x: float, bay: float, side: int) -> list[Solid]:
    """Return one bay of shelves, on the left (side 1) or right (-1)."""
    near, far = sorted((side * HALF, side * (HALF + DEEP)))
    a, b = sorted((side * (HALF + 0.2), side * (HALF + DEEP - 0.2)))
    return [
        box("shelves", f"{name}: upright", (x, near, 0), (x + 0.1, far, 2.6)),
        *(box("shelves", f"{name}: board {z}", (x, near, z), (x + bay, far, z + 0.05)) for z in BOARDS),
        box("boxes", f"{name}: box", (x + bay / 3, a, 0.55), (x + 2 * bay / 3, b, 1.0)),
    ]
