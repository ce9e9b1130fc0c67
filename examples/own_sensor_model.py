# SPDX-License-Identifier: Apache-2.0
"""A sensor model of your own, in plain NumPy."""

from dataclasses import dataclass

import numpy as np

import stereovox as sv
from stereovox.sensors import SENSORS


@dataclass(frozen=True)
class Careful:
    """Believes little of what it sees, and less of its hits the noisier they are."""

    p_hit: float = 0.65
    p_free: float = 0.45
    p_unknown: float = 0.5

    def probability(self, z, z_measured, sigma):
        """Return p(occupied) at depth z; all in metres, arrays of any shapes that broadcast."""
        trust = np.exp(-np.asarray(sigma))
        hit = self.p_unknown + (self.p_hit - self.p_unknown) * trust
        clear_before = z < z_measured - 2 * sigma
        at = z == z_measured
        return np.where(at, hit, np.where(clear_before, self.p_free, self.p_unknown))


SENSORS["careful"] = f"{__name__}:Careful"

mapper = sv.Mapper(voxel_size=0.1, **{"sensor.model": "careful", "sensor.p_hit": 0.7})
for frame in sv.open_source("sim:room", frames=":4"):
    mapper.add(frame)
print(mapper.map.counts())
