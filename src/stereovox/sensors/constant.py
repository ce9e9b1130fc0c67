# SPDX-License-Identifier: Apache-2.0
"""The constant hit / miss model, as OctoMap has it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox.sensors.model import Array


@dataclass(frozen=True)
class Constant:
    """The measured point is occupied with `p_hit`, everything before it with `p_free`; behind it nothing is said.

    Defaults are OctoMap's (Hornung et al. 2013). Noise plays no part.
    """

    p_hit: float = 0.7
    p_free: float = 0.4
    p_unknown: float = 0.5

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return p_free before, p_hit exactly at and p_unknown behind the measurement."""
        z, z_measured, _ = np.broadcast_arrays(z, z_measured, sigma)
        return np.where(z < z_measured, self.p_free, np.where(z > z_measured, self.p_unknown, self.p_hit))
