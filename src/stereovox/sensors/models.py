# SPDX-License-Identifier: Apache-2.0
"""The inverse sensor models: the default, Andert's (Chien 2020), Valenti's (2018), OctoMap's constants, and a cone's.

The default counts a hit by the probability that it is in its cell, and clears less than it marks.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, exp, pi, sqrt

import numpy as np

from stereovox.errors import ConfigError
from stereovox.sensors.protocol import END_SIGMA, Array


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


@dataclass(frozen=True)
class Andert:
    """A Gaussian on a step (Andert 2009; Chien 2020, Eq 3.3 and 3.4).

    `k` in metres sets the height of the peak: k / (sigma sqrt(2 pi)) above one half. `p_max` clamps it strictly below
    one (Eq 3.3 prints "<= 1", which makes the log-odds infinite).
    """

    k: float = 0.02
    p_free: float = 0.3
    p_max: float = 0.95

    @property
    def p_unknown(self) -> float:
        """Chien 2020, Eq 3.4: one half behind the measurement."""
        return 0.5

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return Chien 2020, Eq 3.3, clamped at p_max."""
        before = np.asarray(z) <= z_measured
        p_occ = np.where(before, self.p_free, 0.5)
        height = self.k / (sigma * np.sqrt(2 * np.pi)) + 0.5 - p_occ
        bell = np.exp(-0.5 * ((z - z_measured) / sigma) ** 2)
        return np.minimum(p_occ + height * bell, self.p_max)


@dataclass(frozen=True)
class Valenti:
    """Two half Gaussians that meet at the measurement (Valenti 2018, Eq 6.4 to 6.6).

    `sigma` is the thesis's dz; for a pinhole camera Eq 6.9 gives it: z^2 / (B f) * disparity noise, which is
    `RangeNoise.of(...)`. `k` (0 to 1) is the weight of a measurement.
    """

    k: float = 0.75
    p_free: float = 0.3
    p_unknown: float = 0.5

    def peak(self, sigma: Array) -> Array:
        """Return a, the height of the peak over p_unknown (Valenti 2018, Eq 6.5; sigma in metres)."""
        return self.k * (1 - self.p_unknown) * np.exp(-np.asarray(sigma))

    def tail(self, sigma: Array) -> Array:
        """Return c, the width in metres behind the measurement (Valenti 2018, Eq 6.6).

        Printed for p_unknown = 0.5; in general the two half-height widths agree when
        c = dz sqrt(ln(1 + a / (a + 2 p_unknown - 2 p_free)) / ln 2).
        """
        a = self.peak(sigma)
        return sigma * np.sqrt(np.log1p(a / (a + 2 * self.p_unknown - 2 * self.p_free)) / np.log(2))

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return Valenti 2018, Eq 6.4."""
        offset = np.asarray(z) - z_measured
        a = self.peak(sigma)
        before = self.p_free + (a + self.p_unknown - self.p_free) * np.exp(-0.5 * (offset / sigma) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):  # a very large sigma leaves no tail
            behind = self.p_unknown + a * np.exp(-0.5 * (offset / self.tail(sigma)) ** 2)
        return np.where(offset <= 0, before, behind)


@dataclass(frozen=True)
class Constant:
    """`p_hit` at the measured point, `p_free` before it, `p_unknown` behind it, whatever the noise.

    Defaults are OctoMap's (Hornung et al. 2013).
    """

    p_hit: float = 0.7
    p_free: float = 0.4
    p_unknown: float = 0.5

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return p_free before, p_hit exactly at and p_unknown behind the measurement."""
        z, z_measured, _ = np.broadcast_arrays(z, z_measured, sigma)
        return np.where(z < z_measured, self.p_free, np.where(z > z_measured, self.p_unknown, self.p_hit))


LEAST = 0.001
"""Least evidence of a cell of the arc, as log-odds: what a map can keep."""


@dataclass(frozen=True)
class Arc:
    """Moravec and Elfes 1985 (High resolution maps from wide angle sonar), in the log-odds of the model `stereo`.

    One thing in the cone sent the echo. Their occupied probabilities over the arc sum to one, and are added to a
    cell's own as p + q - p q; here all n cells of the arc have the same share of `p_right`, so q = p_right / n. A
    share `trust` of that evidence, relative to `prior`, counts. The cells before it are free as far as `stereo` lets
    them be, by less evidence than a pixel of a camera gives, since soft and oblique things send nothing back.

    solid_angle: steradians of the cone.
    """

    solid_angle: float
    p_right: float = 0.9
    prior: float = 0.1
    trust: float = 0.8
    p_free: float = 0.345
    p_unknown: float = 0.5

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return as `Stereo.probability`."""
        return Stereo(p_free=self.p_free, p_unknown=self.p_unknown).probability(z, z_measured, sigma)

    def hit(self, z_measured: Array, sigma: Array, voxel_size: float) -> Array:
        """Return the probability of each cell of the arc, at even prior odds."""
        cells = np.maximum(self.solid_angle * (np.asarray(z_measured) / voxel_size) ** 2, 1.0)
        return self.shared(cells, np.asarray(sigma) / voxel_size)

    def shared(self, cells: Array, sigma: Array) -> Array:
        """Return the same for an arc of so many cells, and noise in cells."""
        q = self.p_right * stays(sigma) / cells
        p = self.prior + q - self.prior * q
        evidence = self.trust * (np.log(p / (1 - p)) - np.log(self.prior / (1 - self.prior)))
        return 1 / (1 + np.exp(-np.maximum(evidence, LEAST)))
