# SPDX-License-Identifier: Apache-2.0
"""A recording that needs no files: a simulated D435 flies through the built-in room and along its corridor."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError, did_you_mean
from stereovox.frame import Frame, Reason
from stereovox.geometry import Transform, look_at
from stereovox.sources.base import Source
from stereovox.sources.d435 import D435, classify
from stereovox.sources.room import SHIFT, room
from stereovox.sources.scene import Scene

SCENES: dict[str, Callable[[], Scene]] = {"room": room}
FRAMES = 240
PERIOD_NS = 33_333_333
"""Time between frames: 30 Hz."""
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


class Simulation(Source):
    """Frames of a simulated D435 in a built-in scene; world z up, x forward, y left, metres.

    location: `sim:room`. Every frame can be asked for by itself and is always the same for the same `seed`.
    noise: False gives exact depth in metres (float32, inf where nothing is) without noise or holes.
    Raises SourceError for an unknown scene.
    """

    layout = "simulation (sim:room)"

    def __init__(self, location: str | Path = "sim:room", *, noise: bool = True, frames: int = FRAMES, seed: int = 0):
        scene = str(location).removeprefix("sim:")
        if scene not in SCENES:
            raise SourceError(f"{location}: no built-in scene '{scene}'{did_you_mean(scene, SCENES)}; use sim:room")
        self.name = f"sim:{scene}"
        self.device = D435()
        self.camera = self.device.camera
        self.noise, self.seed = noise, seed
        self._frames = frames

    @classmethod
    def recognises(cls, location: str | Path) -> bool:
        """Tell whether `location` names a simulation."""
        return str(location).startswith("sim:")

    @cached_property
    def scene(self) -> Scene:
        """What the camera flies through."""
        return SCENES[self.name.removeprefix("sim:")]()

    def __len__(self) -> int:
        return self._frames

    def frame(self, i: int) -> Frame:
        """Return frame `i` (negative: from the end); raises IndexError for a frame that does not exist."""
        i = range(len(self))[i]
        return self.observe(i, self.true_depth(i))

    def true_depth(self, i: int) -> NDArray[np.float32]:
        """Return the exact depth (height, width) in metres along the optical axis, inf where nothing is."""
        T = self.pose(i)
        directions = self._directions @ T[:3, :3].T.astype(np.float32)
        return self.scene.cast(T[:3, 3], directions).reshape(self.camera.height, self.camera.width)

    def observe(self, i: int, true_depth_m: NDArray[np.float32]) -> Frame:
        """Return what the camera delivers as frame `i` where `true_depth_m` is the exact depth (height, width)."""
        if self.noise:
            depth, reason = self.device.measure(true_depth_m, [self.seed, i])
            scale = 0.001
        else:
            depth, scale = true_depth_m, 1.0
            reason = classify(depth, self.device.nearest, self.device.farthest)
            depth = np.where(reason == Reason.VALID, depth, np.float32(0))
        return Frame(depth, self.camera, self.pose(i), i * PERIOD_NS, scale, reason, f"{self.name} frame {i}")

    def pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) of frame `i`; raises IndexError beyond the last."""
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name} has frames 0 to {len(self) - 1}, not {i}")
        point = self._path(i / max(len(self) - 1, 1))
        return look_at(point[:3], point[3:])

    @cached_property
    def _path(self) -> Callable[[float], NDArray[np.float64]]:
        from scipy.interpolate import CubicSpline

        return CubicSpline(np.linspace(0, 1, len(WAYPOINTS)), WAYPOINTS + np.tile(SHIFT, 2))

    @cached_property
    def _directions(self) -> NDArray[np.float32]:
        x, y = self.camera.ray_slopes()
        grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1)
        return np.ascontiguousarray(grid.reshape(-1, 3))
