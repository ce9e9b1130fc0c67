# SPDX-License-Identifier: Apache-2.0
"""`sim:flight`: kilometres along a hall and back, cheap enough to render a whole flight."""

from __future__ import annotations

import math

import numpy as np

from stereovox.geometry.se3 import Transform, look_at
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box
from stereovox.simulate.stage import Stage, within

LANE = 2.0
"""Metres between the hall's middle and the path, on the right both ways; also the radius of the turn at the end."""
HALF, HEIGHT = 5.0, 4.6
"""Half width and height of the hall."""
BAY = 8.0
"""Length of one bay: pillars, walls that step in and out, boxes on the floor and a beam."""
BEHIND, BEYOND = 6.0, 12.0
"""Metres of hall behind the start and beyond the turn."""
THICKNESS = 0.2
SEED = 0
"""Seed of the hall's bays."""
IMAGE_WIDTH = 212
"""Pixels across: a frame takes 5 ms."""


def stage(*, length: float = 2000.0, speed: float = 5.0) -> Stage:
    """Return a hall and a flight of `length` metres at `speed` m/s: half of it out, a U-turn, and back.

    Bays are statistically alike, but no two are equal. Images are 212 pixels wide, 30 a second.
    World: z up, x along the hall, origin on the floor in the hall's middle where the flight starts.
    Parts: `floor`, `ceiling`, `walls`, `pillars`, `boxes`, `beams`. Raises SourceError for values out of range.
    """
    within("length", length, 20, 50_000)
    within("speed", speed, 0.1, 50)
    straight = (length - math.pi * LANE) / 2

    def path(share: float) -> Transform:
        return _on_track(share * length, straight)

    def build() -> Scene:
        return Scene(_hall(straight + BEYOND, np.random.default_rng(SEED)))

    device = D435(camera=depth_camera(IMAGE_WIDTH))
    return Stage(build, path, round(length / speed * 30) + 1, device=device)


def _on_track(travelled: float, straight: float) -> Transform:
    """Return T_world_camera after this many metres: out on the right, half a circle to the left, back on the right."""
    if travelled <= straight:
        x, y, yaw = travelled, -LANE, 0.0
    else:
        yaw = min((travelled - straight) / LANE, math.pi)
        x, y = straight + LANE * math.sin(yaw), -LANE * math.cos(yaw)
        x -= max(travelled - straight - math.pi * LANE, 0.0)
    eye = np.array([x, y, 1.6 + 0.3 * math.sin(x / 7)])
    return look_at(eye, eye + np.array([math.cos(yaw), math.sin(yaw), 0]))


def _hall(end: float, random: np.random.Generator) -> list[Solid]:
    bays = math.ceil((BEHIND + end) / BAY)
    solids = [solid for n in range(bays) for solid in _bay(f"bay {n}", BAY * n - BEHIND, random)]
    return [
        *solids,
        box("walls", "start", (-BEHIND - THICKNESS, -HALF, 0), (-BEHIND, HALF, HEIGHT)),
        box("walls", "end", (BAY * bays - BEHIND, -HALF, 0), (BAY * bays - BEHIND + THICKNESS, HALF, HEIGHT)),
    ]


def _bay(name: str, x: float, random: np.random.Generator) -> list[Solid]:
    """Return one bay of the hall, which starts at `x`."""
    t, end = THICKNESS, x + BAY
    beam = x + random.uniform(1, BAY - 1)
    solids = [
        box("floor", f"{name}: floor", (x, -HALF - t, -t), (end, HALF + t, 0)),
        box("ceiling", f"{name}: ceiling", (x, -HALF - t, HEIGHT), (end, HALF + t, HEIGHT + t)),
        box("beams", f"{name}: beam", (beam, -HALF, HEIGHT - 0.4), (beam + 0.3, HALF, HEIGHT)),
    ]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        solids += _side(f"{name}, {side}", x, sign, random)
    return solids


def _side(name: str, x: float, sign: float, random: np.random.Generator) -> list[Solid]:
    """Return wall, pillar and box of one side; `sign` is 1 on the left, -1 on the right."""

    def part(kind: str, start: float, long: float, inner: float, outer: float, top: float) -> Solid:
        y0, y1 = sorted((sign * inner, sign * outer))
        return box(kind, f"{name}: {kind}", (x + start, y0, 0), (x + start + long, y1, top))

    pillar, thing = random.uniform(0.5, 3.0), random.uniform(4.0, BAY - 1.6)
    inner, step = random.uniform(3.3, 4.0), random.uniform(0, 0.6)
    deep, top = random.uniform(0.3, 0.7), random.uniform(0.4, 1.6)
    return [
        part("walls", 0, BAY, HALF - step, HALF + THICKNESS, HEIGHT),
        part("pillars", pillar, 0.35, 3.6, 3.95, HEIGHT),
        part("boxes", thing, random.uniform(0.4, 1.4), inner, inner + deep, top),
    ]
