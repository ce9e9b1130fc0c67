# SPDX-License-Identifier: Apache-2.0
"""The constant hit / miss model of OctoMap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox.sensors.model import Array


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
