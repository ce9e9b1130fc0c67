# SPDX-License-Identifier: Apache-2.0
"""What one frame says about the world, before any map knows it: integrators make it, a map adds it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LOG_ODDS_SCALE = 1000
"""Log-odds are kept as whole thousandths; zero means "nothing is known"."""
LARGEST = 32767


def to_units(log_odds: float | NDArray[np.floating]) -> NDArray[np.int32]:
    """Return log-odds as whole thousandths that fit into 16 bits."""
    return np.clip(np.rint(np.asarray(log_odds) * LOG_ODDS_SCALE), -LARGEST, LARGEST).astype(np.int32)


@dataclass(frozen=True, eq=False)
class Evidence:
    """Log-odds of one frame in thousandths, block by block; no block stands in it twice.

    coords: (n, 3) int32 block coordinates; values: (n, 512) int16, zero where the frame says nothing.
    uniform: (m, 3) int32 wholly free blocks; uniform_values: (m,) int16, negative, what all cells of each get; one
        number serves all.
    """

    coords: NDArray[np.int32]
    values: NDArray[np.int16]
    uniform: NDArray[np.int32]
    uniform_values: NDArray[np.int16]

    def __post_init__(self) -> None:
        if np.ndim(self.uniform_values) == 0:
            object.__setattr__(self, "uniform_values", np.full(len(self.uniform), self.uniform_values, np.int16))
