# SPDX-License-Identifier: Apache-2.0
"""The inverse sensor model of Valenti 2018."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox.sensors.model import Array


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
