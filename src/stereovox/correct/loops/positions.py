# SPDX-License-Identifier: Apache-2.0
"""Drift-free positions of a camera, as of a GNSS receiver."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix

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
