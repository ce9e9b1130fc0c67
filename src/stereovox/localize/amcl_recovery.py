# SPDX-License-Identifier: Apache-2.0
"""Noticing that the robot is lost: scans fit worse than they used to (table 8.3)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.config_robot import AmclConfig


class Recovery:
    """A long and a short memory of how well scans fit the map.

    strangers: share of particles that should be drawn at random, `max(0, 1 - short / long)`; 0 below `recovery_least`.

    What is remembered is the likelihood per beam: the K-th root of that of K beams, whose own scale would be left to
    chance. At first both memories are the plain mean of all that was seen, so that a start from anywhere fades.
    """

    def __init__(self, config: AmclConfig):
        self._alpha_slow, self._alpha_fast = config.alpha_slow, config.alpha_fast
        self._least = config.recovery_least
        self._long = self._short = 0.0
        self._seen = 0

    def see(self, log_likelihood: NDArray[np.float64], weights: NDArray[np.float64], beams: int) -> None:
        """Take in (N,) log likelihoods of `beams` beams by particles whose weights have the sum 1."""
        if self._alpha_slow <= 0 or self._alpha_fast <= 0:
            return
        best = log_likelihood.max()
        per_beam = float(np.exp((best + np.log(weights @ np.exp(log_likelihood - best))) / beams))
        self._seen += 1
        self._long += max(self._alpha_slow, 1 / self._seen) * (per_beam - self._long)
        self._short += max(self._alpha_fast, 1 / self._seen) * (per_beam - self._short)

    @property
    def strangers(self) -> float:
        """Share of particles to be drawn at random, 0 to 1."""
        share = 1 - self._short / self._long if self._long > 0 else 0.0
        return share if share > self._least else 0.0
