# SPDX-License-Identifier: Apache-2.0
"""Drift of the frames' poses over a path, and motions between poses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config.robot import LoopsConfig
from stereovox.geometry.se3 import Transform, inverse, rotation_matrix, rotation_vector

KEEPS_M = 5.0
"""Metres of path over which drift keeps its direction; beyond, it grows with the square root of the path."""
JITTER_RAD, JITTER_M = np.radians(0.1), 0.003
"""Standard deviations of a pose besides drift."""
TURNED = 0.01
"""Relative error of a turn."""
GATE = 22.5
"""Squared deviations, of six, by which a motion may be off: 99.9 % of right ones are within (chi-squared)."""


class Drift(NamedTuple):
    """Drift of a recording's poses.

    share: metres per metre of path, along each axis. turn: radians after a metre, about each axis.
    """

    share: float
    turn: float

    @classmethod
    def of(cls, config: LoopsConfig) -> Drift:
        """Return the drift allowed by the settings."""
        return cls(config.drift, float(np.radians(config.drift_deg)))

    def covariance(self, metres: float, radians: float = 0.0) -> NDArray[np.float64]:
        """Return the covariance (6, 6), rotation and shift, of a motion of `metres` and `radians` in total."""
        turned = JITTER_RAD**2 + self.turn**2 * metres + (TURNED * radians) ** 2
        return np.diag(np.repeat([turned, JITTER_M**2 + self.shift_m(metres) ** 2], 3))

    def shift_m(self, metres: float) -> float:
        """Return the standard deviation of a position, along each axis, after `metres` of path."""
        return self.share * float(np.sqrt(KEEPS_M * metres))


class PathLength:
    """The path of a body so far, by the frames of all its sensors.

    Switching sensors adds no path: each continues from its own last frame.
    """

    def __init__(self) -> None:
        self._last = dict[str, Transform]()
        self._so_far = dict[str, NDArray[np.float64]]()

    def add(self, sensor: str, T_world_sensor: Transform) -> tuple[float, float]:
        """Add the next frame's pose (4, 4); return metres and radians of the path so far."""
        move = inverse(self._last.get(sensor, T_world_sensor)) @ T_world_sensor
        step = np.array([np.linalg.norm(move[:3, 3]), np.linalg.norm(rotation_vector(move[:3, :3]))])
        own = self._so_far.get(sensor, np.zeros(2)) + step
        so_far = np.maximum.reduce([own, *self._so_far.values()])
        self._last[sensor], self._so_far[sensor] = T_world_sensor, so_far
        return float(so_far[0]), float(so_far[1])


def difference(one: Transform, other: Transform) -> NDArray[np.float64]:
    """Return the motion (6,) from one pose to another in its own axes: rotation in radians, shift in metres."""
    R = one[:3, :3].T
    return np.concatenate([rotation_vector(R @ other[:3, :3]), R @ (other[:3, 3] - one[:3, 3])])


def moved_by(one: Transform, motion: NDArray[np.float64]) -> Transform:
    """Return the pose (4, 4) reached from another by a motion (6,): the inverse of `difference`."""
    other = one.copy()
    other[:3, :3] = one[:3, :3] @ rotation_matrix(motion[:3])
    other[:3, 3] += one[:3, :3] @ motion[3:]
    return other


def squared(motion: NDArray[np.float64], covariance: NDArray[np.float64]) -> float:
    """Return a motion (6,) in squared deviations."""
    return float(motion @ np.linalg.solve(covariance, motion))
