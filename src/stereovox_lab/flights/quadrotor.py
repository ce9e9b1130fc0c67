# SPDX-License-Identifier: Apache-2.0
"""A quadrotor that follows velocities: it accelerates by tilting, and tilts with a delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform

GRAVITY = 9.81


@dataclass(frozen=True)
class Airframe:
    """Dynamics of a quadrotor.

    Attributes:
        radius: Metres from its middle to the end of its propellers.
        max_accel: Largest horizontal acceleration in m/s^2.
        velocity_s: Time constant of the velocity controller.
        tilt_s: Time constant of the tilt.
        max_climb: Largest vertical speed in m/s.
    """

    radius: float = 0.25
    max_accel: float = 3.0
    velocity_s: float = 0.35
    tilt_s: float = 0.12
    max_climb: float = 0.5


class Quadrotor:
    """The state of a quadrotor in a world with z up.

    Attributes:
        position: (3,) metres.
        velocity: (3,) m/s.
        yaw: Radians to the left of x.
    """

    def __init__(self, position: NDArray[np.float64], yaw: float, frame: Airframe | None = None):
        self.frame = frame or Airframe()
        self.position, self.velocity = np.array(position, float), np.zeros(3)
        self.yaw, self._accel = yaw, np.zeros(2)

    def step(self, velocity: NDArray[np.float64], height: float, yaw_rate: float, seconds: float) -> None:
        """Advance by one step.

        velocity: (2,) m/s, x and y of the world, the target. height: target in metres. yaw_rate:
        radians a second to the left. seconds: a few hundredths at most.
        """
        frame = self.frame
        wanted = (velocity - self.velocity[:2]) / frame.velocity_s
        wanted *= min(1.0, frame.max_accel / max(float(np.linalg.norm(wanted)), 1e-9))
        self._accel += (wanted - self._accel) * min(seconds / frame.tilt_s, 1.0)
        self.velocity[:2] += self._accel * seconds
        self.velocity[2] = np.clip(2 * (height - self.position[2]), -frame.max_climb, frame.max_climb)
        self.position += self.velocity * seconds
        self.yaw += yaw_rate * seconds

    @property
    def T_world_body(self) -> Transform:  # noqa: N802 - its name elsewhere
        """(4, 4) maps the body (optical: x right, y down, z forward) into the world; it leans as it accelerates."""
        up = np.array([*self._accel, GRAVITY])
        up /= np.linalg.norm(up)
        ahead = np.array([np.cos(self.yaw), np.sin(self.yaw), 0.0])
        right = np.cross(ahead, up)
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([right, -up, np.cross(up, right)])
        T[:3, 3] = self.position
        return T
