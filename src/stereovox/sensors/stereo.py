# SPDX-License-Identifier: Apache-2.0
"""The default model: hits stay in their cell, clearing fades out before a noisy surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox.sensors.model import Array


@dataclass(frozen=True)
class Stereo:
    """A constant model that knows the range noise of stereo.

    The cell that holds the measured point is occupied with `p_hit`. Before it the evidence for free space fades like
    a Gaussian of the range noise, so a surface that is measured a little too far does not clear itself away. Behind
    it nothing is said, so walls do not grow thick (the weakness of Valenti 2018, section 8.4).
    """

    p_hit: float = 0.7
    p_free: float = 0.4
    p_unknown: float = 0.5

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return p_free rising to p_unknown within some sigma before the measurement, p_hit at it."""
        t = (np.asarray(z) - z_measured) / sigma
        before = self.p_free + (self.p_unknown - self.p_free) * np.exp(-0.5 * t * t)
        return np.where(t < 0, before, np.where(t > 0, self.p_unknown, self.p_hit))
