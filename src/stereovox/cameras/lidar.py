# SPDX-License-Identifier: Apache-2.0
"""A lidar, or any other sensor that measures single points: its range limits and noise."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf
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
