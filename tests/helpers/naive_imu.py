# SPDX-License-Identifier: Apache-2.0
"""What an IMU on a known path feels, and how it turned: slow and obvious, with SciPy's rotations."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

GRAVITY = np.array([0.0, 0.0, -9.81])


def felt_along(stamps_ns, poses, hz=200.0, before_s=0.0):
    """Return times in ns, true angular rates and specific forces (N, 3) in the axes of a body at T_world_body, z up.

    The body moves smoothly through its poses (N, 4, 4) at `stamps_ns`, and stands still for `before_s` before them.
    """
    poses = np.asarray(poses)
    seconds = (np.asarray(stamps_ns) - stamps_ns[0]) / 1e9
    turns, places = (
        RotationSpline(seconds, Rotation.from_matrix(poses[:, :3, :3])),
        CubicSpline(seconds, poses[:, :3, 3]),
    )
    at = np.arange(-before_s, seconds[-1], 1 / hz)
    moving = (at >= 0)[:, None]
    inside = np.maximum(at, 0)
    rate = np.where(moving, turns(inside, 1), 0.0)
    force = turns(inside).inv().apply(np.where(moving, places(inside, 2), 0.0) - GRAVITY)
    return stamps_ns[0] + np.round(at * 1e9).astype(np.int64), rate, force


def turned(stamps_ns, rates, begin_ns, end_ns, bias, steps=2000):
    """Return R_begin_end as a Rotation: rates on straight lines between readings, in many small steps."""
    at = np.linspace(begin_ns, end_ns, steps + 1)
    dt = (end_ns - begin_ns) / 1e9 / steps
    found = Rotation.identity()
    for middle in (at[1:] + at[:-1]) / 2:
        rate = [np.interp(middle, stamps_ns, column) for column in np.transpose(rates)]
        found = found * Rotation.from_rotvec((np.array(rate) - bias) * dt)
    return found
