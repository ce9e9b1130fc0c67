# SPDX-License-Identifier: Apache-2.0
"""`sim:hall`: a random closed hall, with pillars, posts, half walls, boxes and lamps; every plan differs."""

from __future__ import annotations

import numpy as np

from stereovox.geometry.se3 import Transform, look_at
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box, cylinder
from stereovox.simulate.stage import SHIFT, Stage, moved, within

THICK, LANE = 0.2, 1.6
"""Thickness of the walls, and width of the free lane along them: the path of the recording."""
EYE, HZ, IMAGE_WIDTH, SECONDS = 1.3, 15.0, 212, 40.0


def stage(*, plan: int = 0) -> Stage:
    """Return a hall 9 to 13 m long, 7 to 10 m wide and 2.6 to 3.4 m high, and a path round it, 15 images a second.

    plan: number of the hall: its size and contents. Images are 212 pixels wide. World: z up, origin in the
    middle of the floor. Parts: `walls`, `floor`, `ceiling`, `pillars`, `posts` (3 to 8 cm), `half walls`, `boxes`,
    `lamps`. Raises SourceError for values out of range.
    """
    within("plan", plan, 0, 2**31)
    random = np.random.default_rng([11, plan])
    half = np.array([random.uniform(4.5, 6.5), random.uniform(3.5, 5.0)])
    height = random.uniform(2.6, 3.4)
    T_world_plan = np.eye(4)
    T_world_plan[:3, 3] = SHIFT

    def path(share: float) -> Transform:
        angle = 2 * np.pi * share
        x, y = np.clip(1.4 * np.array([np.cos(angle), np.sin(angle)]), -1, 1) * (half - LANE / 2)
        return T_world_plan @ look_at((x, y, EYE), (0.3 * x - 2 * y / half[1], 0.3 * y + 2 * x / half[0], 0.8 * EYE))

    frames = round(SECONDS * HZ) + 1
    device = D435(camera=depth_camera(IMAGE_WIDTH))
    return Stage(lambda: moved(Scene(_hall(half, height, plan)), T_world_plan), path, frames, HZ, device=device)


def _hall(half: np.ndarray, height: float, plan: int) -> list[Solid]:
    """Return all solids."""
    x, y, t = half[0], half[1], THICK
    return [
        box("floor", "floor", (-x - t, -y - t, -t), (x + t, y + t, 0)),
        box("ceiling", "ceiling", (-x - t, -y - t, height), (x + t, y + t, height + t)),
        box("walls", "west wall", (-x - t, -y - t, 0), (-x, y + t, height)),
        box("walls", "east wall", (x, -y - t, 0), (x + t, y + t, height)),
        box("walls", "south wall", (-x, -y - t, 0), (x, -y, height)),
        box("walls", "north wall", (-x, y, 0), (x, y + t, height)),
        *_things(half - LANE, height, np.random.default_rng([12, plan])),
    ]


def _things(inner: np.ndarray, height: float, random: np.random.Generator) -> list[Solid]:
    """Return the objects in the middle of the hall."""
    solids = []

    def place() -> tuple[float, float]:
        return random.uniform(-inner[0], inner[0]), random.uniform(-inner[1], inner[1])

    for n in range(random.integers(2, 5)):
        (x, y), side = place(), random.uniform(0.1, 0.3)
        low, high = (x - side, y - side, 0.0), (x + side, y + side, height)
        solids.append(box("pillars", f"pillar {n}", low, high, random.uniform(0, np.pi)))
    for n in range(random.integers(2, 5)):
        (x, y), width = place(), random.uniform(0.03, 0.08)
        solids.append(cylinder("posts", f"post {n}", (x, y, 0), (x, y, height), width, sections=10))
    for n in range(random.integers(0, 3)):
        (x, y), side = place(), random.uniform(0.5, 1.2)
        low, high = (x - side, y - 0.06, 0.0), (x + side, y + 0.06, height)
        solids.append(box("half walls", f"half wall {n}", low, high, random.choice([0, np.pi / 2])))
    for n in range(random.integers(3, 7)):
        (x, y), (a, b), top = place(), random.uniform(0.15, 0.5, 2), random.uniform(0.4, 2.0)
        solids.append(box("boxes", f"box {n}", (x - a, y - b, 0), (x + a, y + b, top), random.uniform(0, np.pi)))
    for n in range(random.integers(1, 4)):
        (x, y), low = place(), random.uniform(1.1, 1.8)
        solids.append(cylinder("lamps", f"lamp {n}", (x, y, low), (x, y, low + 0.3), 0.35, sections=16))
        solids.append(cylinder("lamps", f"cable {n}", (x, y, low + 0.3), (x, y, height), 0.012, sections=8))
    return solids
