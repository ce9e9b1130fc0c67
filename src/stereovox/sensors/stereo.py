# SPDX-License-Identifier: Apache-2.0
"""The default model: hits stay in their cell and count by how surely they belong there, clearing fades out before."""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, exp, pi, sqrt

import numpy as np

from stereovox.sensors.model import Array


@dataclass(frozen=True)
class Stereo:
    """A model that knows the range noise of stereo, and that cells have a size.

    Before the measured point the evidence for free space fades like a Gaussian of the range noise, so a surface that is
    measured a little too far does not clear itself away. Behind it nothing is said, so walls do not grow thick (the
    weakness of Valenti 2018, section 8.4).

    The cell that holds the measured point is occupied as surely as the point is right (`p_right`) and its noise leaves
    it in this cell. This probability is turned into evidence against cells being occupied with `prior` before, and
    `trust` of it is taken, since the errors of one frame are found again in the next.
    """

    p_right: float = 0.95
    prior: float = 0.1
    trust: float = 0.8
    p_free: float = 0.35
    p_unknown: float = 0.5

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return p_free rising to p_unknown within some sigma before the measurement."""
        t = (np.asarray(z) - z_measured) / sigma
        before = self.p_free + (self.p_unknown - self.p_free) * np.exp(-0.5 * t * t)
        return np.where(t < 0, before, self.p_unknown)

    def hit(self, z_measured: Array, sigma: Array, voxel_size: float) -> Array:
        """Return the probability of the cell that holds the measured point, for even odds before; over p_unknown."""
        p = self.p_right * _stays(np.asarray(sigma) / voxel_size)
        evidence = self.trust * (np.log(p / (1 - p)) - np.log(self.prior / (1 - self.prior)))
        return 1 / (1 + np.exp(-np.maximum(evidence, 0.05)))


def _stays(ratio: Array) -> Array:
    """Return how likely noise of `ratio` cells leaves a point in its cell, wherever in the cell it is.

    The mean of Phi((1 - x) / r) - Phi(-x / r) over x from 0 to 1.
    """
    return np.array([erf(1 / (r * sqrt(2))) - r * sqrt(2 / pi) * (1 - exp(-0.5 / (r * r))) for r in ratio.tolist()])
