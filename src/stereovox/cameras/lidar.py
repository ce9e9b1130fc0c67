# SPDX-License-Identifier: Apache-2.0
"""A lidar, or any other sensor that measures single points: its range limits and noise."""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, inf, pi, radians
from typing import ClassVar

from stereovox.errors import StereovoxError

USUAL_SIGMA_M = 0.02
"""Typical of spinning lidars (Velodyne HDL-64E, VLP-16, Ouster OS1: 2 to 3 cm)."""


@dataclass(frozen=True)
class Lidar:
    """Range limits and noise of a lidar; the same for all of its clouds.

    Attributes:
        sigma: Standard deviation of a range in metres.
        range_min: Metres below which a point is left out: the vehicle itself, or dirt on the window.
        range_max: Metres beyond which a point is no surface; its ray is then free up to there, but no nearer to
            the point than four sigma.
        baseline: None: a lidar has no stereo geometry.
        width: 1, as `height`: a lidar's share in caches that count the pixels of cameras.
        height: 1.

    Raises:
        StereovoxError: A number is out of range.
    """

    sigma: float = USUAL_SIGMA_M
    range_min: float = 0.5
    range_max: float = inf
    baseline: ClassVar[float | None] = None
    width: ClassVar[int] = 1
    height: ClassVar[int] = 1

    def __post_init__(self) -> None:
        for name in ("sigma", "range_min", "range_max"):  # NumPy's float32 cannot be saved with kept clouds
            object.__setattr__(self, name, float(getattr(self, name)))
        if not 0 < self.sigma < inf:
            raise StereovoxError(f"lidar: sigma {self.sigma:g} must be more than 0 metres")
        if not 0 <= self.range_min < self.range_max:
            raise StereovoxError(
                f"lidar: ranges from {self.range_min:g} to {self.range_max:g} m; they must rise, from 0 on"
            )


@dataclass(frozen=True)
class RangeSensor(Lidar):
    """A sensor that reports one distance, to the nearest thing in a cone: a sonar, a radar, a single wide beam.

    Attributes:
        sigma: As in `Lidar`.
        range_min: Metres below which it measures nothing.
        range_max: Metres up to which it measures.
        beam: Full width of its cone in radians.
        silence_clears: Whether its cone is free up to `range_max` if nothing is heard. Soft and oblique surfaces send
            nothing back, so by default it is not.

    Raises:
        StereovoxError: A number is out of range.
    """

    sigma: float = 0.03
    range_min: float = 0.2
    range_max: float = 4.0
    beam: float = radians(30)
    silence_clears: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "beam", float(self.beam))
        if not (0 < self.beam <= pi and self.range_max < inf):
            raise StereovoxError(
                f"range sensor: beam {self.beam:g}, range_max {self.range_max:g}: give the width of its cone in "
                "radians, up to pi, and metres"
            )

    @property
    def solid_angle(self) -> float:
        """Steradians of its cone."""
        return 2 * pi * (1 - cos(self.beam / 2))
