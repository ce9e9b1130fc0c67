# SPDX-License-Identifier: Apache-2.0
"""How far one frame agrees with what a map is sure of."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from stereovox.maps import _agreement
from stereovox.maps.blocks import StoredCells
from stereovox.maps.cell_format import CellRules
from stereovox.maps.evidence import LOG_ODDS_SCALE, Evidence

FEW = 50.0
"""Log-odds on surfaces the map is sure of that are too few to judge a frame by: some 15 hits."""
SAMPLE = 512
"""Blocks that are enough to judge a frame by."""


class Agreement(NamedTuple):
    """Log-odds that a frame gives to cells the map is sure of.

    A cell is surely free or occupied where it is past the middle between its threshold and its limit; where the frame
    confirms an occupied cell, it need not be sure.

    hits: for cells that are occupied. passes: against cells that are surely occupied: the frame looks through them.
    into_free: against cells that are surely free: the frame sees something there.
    """

    hits: float
    passes: float
    into_free: float

    @property
    def weight(self) -> float:
        """All log-odds that say something of the map's surfaces."""
        return self.hits + self.passes + self.into_free

    @property
    def against(self) -> float | None:
        """Share of them that is against the map, 0 to 1; None where there are too few to tell."""
        return (self.passes + self.into_free) / self.weight if self.weight >= FEW else None


def agreement(stored: StoredCells, rules: CellRules, evidence: Evidence) -> Agreement:
    """Weigh `evidence` against the cells of a map.

    Of a frame with more than SAMPLE blocks every second, fourth ... is looked at, by a hash of its coordinates: the
    same ones whatever their order.
    """
    blocks = len(evidence.coords) + len(evidence.uniform)
    mask = (1 << max(blocks // SAMPLE, 1).bit_length() - 1) - 1
    weights = np.zeros(3)
    _agreement.weigh(
        stored, _sure(rules), evidence.coords, evidence.values, evidence.uniform, np.int32(evidence.uniform_value),
        np.uint32(mask), weights,
    )  # fmt: skip
    hits, passes, into_free = ((mask + 1) / LOG_ODDS_SCALE * weights).tolist()
    return Agreement(hits, passes, into_free)


def _sure(rules: CellRules) -> tuple[np.int32, np.int32, np.int32]:
    """Return the highest stored number that is surely free, the lowest occupied one, and the lowest surely so."""
    free_most, occupied_least = map(int, rules.thresholds)
    surely_free = (free_most + int(rules.lowest)) // 2
    surely_occupied = -(-(occupied_least + int(rules.highest)) // 2)
    return np.int32(surely_free), np.int32(occupied_least), np.int32(surely_occupied)
