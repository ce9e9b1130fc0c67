# SPDX-License-Identifier: Apache-2.0
"""PX4's collision prevention as its documents and source describe it, for simulated flights.

https://docs.px4.io/v1.14/en/computer_vision/collision_prevention.html, "Algorithm Description": OBSTACLE_DISTANCE is
kept in 36 sectors; speed along the stick is limited so that the vehicle stops `CP_DIST` before obstacles in any sector
of that hemisphere, `CP_DELAY` and the age of the data included; a sector without data is not flown into
(`CP_GO_NO_DATA` = 0); without any message for 0.5 s it does not move. The direction may be turned by `CP_GUIDE_ANG`.
Formulas: v1.14, src/lib/collision_prevention/CollisionPrevention.cpp, and `computeMaxSpeedFromDistance` of
src/lib/motion_planning/TrajectoryConstraints.hpp.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor, inf, sqrt

import numpy as np
from numpy.typing import NDArray

BINS, BIN_DEG = 36, 10
NO_DATA = 0xFFFF
TIMEOUT_S = 0.5


@dataclass(frozen=True)
class Parameters:
    """PX4's parameters, with its defaults except `cp_dist`, which is off by default.

    Attributes:
        cp_dist: CP_DIST, metres to keep from obstacles, measured from the sensor, here the vehicle's middle.
        cp_delay: CP_DELAY, seconds of sensor and tracking delay.
        cp_guide_ang: CP_GUIDE_ANG, degrees by which the direction may be turned.
        mpc_xy_p: MPC_XY_P, gain of the position controller.
        mpc_jerk_max: MPC_JERK_MAX, m/s^3.
        mpc_acc_hor: MPC_ACC_HOR, m/s^2.
    """

    cp_dist: float = 0.5
    cp_delay: float = 0.4
    cp_guide_ang: float = 30.0
    mpc_xy_p: float = 0.95
    mpc_jerk_max: float = 8.0
    mpc_acc_hor: float = 3.0


class CollisionPrevention:
    """PX4's sectors, and its limit on a velocity. Bearings run clockwise from the vehicle's front."""

    def __init__(self, parameters: Parameters | None = None):
        self.parameters = parameters or Parameters()
        self._cm, self._heard = np.full(BINS, NO_DATA), np.full(BINS, -inf)
        self._max_cm, self._last = 0, -inf

    def receive(self, distances_cm: NDArray[np.uint16], max_cm: int, now: float) -> None:
        """Receive OBSTACLE_DISTANCE (72,) of 5 degrees in MAV_FRAME_BODY_FRD with `min_distance` 0, at `now` seconds.

        UINT16_MAX leaves a sector unchanged. (`_addObstacleSensorData`; with one sensor `_enterData` takes all else.)
        """
        self._last, self._max_cm = now, max_cm
        for i in range(BINS):
            cm = int(distances_cm[ceil(i * BIN_DEG / 5) % 72])
            if cm != NO_DATA:
                self._cm[i], self._heard[i] = cm, now

    def limited(
        self, wanted: NDArray[np.float64], velocity: NDArray[np.float64], yaw: float, now: float
    ) -> NDArray[np.float64]:
        """Return the velocity (2,) flown when the stick commands `wanted` (2,), m/s in the world.

        velocity: (2,) of the vehicle now. yaw: radians to the left of the world's x.
        """
        speed = float(np.linalg.norm(wanted))
        if now - self._last >= TIMEOUT_S or speed < 1e-3:
            return np.zeros(2)
        self._cm[now - self._heard > TIMEOUT_S] = NO_DATA
        if (self._cm == NO_DATA).all():
            return np.zeros(2)
        towards = wanted / speed
        bearing_deg = np.degrees(yaw - np.arctan2(towards[1], towards[0])) % 360
        sector = floor(bearing_deg / BIN_DEG) % BINS
        towards, sector = self._guided(towards, sector, yaw)
        if self._cm[sector] == NO_DATA:
            return np.zeros(2)
        return towards * min(speed, self._fastest(towards, velocity, yaw, now))

    def _fastest(self, towards: NDArray[np.float64], velocity: NDArray[np.float64], yaw: float, now: float) -> float:
        """Return the largest speed along a direction (2,) allowed by all sectors."""
        p, known = self.parameters, (self._cm != NO_DATA) & (self._cm > 0)
        directions = self._directions(yaw)
        ahead = directions @ towards
        rate = np.maximum(directions @ velocity, 0)
        metres = self._cm / 100
        delay = rate * p.cp_delay + np.where(self._cm < self._max_cm, rate * np.minimum(now - self._heard, 10), 0)
        stop = np.maximum(metres - p.cp_dist - delay, 0)
        most = np.minimum(p.mpc_xy_p * stop, [max_speed(p.mpc_jerk_max, p.mpc_acc_hor, s) for s in stop])
        counts = known & (ahead > 0.01)
        return float(np.min(most[counts] / ahead[counts], initial=inf))

    def _guided(self, towards: NDArray[np.float64], sector: int, yaw: float) -> tuple[NDArray[np.float64], int]:
        """Return the direction and sector turned towards more room (`_adaptSetpointDirection`)."""
        p, best, chosen = self.parameters, inf, sector
        reach = floor(p.cp_guide_ang / BIN_DEG)
        for i in range(sector - reach, sector + reach + 1):
            near = self._cm[np.arange(i - 1, i + 2) % BINS]
            mean = float(np.where(near == NO_DATA, 100 * p.cp_dist, near).mean())
            cost = p.cp_dist * 50 * abs(i - sector) - mean - self._cm[i % BINS]
            if self._cm[i % BINS] != NO_DATA and cost < best:
                best, chosen = cost, i % BINS
        return (towards, sector) if chosen == sector else (self._directions(yaw)[chosen], chosen)

    def _directions(self, yaw: float) -> NDArray[np.float64]:
        """Return the directions (36, 2) of the sectors in the world."""
        angles = yaw - np.radians(BIN_DEG * np.arange(BINS))
        return np.column_stack([np.cos(angles), np.sin(angles)])


def max_speed(jerk: float, accel: float, metres: float) -> float:
    """Return the speed in m/s from which a vehicle can stop within `metres`."""
    b = 4 * accel * accel / jerk
    return max(0.5 * (sqrt(b * b + 8 * accel * metres) - b), 0.0)
