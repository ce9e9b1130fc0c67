# SPDX-License-Identifier: Apache-2.0
"""`sim:hall`: a random closed hall, with pillars, posts, half walls, boxes and lamps; every plan differs.

Simple scenes from Chien 2020: `sim:aisle` (Fig 4.12), `sim:box` (4.4.1) and `sim:wall` (Appendix B).
"""

from __future__ import annotations

import numpy as np

from stereovox.errors import SourceError
from stereovox.geometry.se3 import Transform, look_at, rotation_matrix
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Point, Scene, Solid, box, cylinder
from stereovox.simulate.stage import SHIFT, Face, Stage, moved, one_of, rectangle, within

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


SIZES = {"large": (0.47, 0.365, 0.32), "small": (0.25, 0.185, 0.09)}
"""Width, height and depth in metres (Chien 2020, Fig 4.5 and 4.8)."""
FRAMES = 120
THICKNESS = 0.2
WALL_FRAMES = 30
STEEPEST = 25.0
"""Largest rotation of the wall in degrees; beyond, the camera's outermost rays hardly meet it."""
START = 0.1
"""Metres between the camera and the wall behind it."""
STOP = 2.0
"""Metres from the end wall at which a walking camera stops."""
FARTHEST = 16.0
"""Maximum depth of the camera: Chien 2020, 2.2 trusts his D435 up to 16 m."""


def box_stage(
    *,
    size: str = "large",
    distance: float = 2.0,
    x: float = 0.0,
    y: float = 0.0,
    wall: float = 4.1,
    height: float = 1.2,
) -> Stage:
    """Return a box whose front is `distance` metres in front of the camera and parallel to the image.

    x, y: its centre, right of and below the optical axis; wall: distance of the wall behind it; height: of the
    camera above the floor. World: z up, origin on the floor below the camera, which faces along x. The box floats,
    so that all its sides can be evaluated. Parts: `box`, `wall`, `floor`.
    Raises SourceError for a box that does not fit between camera, wall and floor.
    """
    one_of("size", size, tuple(SIZES))
    width, tall, deep = SIZES[size]
    within("wall", wall, 1, 30)
    within("height", height, 0.2, 5)
    within("distance", distance, 0.2, wall - deep)
    within("x", x, -wall, wall)
    if not tall / 2 <= height - y <= height + wall - tall / 2:
        raise SourceError(f"y={y:g} puts the box into the floor or above the wall; the floor is at y={height:g}")
    low = (distance, -x - width / 2, height - y - tall / 2)
    high = (distance + deep, -x + width / 2, height - y + tall / 2)
    half, top = 1.1 * wall + 1, height + wall  # more than the camera's view

    def build() -> Scene:
        return Scene(
            [
                box("box", f"{size} box", low, high),
                box("wall", "wall", (wall, -half, 0), (wall + THICKNESS, half, top)),
                box("floor", "floor", (-1, -half, -THICKNESS), (wall + THICKNESS, half, 0)),
            ]
        )

    faces = (
        rectangle("box", low, (distance, *high[1:]), towards=(-1, 0, 0)),
        rectangle("wall", (wall, -half, 0), (wall, half, top), towards=(-1, 0, 0)),
    )
    T_world_camera = look_at((0, 0, height), (1, 0, height))
    return Stage(build, lambda share: T_world_camera, FRAMES, faces=faces)


def wall_stage(*, distance: float = 1.4, tilt: float = 0.0, turn: float = 0.0) -> Stage:
    """Return a wall that the optical axis meets at `distance` metres, and a static camera.

    tilt: degrees by which the wall's top leans away from the camera; turn: degrees by which its right side does.
    World: z up, origin in the camera, which faces along x. Raises SourceError for values out of range.
    """
    within("distance", distance, 0.1, 60)
    within("tilt", tilt, -STEEPEST, STEEPEST)
    within("turn", turn, -STEEPEST, STEEPEST)
    T_world_wall = np.eye(4)
    T_world_wall[:3, :3] = rotation_matrix([0, 0, np.radians(turn)]) @ rotation_matrix([0, np.radians(tilt), 0])
    T_world_wall[0, 3] = distance
    half = 5 * distance + 1
    corners = np.array([(0, half, -half), (0, -half, -half), (0, -half, half), (0, half, half)], float)

    def build() -> Scene:
        slab = box("wall", "wall", (0, -half, -half), (THICKNESS, half, half))
        return moved(Scene([slab]), T_world_wall)

    T_world_camera = look_at((0, 0, 0), (1, 0, 0))
    face = Face("wall", corners @ T_world_wall[:3, :3].T + T_world_wall[:3, 3])
    return Stage(build, lambda share: T_world_camera, WALL_FRAMES, faces=(face,))


def aisle_stage(
    *, length: float = 12.0, width: float = 1.27, height: float = 2.5, eye: float = 1.23, speed: float = 0.0
) -> Stage:
    """Return an aisle and a camera at its start that faces along it, and moves along it at `speed` m/s.

    eye: height of the camera above the floor. With speed 0 the camera is static.
    World: z up, origin on the floor below the first camera, x along the aisle, which ends at `length` - 0.1.
    Parts: `side walls`, `end wall`, `floor`, `ceiling`. Raises SourceError for values out of range.
    """
    within("length", length, STOP + 1, 100)
    within("width", width, 0.6, 10)
    within("height", height, 1, 10)
    within("eye", eye, 0.2, height - 0.2)
    within("speed", speed, 0, 10)
    end, half = length - START, width / 2
    way = end - STOP if speed else 0.0
    faces = (
        rectangle("left wall", (-START, half, 0), (end, half, height), towards=(0, -1, 0)),
        rectangle("right wall", (-START, -half, 0), (end, -half, height), towards=(0, 1, 0)),
        rectangle("end wall", (end, -half, 0), (end, half, height), towards=(-1, 0, 0)),
    )

    def path(share: float) -> Transform:
        return look_at((way * share, 0, eye), (way * share + 1, 0, eye))

    frames = round(way / speed * 30) + 1 if speed else FRAMES
    device = D435(farthest=FARTHEST)
    return Stage(lambda: _scene((-START, -half, 0), (end, half, height)), path, frames, device=device, faces=faces)


def _scene(low: Point, high: Point) -> Scene:
    (x0, y0, z0), (x1, y1, z1), t = low, high, THICKNESS
    return Scene(
        [
            box("side walls", "left wall", (x0, y1, z0), (x1, y1 + t, z1)),
            box("side walls", "right wall", (x0, y0 - t, z0), (x1, y0, z1)),
            box("end wall", "end wall", (x1, y0 - t, z0), (x1 + t, y1 + t, z1)),
            box("back wall", "back wall", (x0 - t, y0 - t, z0), (x0, y1 + t, z1)),
            box("floor", "floor", (x0 - t, y0 - t, z0 - t), (x1 + t, y1 + t, z0)),
            box("ceiling", "ceiling", (x0 - t, y0 - t, z1), (x1 + t, y1 + t, z1 + t)),
        ]
    )
