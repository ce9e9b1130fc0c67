# SPDX-License-Identifier: Apache-2.0
"""Poses of a simulation that drift like a tracker's."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from stereovox.geometry.se3 import Transform, inverse, rotation_matrix
from stereovox.simulate.t265 import OPENGL, STEP_S, Drift, drifted, start_frame

YAW_DEG = 5.0
"""Degrees of heading drift over one metre if positions drift by one metre a metre: a tracker that is off
by 1 % turns by 0.05 degrees (see `Drift`)."""

CameraPath = Callable[[float], Transform]
"""T_world_camera (4, 4), optical axes, at a share of the path, 0 to 1."""


def drifting(path: CameraPath, seconds: float, share: float, random: np.random.Generator) -> CameraPath:
    """Return the path as reported by a tracker that never recognises a place.

    path: the true one, world z up; it takes `seconds`. share: metres of error per metre travelled, in all directions;
    the heading drifts too (`YAW_DEG`), roll and pitch stay right. The first pose is true, and errors belong to
    positions on the path, not to images: they are the same for any number of frames. Raises StereovoxError if the first
    pose has no heading.
    """
    shares = np.linspace(0, 1, max(2, math.ceil(seconds / STEP_S) + 1))
    true = np.array([path(step) for step in shares.tolist()])
    T_start_world = start_frame(true[0])
    drift = Drift(share=share, yaw_deg=YAW_DEG * share, find_again_m=0)
    poses = T_start_world @ true @ OPENGL
    shift, yaw = drifted(drift, shares * seconds, poses, np.zeros(len(shares)), random)
    errors = np.column_stack([shift, yaw])

    def reported(share: float) -> Transform:
        x, y, z, turn = (np.interp(share, shares, column) for column in errors.T)
        T = T_start_world @ path(share)
        T[:3, :3] = rotation_matrix([0, turn, 0]) @ T[:3, :3]
        T[:3, 3] += x, y, z
        return inverse(T_start_world) @ T

    return reported
