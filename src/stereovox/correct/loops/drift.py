# SPDX-License-Identifier: Apache-2.0
"""Drift of the frames' poses over a path, and motions between poses.

A second odometry, such as wheel odometry, next to the frames' own poses. Drift-free positions of a camera, as of a GNSS
receiver.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config.robot import LoopsConfig
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.geometry.se3 import Transform, inverse, rotation_matrix, rotation_vector
from stereovox.sources.poses.poses import Poses

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


MAX_OFF_M = 100.0
"""Cap in metres on a contradiction: there nothing constrains the step, and the system is still solvable."""


class Odometry:
    """Poses (T_any_camera) of a second odometry.

    Args:
        poses: In any world, of the camera.
        config: Settings, with their drift.

    Attributes:
        used: Steps to which it contributed.
        contradicted: Steps on which it contradicts the frames' poses, so that neither is trusted.
    """

    def __init__(self, poses: Poses, config: LoopsConfig):
        self._poses, self._drift = poses, Drift(config.odometry_drift, float(np.radians(config.odometry_drift_deg)))
        self.where, self.used, self.contradicted = poses.where, 0, 0

    def joined(
        self, stamps_ns: tuple[int, int], motion: Transform, covariance: NDArray[np.float64], way: tuple[float, float]
    ) -> tuple[Transform, NDArray[np.float64]]:
        """Return the motion between two times that best explains both odometries, and its covariance.

        Args:
            stamps_ns: The times.
            motion: (4, 4) by the frames' poses.
            covariance: (6, 6) of that.
            way: Its length in metres and radians.

        Returns:
            (4, 4) and (6, 6): as given if this odometry has no pose near one of the times; if the two contradict each
                other, as given, but with their difference as uncertainty.
        """
        try:
            first, second = (self._poses.at(stamp_ns) for stamp_ns in stamps_ns)
        except FrameRefused:
            return motion, covariance
        moved = difference(motion, inverse(first) @ second)
        together = covariance + self._drift.covariance(*way)
        if squared(moved, together) > GATE:
            self.contradicted += 1
            moved[3:] *= min(1.0, MAX_OFF_M / max(float(np.linalg.norm(moved[3:])), MAX_OFF_M))
            return motion, covariance + np.outer(moved, moved)
        self.used += 1
        gain = np.linalg.solve(together, covariance).T
        return moved_by(motion, gain @ moved), covariance - gain @ covariance

    def check(self) -> None:
        """Raise StereovoxError if it never helped, or is of another trajectory or in another unit."""
        steps = self.used + self.contradicted
        if not steps:
            raise StereovoxError(
                f"{self.where}: has no poses at the times of the map's frames; give those of this path"
            )
        if self.contradicted > self.used:
            raise StereovoxError(
                f"{self.where}: contradicts the map's poses in {self.contradicted} of {steps} steps between places; "
                "give poses of the camera, in metres, of this path, or say how far they drift (loops.odometry_drift)"
            )

    def summary(self) -> dict[str, int]:
        """Return its numbers for programs."""
        return {"used": self.used, "contradicted": self.contradicted}


MAX_GAP_NS = 2_000_000_000
"""Positions farther apart in time are not interpolated."""
ROUNDS = 20
"""Rounds of reweighting, in case some positions are wrong."""
LEAST, WIDE = 3, 5.0
"""Fewest positions, and their least extent in deviations, to align the worlds."""
AWAY = 4.0
"""Largest deviations of a correct place: 99.9 % are within (chi-squared, three axes)."""


@dataclass(eq=False)
class Positions:
    """A camera's positions at some times in their own world, in metres, with the map's up direction.

    Attributes:
        stamps_ns: (N,) int64, ascending.
        places: (N, 3) float64 metres.
        sigma_m: Standard deviation along each axis, in metres.
        where: Name, for messages.
        used: Places of the trajectory that agree with these in the end.
        contradicted: Places that do not.
    """

    stamps_ns: NDArray[np.int64]
    places: NDArray[np.float64]
    sigma_m: float
    where: str = "positions"
    used: int = field(default=0, init=False)
    contradicted: int = field(default=0, init=False)

    def at(self, stamps_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return places (M, 3) at other times, interpolated; NaN if none is near enough."""
        if not len(self.stamps_ns):
            return np.full((len(stamps_ns), 3), np.nan)
        after = np.searchsorted(self.stamps_ns, stamps_ns)
        one, other = np.maximum(after - 1, 0), np.minimum(after, len(self.stamps_ns) - 1)
        found = np.stack([np.interp(stamps_ns, self.stamps_ns, axis) for axis in self.places.T], axis=1)
        beside = (self.stamps_ns[one] <= stamps_ns) & (stamps_ns <= self.stamps_ns[other])
        near = self.stamps_ns[other] - self.stamps_ns[one] <= MAX_GAP_NS
        exact = self.stamps_ns[other] == stamps_ns
        found[~((beside & near) | exact)] = np.nan
        return found

    def check(self, stamps_ns: NDArray[np.int64]) -> None:
        """Raise StereovoxError if too few places at these times are known, or they are too close together, to align
        them with a map.
        """
        self._check(self.at(stamps_ns))

    def in_map(
        self, found: NDArray[np.float64], anchors: NDArray[np.float64], R_level_map: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return places (M, 3) turned about the vertical and shifted for the best fit.

        Args:
            found: (M, 3) places, NaN if missing.
            anchors: (M, 3) the map's positions of them.
            R_level_map: (3, 3) turns the map so that z points up.

        Raises:
            StereovoxError: There are too few, or they are too close to each other.
        """
        self._check(found)
        there = np.isfinite(found).all(axis=1)
        a, b = (points[there] @ R_level_map.T for points in (found, anchors))
        R, shift = _laid(a, b, np.ones(len(a)))
        for _ in range(ROUNDS):
            away = np.linalg.norm(a @ R.T + shift - b, axis=1)
            R, shift = _laid(a, b, 1 / (1 + (away / max(float(np.median(away)), self.sigma_m)) ** 2))  # Cauchy
        return (found @ R_level_map.T @ R.T + shift) @ R_level_map

    def compare(self, found: NDArray[np.float64], places: NDArray[np.float64]) -> None:
        """Count the places (M, 3) of the trajectory that agree with these: (M, 3) in the map, NaN if missing."""
        off_m = np.linalg.norm(found - places, axis=1)
        self.used = int(np.count_nonzero(off_m <= AWAY * self.sigma_m))
        self.contradicted = int(np.count_nonzero(off_m > AWAY * self.sigma_m))

    def check_used(self) -> None:
        """Raise StereovoxError if they are of another trajectory or in another unit."""
        if self.contradicted > self.used:
            raise StereovoxError(
                f"{self.where}: contradicts the path in {self.contradicted} of {self.contradicted + self.used} places; "
                "give positions of the camera, in metres, of this path, or say how uncertain they are "
                "(--positions-sigma) or how far its poses drift (loops.drift)"
            )

    def summary(self) -> dict[str, int]:
        """Return its numbers for programs."""
        return {"used": self.used, "contradicted": self.contradicted}

    def _check(self, found: NDArray[np.float64]) -> None:
        """Raise StereovoxError if places (M, 3), NaN if missing, are too few or too close to each other."""
        known = found[np.isfinite(found).all(axis=1)]
        span = float(np.ptp(known, axis=0).max()) if len(known) else 0.0
        if len(known) < LEAST or span < WIDE * self.sigma_m:
            raise StereovoxError(
                f"{self.where}: {len(known)} places of the path have a position, {span:.1f} m apart; {LEAST} and "
                f"{WIDE * self.sigma_m:.1f} m are needed to know how they lie in the map"
            )


def _laid(
    a: NDArray[np.float64], b: NDArray[np.float64], weights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the turn (3, 3) about z and the shift (3,) that align points (N, 3) with others, by least squares."""
    middle_a, middle_b = (np.average(points, axis=0, weights=weights) for points in (a, b))
    (ax, ay), (bx, by) = (a - middle_a)[:, :2].T, (b - middle_b)[:, :2].T
    turn = np.arctan2((weights * (ax * by - ay * bx)).sum(), (weights * (ax * bx + ay * by)).sum())
    R = np.array(rotation_matrix([0, 0, turn]))
    return R, middle_b - R @ middle_a
