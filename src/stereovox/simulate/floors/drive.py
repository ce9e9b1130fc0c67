# SPDX-License-Identifier: Apache-2.0
"""The drive of a differential-drive robot past a list of stops, and an error model of its odometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se2 import Pose, compose, relative, wrapped

STEP_NS = 20_000_000
"""Time between two poses of a drive."""
TURN = 0.8
"""Fastest turn in rad/s."""
STRAIGHT = 0.6
"""A robot whose next stop is at a larger angle (radians) first turns on the spot."""
NEAR = 0.1
"""Metres from a stop at which it counts as reached."""


class Stop(NamedTuple):
    """A place on the path in metres, and the degrees by which the robot turns there on the spot (left is positive)."""

    x: float
    y: float
    spin_deg: float = 0.0


@dataclass(frozen=True)
class Odometry:
    """Errors of a robot's odometry; by default those of an uncalibrated Pioneer.

    distance, turn: relative errors of distances and turns; veer: radians per metre by which it seems to turn left while
    it drives straight (unequal wheels). Standard deviations: distance_noise metres per metre travelled,
    turn_noise radians per radian of turning, veer_noise radians per metre; all grow with the square root.
    """

    distance: float = 0.02
    turn: float = -0.02
    veer: float = 0.004
    distance_noise: float = 0.01
    turn_noise: float = 0.02
    veer_noise: float = 0.01

    def measured(self, poses: Pose, seed: int | list[int], drift: float = 1.0) -> Pose:
        """Return the odometry's poses (N, 3) for true poses (N, 3), in the frame of the first one.

        drift: factor on all errors.
        """
        random = np.random.default_rng(seed)
        step = relative(poses[:-1], poses[1:])
        way, turned = np.hypot(step[:, 0], step[:, 1]), np.abs(step[:, 2])
        noise = random.standard_normal((3, len(step)))
        share = drift * (self.distance * way + self.distance_noise * np.sqrt(way) * noise[0])
        step[:, :2] *= (1 + share / np.maximum(way, 1e-12))[:, None]
        step[:, 2] += drift * (
            self.turn * step[:, 2]
            + self.veer * way
            + self.turn_noise * np.sqrt(turned) * noise[1]
            + self.veer_noise * np.sqrt(way) * noise[2]
        )
        return _chained(step)


def drive(stops: Sequence[Stop], speed: float) -> Pose:
    """Return the poses (N, 3), one per `STEP_NS`, of a robot that drives from the first stop past all others.

    It first faces the second stop. speed: m/s on straight lines.
    """
    dt = STEP_NS / 1e9
    x, y = stops[0][:2]
    yaw = float(np.arctan2(stops[1].y - y, stops[1].x - x))
    poses = [(x, y, yaw)]
    for stop in stops:
        while np.hypot(stop.x - x, stop.y - y) > NEAR:
            aside = float(wrapped(np.arctan2(stop.y - y, stop.x - x) - yaw))
            ahead = speed * dt * max(0.0, 1 - abs(aside) / STRAIGHT)
            turn = float(np.clip(3 * aside, -TURN, TURN)) * dt
            x, y, yaw = x + ahead * np.cos(yaw + turn / 2), y + ahead * np.sin(yaw + turn / 2), yaw + turn
            poses.append((x, y, yaw))
        turns = round(abs(np.radians(stop.spin_deg)) / (TURN * dt))
        for _ in range(turns):
            yaw += np.radians(stop.spin_deg) / turns
            poses.append((x, y, yaw))
    found = np.array(poses)
    found[:, 2] = wrapped(found[:, 2])
    return found


def zigzag(start: tuple[float, float], end: tuple[float, float], aside: float, pitch: float = 1.6) -> list[Stop]:
    """Return stops from one place to another, alternately `aside` metres to the left and the right (IST 2019,
    III-D)."""
    along = np.subtract(end, start)
    length = float(np.hypot(*along))
    count = max(1, round(length / pitch))
    left = np.array([-along[1], along[0]]) / length
    middle = [np.asarray(start) + along * n / count for n in range(count + 1)]
    sides = [0.0, *((-1) ** n * aside for n in range(count - 1)), 0.0]
    return [Stop(*(place + side * left)) for place, side in zip(middle, sides, strict=True)]


def metres(poses: Pose) -> NDArray[np.float64]:
    """Return the distance travelled at each pose, (N,)."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])


def _chained(steps: Pose) -> Pose:
    """Return the poses (N + 1, 3) after each of the steps (N, 3) from the origin."""
    yaw = np.concatenate([[0.0], np.cumsum(steps[:, 2])])
    moves = compose(np.column_stack([np.zeros((len(steps), 2)), yaw[:-1]]), steps)[:, :2]
    return np.column_stack([np.vstack([np.zeros(2), np.cumsum(moves, axis=0)]), wrapped(yaw)])
