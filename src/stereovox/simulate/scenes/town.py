# SPDX-License-Identifier: Apache-2.0
"""`sim:town`: streets between terraces of houses, with lamps, trees, signs, bollards and parked cars.

Streets run along x and y, `PITCH` metres apart; `SHIFT` offsets everything by odd millimetres, so that no wall is
exactly on a cell's face for any round cell size.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform, look_at
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene, Solid, box, cylinder
from stereovox.simulate.stage import SHIFT, Stage, within

PITCH = 50.0
"""Metres from street to street."""
ROAD, STREET = 3.25, 5.5
"""Half width of the carriageway, and of the street with its pavements."""
KERB = 0.12
"""Height of the pavements."""
HZ = 10.0
EYE = 1.6
CORNER = 5.0
"""Radius in metres of the turns."""
BASELINE, FARTHEST, IMAGE_WIDTH = 0.12, 20.0, 640
"""A stereo camera for outdoors."""
PARKED = (4.3, 1.8, 1.45)
"""Length, width and height of a car."""

Way = list[tuple[float, NDArray[np.float64], float, float]]
"""Pieces of a path: length, start (2,), heading at the start, and its turn, in radians."""


def stage(*, blocks: int = 6, drive: int = 0, length: float = 120.0, speed: float = 5.0, town: int = 0) -> Stage:
    """Return a town of blocks x blocks blocks, 50 m each, and a drive of `length` metres at `speed` m/s.

    town: seed of the town's contents; drive: seed of the route, which chooses at every crossing. 10 images a second,
    640 pixels wide, from a stereo camera with a baseline of 0.12 m and a range of 20 m. World: z up, origin in the
    town's middle. Parts: `ground`, `pavements`, `houses`, `lamps`, `trees`, `signs`, `bollards`, `cars`. Raises
    SourceError for values out of range.
    """
    within("blocks", blocks, 1, 40)
    within("length", length, 1, 100_000)
    within("speed", speed, 0.1, 30)
    within("drive", drive, 0, 2**31)
    within("town", town, 0, 2**31)
    way = _way(blocks, length, np.random.default_rng([drive, 1]))
    camera = replace(depth_camera(IMAGE_WIDTH), baseline=BASELINE)
    return Stage(
        lambda: Scene(_town(blocks, town)),
        lambda share: _on_way(way, share * length),
        round(length / speed * HZ) + 1,
        HZ,
        device=D435(camera=camera, farthest=FARTHEST),
    )


def _way(blocks: int, length: float, random: np.random.Generator) -> Way:
    """Return a path of at least `length` metres along the streets, with rounded corners at crossings."""
    place = random.integers(0, blocks + 1, 2)
    turns = np.array([0, 1, 2, 3])
    heading = int(random.choice([turn for turn in turns if _inside(place + _ahead(turn), blocks)]))
    way, travelled = [], 0.0
    while travelled < length:
        start = _crossing(place, blocks) + CORNER * _ahead(heading)
        place = place + _ahead(heading)
        ways = [t for t in (heading - 1, heading, heading + 1) if _inside(place + _ahead(t), blocks)]
        chosen = int(random.choice(ways))
        angle, left = heading * math.pi / 2, chosen - heading
        way.append((PITCH - 2 * CORNER, start, angle, 0.0))
        bend = CORNER * math.pi / 2 if left else 2 * CORNER
        way.append((bend, start + (PITCH - 2 * CORNER) * _ahead(heading), angle, left * math.pi / 2))
        travelled += PITCH - 2 * CORNER + bend
        heading = chosen
    return way


def _ahead(heading: int) -> NDArray[np.int64]:
    """Return the direction (2,) after this many quarter turns from x."""
    return np.array([(1, 0), (0, 1), (-1, 0), (0, -1)][heading % 4])


def _inside(place: NDArray[np.int64], blocks: int) -> bool:
    return bool(np.all((place >= 0) & (place <= blocks)))


def _crossing(place: NDArray[np.int64], blocks: int) -> NDArray[np.float64]:
    return PITCH * np.asarray(place - blocks / 2, np.float64)


def _on_way(way: Way, travelled: float) -> Transform:
    """Return T_world_camera after this many metres."""
    ends = np.cumsum([piece[0] for piece in way])
    n = min(int(np.searchsorted(ends, travelled)), len(way) - 1)
    length, start, heading, turn = way[n]
    travelled = min(travelled - (ends[n] - length), length)
    if turn:
        yaw = heading + turn * travelled / length
        centre = start + CORNER * np.sign(turn) * np.array([-math.sin(heading), math.cos(heading)])
        at = centre + CORNER * np.sign(turn) * np.array([math.sin(yaw), -math.cos(yaw)])
    else:
        yaw, at = heading, start + travelled * np.array([math.cos(heading), math.sin(heading)])
    eye = np.append(at, EYE) + SHIFT
    return look_at(eye, eye + np.array([math.cos(yaw), math.sin(yaw), -0.05]))


def _town(blocks: int, seed: int) -> list[Solid]:
    half = PITCH * blocks / 2 + STREET
    solids = [box("ground", "ground", (-half, -half, -0.3), (half, half, 0.0))]
    for i in range(blocks):
        for j in range(blocks):
            low = PITCH * (np.array([i, j]) - blocks / 2) + ROAD
            solids += _block(f"block {i} {j}", low, np.random.default_rng([seed, i, j]))
    return [Solid(solid.part, solid.name, solid.triangles + SHIFT) for solid in solids]


def _block(name: str, low: NDArray[np.float64], random: np.random.Generator) -> list[Solid]:
    """Return one block; `low` (2,) is the corner of its pavement nearest to -x, -y."""
    size = PITCH - 2 * ROAD
    solids = [box("pavements", f"{name}: pavement", (*low, -0.2), (*(low + size), KERB))]
    for side in range(4):
        solids += _front(f"{name}, side {side}", size, random, low + size / 2, side)
    return solids


def _front(name: str, size: float, random: np.random.Generator, middle: NDArray[np.float64], side: int) -> list[Solid]:
    """Return houses and street furniture along one side of a block.

    They are built as if the street ran along x, south of the block, and then turned about its middle (2,).
    """
    edge, pavement = -size / 2, STREET - ROAD
    solids = _houses(name, edge + pavement, size / 2 - pavement, random)
    for n, x in enumerate(np.arange(edge + 3, size / 2 - 3, 6.0)):
        solids += _thing(f"{name}, {n}", x + random.uniform(-1, 1), edge + random.uniform(0.3, 0.7), random)
        if random.random() < 0.4:
            solids += _car(f"{name}, car {n}", x + random.uniform(-0.4, 0.4), edge - 1.15)
    turn = side * math.pi / 2
    cosine, sine = round(math.cos(turn)), round(math.sin(turn))
    T = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    at = np.append(middle, 0.0)
    return [Solid(solid.part, solid.name, solid.triangles @ T.T + at) for solid in solids]


def _houses(name: str, edge: float, half: float, random: np.random.Generator) -> list[Solid]:
    """Return a terrace from -half to half less the depth of the next side's, with fronts at `edge` or behind it."""
    solids, x, end = [], -half, half - 12
    for n in range(100):
        wide, back, tall = random.uniform(6, 12), random.choice([0.0, 0.0, 0.4, 1.5]), random.uniform(4, 12)
        wide = wide if x + wide < end - 6 else end - x
        front, door = edge + back, x + random.uniform(0.8, wide - 2)
        solids.append(box("houses", f"{name}, house {n}", (x, front, 0), (x + wide, edge + 11, tall)))
        solids.append(box("houses", f"{name}, step {n}", (door, front - 0.3, 0), (door + 1.1, front, 0.3)))
        x += wide + random.choice([0.0, 0.0, 0.0, 2.0])
        if x > end - 6:
            break
    return solids


