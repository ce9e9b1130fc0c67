# SPDX-License-Identifier: Apache-2.0
"""`sim:box`: a box in the air before a wall, and a camera that stands (Chien 2020, 4.4.1)."""

from __future__ import annotations

from stereovox.errors import SourceError
from stereovox.geometry import look_at
from stereovox.sources.scene import Scene, box
from stereovox.sources.stage import Stage, one_of, rectangle, within

SIZES = {"large": (0.47, 0.365, 0.32), "small": (0.25, 0.185, 0.09)}
"""Width, height and depth in metres (Chien 2020, Fig 4.5 and 4.8)."""
FRAMES = 120
THICKNESS = 0.2


def stage(
    *,
    size: str = "large",
    distance: float = 2.0,
    x: float = 0.0,
    y: float = 0.0,
    wall: float = 4.1,
    height: float = 1.2,
) -> Stage:
    """Return a box whose front is `distance` metres before the camera and parallel to the image.

    x, y: where its middle is, right of and below the optical axis; wall: distance of the wall behind it; height: of the
    camera above the floor. World: z up, origin on the floor below the camera, which looks along x. Nothing holds the
    box, so that all its sides can be judged. Parts: `box`, `wall`, `floor`.
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
    half, top = 1.1 * wall + 1, height + wall  # more than the camera sees

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
