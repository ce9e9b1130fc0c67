# SPDX-License-Identifier: Apache-2.0
"""`sim:aisle`: a long narrow aisle with a wall at its end (Chien 2020, Fig 4.12)."""

from __future__ import annotations

from stereovox.geometry import Transform, look_at
from stereovox.sources.d435 import D435
from stereovox.sources.scene import Point, Scene, box
from stereovox.sources.stage import Stage, rectangle, within

FRAMES = 120
START = 0.1
"""Metres between the wall behind the camera and the camera."""
STOP = 2.0
"""Metres before the end wall at which a walking camera stops."""
FARTHEST = 16.0
"""Depth up to which the camera delivers: Chien 2020, 2.2 trusts his D435 up to 16 m."""
THICKNESS = 0.2


def stage(
    *, length: float = 12.0, width: float = 1.27, height: float = 2.5, eye: float = 1.23, speed: float = 0.0
) -> Stage:
    """Return an aisle and a camera at its start that looks along it, and walks along it with `speed` m/s.

    eye: height of the camera above the floor. With speed 0 the camera stands.
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
