# SPDX-License-Identifier: Apache-2.0
"""The default model: hits count by how surely they belong into their cell, and clearing counts less than they do."""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, exp, pi, sqrt

import numpy as np

from stereovox.sensors.model import Array


@dataclass(frozen=True)
class Stereo:
    """A model that knows the range noise of stereo, and that cells have a size.

    Within `fade` sigma of the range noise before the measured point nothing is said, and from there on the evidence for
    free space grows like a Gaussian falls: a surface that is measured too far does not clear itself away, and neither
    does a pole that the camera cannot tell from the wall behind it. Behind the point nothing is said either, so walls
    do not grow thick (the weakness of Valenti 2018, section 8.4).

    The cell that holds the measured point is occupied as surely as the point is right (`p_right`) and its noise leaves
    it in this cell, and with `p_least` however wide the noise is. This probability is turned into evidence against
    cells being occupied with `prior` before, and `trust` of it is taken, since the errors of one frame are found again
    in the next.

    A cell that is looked through loses no more than `passes` of what a hit at its depth would give: of a pole thinner
    than a pixel most frames see only what is behind it, and the frames that do see it must not be outvoted.
    """

    p_right: float = 0.95
    prior: float = 0.1
    trust: float = 0.8
    p_free: float = 0.35
    p_unknown: float = 0.5
    p_least: float = 0.7
    fade: float = 2.0
    passes: float = 0.3

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return p_free rising to p_unknown at `fade` sigma before the measurement."""
        t = np.minimum((np.asarray(z) - z_measured) / sigma + self.fade, 0.0)
        before = self.p_free + (self.p_unknown - self.p_free) * np.exp(-0.5 * t * t)
        return np.where(t < 0, before, self.p_unknown)

    def hit(self, z_measured: Array, sigma: Array, voxel_size: float) -> Array:
        """Return the probability of the cell that holds the measured point, for even odds before; at least p_least."""
        p = self.p_right * _stays(np.asarray(sigma) / voxel_size)
        evidence = self.trust * (np.log(p / (1 - p)) - np.log(self.prior / (1 - self.prior)))
        return np.maximum(1 / (1 + np.exp(-evidence)), self.p_least)

    def passed(self, z: Array, sigma: Array, voxel_size: float) -> Array:
        """Return the least probability of a cell at depth `z` that is looked through, for even odds before."""
        hit = self.hit(z, sigma, voxel_size)
        return 1 / (1 + (hit / (1 - hit)) ** self.passes)


def _stays(ratio: Array) -> Array:
    """Return how likely noise of `ratio` cells leaves a point in its cell, wherever in the cell it is.

    The mean of Phi((1 - x) / r) - Phi(-x / r) over x from 0 to 1.
    """
    return np.array([erf(1 / (r * sqrt(2))) - r * sqrt(2 / pi) * (1 - exp(-0.5 / (r * r))) for r in ratio.tolist()])
