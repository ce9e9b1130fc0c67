# SPDX-License-Identifier: Apache-2.0
"""A second odometry, such as wheel odometry, next to the frames' own poses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.config.robot import LoopsConfig
from stereovox.correct.loops.drift import GATE, Drift, difference, moved_by, squared
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.poses.poses import Poses

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
