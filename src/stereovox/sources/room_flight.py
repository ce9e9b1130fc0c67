# SPDX-License-Identifier: Apache-2.0
"""`sim:room`: the way of the demo's camera through the furnished room and along its corridor."""

from __future__ import annotations

import numpy as np

from stereovox.geometry import Transform, look_at
from stereovox.sources.room import SHIFT, room
from stereovox.sources.stage import Stage

FRAMES = 240
WAYPOINTS = np.array([
    # eye x, y, z         looks at x, y, z
    [4.90, -1.55, 1.30, 2.20, -2.40, 0.50],
    [4.30, -1.30, 1.30, 0.60, -2.00, 0.55],
    [3.50, -0.95, 1.32, 0.40, -0.60, 0.60],
    [2.70, -0.75, 1.34, 0.20, 0.80, 0.80],
    [1.90, -0.75, 1.34, 0.60, 2.00, 0.95],
    [1.30, -0.65, 1.34, 1.90, 2.60, 0.95],
    [1.10, -0.35, 1.34, 3.00, 2.20, 0.65],
    [1.30, -0.55, 1.34, 3.90, 1.00, 0.55],
    [1.90, -0.85, 1.34, 4.60, -1.20, 0.50],
    [2.60, -0.95, 1.36, 5.30, -1.90, 0.70],
    [3.30, -0.75, 1.40, 6.00, -0.20, 0.85],
    [3.90, -0.40, 1.42, 5.10, 2.00, 0.95],
    [4.50, 0.10, 1.40, 6.20, 2.00, 1.10],
    [5.20, 0.55, 1.34, 8.00, 0.30, 1.20],
    [5.90, 0.60, 1.30, 9.00, 0.60, 1.20],
    [6.90, 0.62, 1.30, 10.00, 0.20, 1.10],
    [8.00, 0.75, 1.32, 10.80, -0.10, 1.05],
    [9.20, 0.85, 1.34, 11.90, 0.60, 1.15],
    [10.40, 0.85, 1.34, 13.00, 1.20, 1.20],
    [11.60, 0.70, 1.32, 14.30, 0.60, 1.50],
    [12.90, 0.55, 1.30, 15.80, 0.20, 1.30],
    [14.30, 0.50, 1.28, 17.20, 0.80, 0.90],
    [15.60, 0.55, 1.28, 18.40, 0.60, 1.00],
])  # fmt: skip
"""Plan coordinates in metres, at equal steps of time; the path runs smoothly through them."""


def stage() -> Stage:
    """Return the demo's stage: room and corridor, 8 s at 30 Hz."""
    from scipy.interpolate import CubicSpline

    way = CubicSpline(np.linspace(0, 1, len(WAYPOINTS)), WAYPOINTS + np.tile(SHIFT, 2))

    def path(share: float) -> Transform:
        point = way(share)
        return look_at(point[:3], point[3:])

    return Stage(room, path, FRAMES)
