# SPDX-License-Identifier: Apache-2.0
"""The model of a sensor with a cone: something is at the measured distance, somewhere on an arc."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox.sensors.model import Array
from stereovox.sensors.stereo import Stereo, stays

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
