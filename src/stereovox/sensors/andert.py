# SPDX-License-Identifier: Apache-2.0
"""Andert's inverse sensor model as Chien 2020 uses it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox.sensors.model import Array


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
