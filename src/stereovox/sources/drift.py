# SPDX-License-Identifier: Apache-2.0
"""How a visual-inertial tracker loses its way, and finds it again where it has been before."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

STEP_S = 0.05
"""Drift is slow: it is worked out so often and interpolated."""
WALK_M = 5.0
"""Metres over which the drift keeps its direction: over shorter ways it grows with the way, then with its root."""
ALIKE = 0.5
"""A place is known again where the camera looks the same way within 60 degrees (cosine)."""
SPACING_M = 0.3
"""A place is remembered every so many metres."""


@dataclass(frozen=True)
class Drift:
    """Drift and re-localisation of a tracker.

    share: error per metre of way, in all directions (0.01 is a good tracker's); yaw_deg: drift of the heading over
        one metre, in degrees; it grows with the root of the way. Gravity keeps roll and pitch right.
    find_again_m: a place seen before is known again from so far away (0: never), if the way since is longer than
        `loop_m`; pull_s: time in which two thirds of the error since then are taken back. Chien 2020, 2.2.3: the pose
        "will become more precise upon further visits to the same area".
    """

    share: float = 0.01
    yaw_deg: float = 0.05
    find_again_m: float = 0.8
    loop_m: float = 5.0
    pull_s: float = 0.7


@dataclass
class _Places:
    """What the tracker remembers: where it was, how it looked, after which way, and its errors there."""

    where: list[NDArray[np.float64]] = field(default_factory=list)
    ahead: list[NDArray[np.float64]] = field(default_factory=list)
    way: list[float] = field(default_factory=list)
    error: list[NDArray[np.float64]] = field(default_factory=list)

    def remember(self, T: NDArray[np.float64], way: float, error: NDArray[np.float64]) -> None:
        if not self.way or way - self.way[-1] >= SPACING_M:
            self.where.append(T[:3, 3])
            self.ahead.append(-T[:3, 2])
            self.way.append(way)
            self.error.append(error)

    def find(self, T: NDArray[np.float64], way: float, drift: Drift) -> NDArray[np.float64] | None:
        """Return the errors at the earliest place known again, else None."""
        old = int(np.searchsorted(self.way, way - drift.loop_m))
        if not old:
            return None
        near = np.linalg.norm(np.array(self.where[:old]) - T[:3, 3], axis=1) < drift.find_again_m
        known = near & (np.array(self.ahead[:old]) @ -T[:3, 2] > ALIKE)
        return self.error[int(np.argmax(known))] if known.any() else None


def drifted(
    drift: Drift,
    seconds: NDArray[np.float64],
    poses: NDArray[np.float64],
    jumps_m: NDArray[np.float64],
    random: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the errors of position (N, 3) in metres and of heading (N,) in radians about y.

    seconds: (N,). poses: (N, 4, 4) in OpenGL axes, y up. jumps_m: (N,) sudden sideways errors.
    """
    steps = np.unique(np.append(np.arange(0, len(seconds), _stride(seconds)), len(seconds) - 1))
    coarse = _walk(drift, seconds[steps], poses[steps], _sudden(jumps_m, steps), random)
    fine = np.stack([np.interp(seconds, seconds[steps], column) for column in coarse.T], axis=1)
    for k in np.flatnonzero(jumps_m):  # interpolation would make a ramp of it
        after = int(np.searchsorted(steps, k))
        between = np.arange(steps[max(after - 1, 0)], steps[after])
        fine[between] = np.where((between < k)[:, None], coarse[max(after - 1, 0)], coarse[after])
    return fine[:, :3], fine[:, 3]


def _stride(seconds: NDArray[np.float64]) -> int:
    return max(1, round(STEP_S / float(np.median(np.diff(seconds)))))


def _sudden(jumps_m: NDArray[np.float64], steps: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the jumps (S,) between each step and the one before."""
    total = np.cumsum(jumps_m)[steps]
    return np.diff(total, prepend=0.0)


def _walk(
    drift: Drift,
    seconds: NDArray[np.float64],
    poses: NDArray[np.float64],
    jumps_m: NDArray[np.float64],
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the errors (S, 4): x, y, z and heading, step by step."""
    places, error, way = _Places(), np.zeros(4), 0.0
    course = random.standard_normal(3) / np.sqrt(3)
    errors = [error]
    places.remember(poses[0], way, error)
    for k in range(1, len(poses)):
        move = poses[k, :3, 3] - poses[k - 1, :3, 3]
        length = float(np.linalg.norm(move))
        way += length
        keep = np.exp(-length / WALK_M)
        course = keep * course + np.sqrt((1 - keep**2) / 3) * random.standard_normal(3)
        error = error + _step(drift, error[3], move, length, course, random)
        error[0] += jumps_m[k]
        found = places.find(poses[k], way, drift)
        if found is not None:
            error = error + (found - error) * (1 - np.exp((seconds[k - 1] - seconds[k]) / drift.pull_s))
        else:
            places.remember(poses[k], way, error)
        errors.append(error)
    return np.array(errors)


def _step(
    drift: Drift,
    yaw: float,
    move: NDArray[np.float64],
    length: float,
    course: NDArray[np.float64],
    random: np.random.Generator,
) -> NDArray[np.float64]:
    """Return what one step adds to the errors (4,): a wrong heading also sends the position astray."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    astray = [(cosine - 1) * move[0] + sine * move[2], 0.0, (cosine - 1) * move[2] - sine * move[0]]
    turn = np.radians(drift.yaw_deg) * np.sqrt(length) * random.standard_normal()
    return np.append(drift.share * length * course + astray, turn)