def _thing(name: str, x: float, y: float, random: np.random.Generator) -> list[Solid]:
    kind = random.choice(["lamps", "trees", "signs", "bollards", ""])
    if kind == "lamps":
        return [
            cylinder(kind, f"{name}: lamp", (x, y, 0), (x, y, 5.0), 0.12),
            box(kind, f"{name}: arm", (x - 0.06, y - 1.2, 4.9), (x + 0.06, y, 5.0)),
        ]
    if kind == "trees":
        wide = random.uniform(0.8, 1.6)
        return [
            cylinder(kind, f"{name}: trunk", (x, y + 0.2, 0), (x, y + 0.2, 2.6), random.uniform(0.15, 0.4)),
            cylinder(kind, f"{name}: crown", (x, y + 0.2, 2.5), (x, y + 0.2, 5.5), 2 * wide, sections=9),
        ]
    if kind == "signs":
        return [
            cylinder(kind, f"{name}: post", (x, y, 0), (x, y, 2.6), 0.06),
            box(kind, f"{name}: plate", (x - 0.02, y - 0.3, 2.0), (x + 0.02, y + 0.3, 2.6)),
        ]
    if kind == "bollards":
        return [cylinder(kind, f"{name}: bollard {n}", (x + n, y, 0), (x + n, y, 0.95), 0.1) for n in (-1.2, 0.0, 1.2)]
    return []


def _car(name: str, x: float, y: float) -> list[Solid]:
    long, wide, tall = PARKED
    return [
        box("cars", f"{name}: body", (x - long / 2, y - wide / 2, 0.2), (x + long / 2, y + wide / 2, 0.8)),
        box("cars", f"{name}: cabin", (x - long / 3, y - wide / 2.3, 0.8), (x + long / 4, y + wide / 2.3, tall)),
    ]
