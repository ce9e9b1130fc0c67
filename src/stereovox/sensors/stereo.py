# SPDX-License-Identifier: Apache-2.0
"""The default model: a hit counts by the probability that it is in its cell; clearing counts less than hits."""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, exp, pi, sqrt

import numpy as np

from stereovox.errors import ConfigError
from stereovox.sensors.model import END_SIGMA, Array


@dataclass(frozen=True)
class Stereo:
    """A model of stereo's range noise and of the size of cells.

    There is no evidence within `fade` sigma of the range noise in front of the measured point; from there towards the
    camera, the evidence for free space grows as a Gaussian falls, and it is `p_free` from `END_SIGMA` on. So a surface
    measured too far does not clear itself, nor does a pole that the camera cannot separate from the wall behind it.
    Behind the point there is no evidence either, so walls do not grow thick (the weakness of Valenti 2018, section
    8.4).

    The cell that holds the measured point is occupied with the probability that the point is right (`p_right`) and that
    its noise leaves it in this cell, but at least with `p_least`. This becomes evidence relative to `prior`.

    A cell that a ray passes through loses at most the share `passes` of what a hit at its depth would give: most frames
    see only what is behind a pole thinner than a pixel, and must not outvote the frames that do see it.
    """

    p_right: float = 0.95
    prior: float = 0.1
    p_free: float = 0.3
    p_unknown: float = 0.5
    p_least: float = 0.8
    fade: float = 2.0
    passes: float = 0.5

    def __post_init__(self) -> None:
        if not self.fade < END_SIGMA:
            raise ConfigError(f"sensor.fade {self.fade:g}: must be less than {END_SIGMA:.2f}, where the table ends")

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return p_free up to `END_SIGMA` in front of the measurement, rising to p_unknown at `fade` sigma from it."""
        t = np.minimum((np.asarray(z) - z_measured) / sigma + self.fade, 0.0)
        end = exp(-0.5 * (END_SIGMA - self.fade) ** 2)
        rise = (np.exp(-0.5 * t * t) - end) / (1 - end)
        before = self.p_free + (self.p_unknown - self.p_free) * np.maximum(rise, 0)
        return np.where(t < 0, before, self.p_unknown)

    def hit(self, z_measured: Array, sigma: Array, voxel_size: float) -> Array:
        """Return the probability of the cell that holds the measured point, at even prior odds; at least p_least."""
        p = self.p_right * stays(np.asarray(sigma) / voxel_size)
        odds = p / (1 - p) * (1 - self.prior) / self.prior
        return np.maximum(odds / (1 + odds), self.p_least)

    def passed(self, z: Array, sigma: Array, voxel_size: float) -> Array:
        """Return the lowest probability of a cell at depth `z` that a ray passes through, at even prior odds."""
        hit = self.hit(z, sigma, voxel_size)
        return 1 / (1 + (hit / (1 - hit)) ** self.passes)


def stays(ratio: Array) -> Array:
    """Return the probability that noise of `ratio` cells leaves a point in its cell, averaged over the cell.

    The mean of Phi((1 - x) / r) - Phi(-x / r) over x from 0 to 1.
    """
    return np.array([erf(1 / (r * sqrt(2))) - r * sqrt(2 / pi) * (1 - exp(-0.5 / (r * r))) for r in ratio.tolist()])
