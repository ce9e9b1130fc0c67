# SPDX-License-Identifier: Apache-2.0
"""`sim:wall`: one flat wall that fills the view, to calibrate a depth camera on (Chien 2020, App. A and 2.2.4)."""

from __future__ import annotations

import numpy as np

from stereovox.geometry import look_at, rotation_matrix
from stereovox.sources.scene import Scene, box
from stereovox.sources.stage import Face, Stage, moved, within

FRAMES = 30
STEEPEST = 25.0
"""Degrees by which the wall may turn; further, the camera's outermost rays hardly meet it."""
THICKNESS = 0.2


def stage(*, distance: float = 1.4, tilt: float = 0.0, turn: float = 0.0) -> Stage:
    """Return a wall that the optical axis meets at `distance` metres, and a camera that stands.

    tilt: degrees by which the wall's top leans away from the camera; turn: degrees by which its right side does.
    World: z up, origin in the camera, which looks along x. Raises SourceError for values out of range.
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
    return Stage(build, lambda share: T_world_camera, FRAMES, faces=(face,))
