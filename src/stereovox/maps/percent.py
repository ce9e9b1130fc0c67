# SPDX-License-Identifier: Apache-2.0
"""Stored cells of a grid as per cent, and back."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from stereovox.maps.cell_format import CellRules, State
from stereovox.maps.occupancy import UNKNOWN


class Percent:
    """What numbers that are stored by `rules` mean.

    A cell is of the same state as a number and in per cent, for which rounding gives way. The surest cells that the
    rules allow are 0 and 100 per cent, since many programs take nothing less for occupied.
    """

    def __init__(self, rules: CellRules):
        self._rules = rules
        self._format = rules.format
        self.lowest = int(np.iinfo(self._format.dtype).min)

    @cached_property
    def free_below(self) -> float:
        """Probability below which cells are free: what evidence made likelier than the prior is not."""
        just_above = (self._rules.prior + 0.5 - self._format.unknown) / self._format.per_log_odds
        return min(self._rules.config.free_below, float(1 / (1 + np.exp(-just_above))))

    @property
    def occupied_above(self) -> float:
        """Probability above which cells are occupied."""
        return self._rules.config.occupied_above

    @cached_property
    def shown(self) -> NDArray[np.int8]:
        """Per cent of each number that can be stored, from `lowest` on; -1 unknown."""
        stored = np.arange(self.lowest, np.iinfo(self._format.dtype).max + 1)
        states = self._rules.states(stored)
        free, occupied = 100 * self.free_below, 100 * self.occupied_above
        percent = np.rint(100 / (1 + np.exp(-self._format.log_odds(stored).astype(float))))
        percent[(stored <= self._rules.lowest) & (states == State.FREE)] = 0
        percent[(stored >= self._rules.highest) & (states == State.OCCUPIED)] = 100
        for state, least, most in (
            (State.FREE, 0, np.ceil(free) - 1),
            (State.TENTATIVE, np.ceil(free), np.floor(occupied)),
            (State.OCCUPIED, np.floor(occupied) + 1, 100),
        ):
            percent = np.where(states == state, np.clip(percent, least, most), percent)
        percent[states == State.UNKNOWN] = UNKNOWN
        return percent.astype(np.int8)

    def stored(self, percent: NDArray[np.int8]) -> NDArray[np.integer]:
        """Return what cells of so many per cent are stored as; less than 0 is unknown."""
        p = np.clip(np.arange(128) / 100, 1e-12, 1 - 1e-12)
        known = np.clip(self._format.stored(np.log(p / (1 - p))), self._rules.lowest, self._rules.highest)
        unknown = self._format.unknown
        table = np.full(256, unknown, self._format.dtype)
        table[:128] = np.where(known == unknown, unknown + 1, known)
        return table[np.ascontiguousarray(percent).view(np.uint8)]
