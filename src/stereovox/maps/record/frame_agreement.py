# SPDX-License-Identifier: Apache-2.0
"""Agreement of one frame with what a map is sure of."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.maps.cells import _add
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import LARGEST, LOG_ODDS_SCALE, Evidence
from stereovox.maps.storage.blocks import StoredCells

FEW = 200.0
"""Log-odds on surfaces the map is sure of that are too few to judge a frame by: some 50 hits."""
FEW_BEAMS, AGAINST_BEAMS = 12, 8
"""Beams of a scan that are; and those against the map that are enough wherever they come from."""
KNOWN = 0.3
"""Share of what a frame sees that the map must be sure of."""
SAMPLE = 512
"""Blocks that are enough to judge a frame by."""
LOOKED_THROUGH = 3.0
"""What is looked through tells as much as what is hit, although a sensor model gives it less evidence, and only where
a whole patch of pixels looks through."""


class Agreement(NamedTuple):
    """Log-odds that a frame gives to cells the map is sure of.

    Hits that are not firm count for cells, but not against them.

    A cell is surely free or occupied where it is past the middle between its threshold and its limit; where the frame
    confirms an occupied cell, it need not be sure.

    hits: for cells that are occupied. passes: against cells that are surely occupied: the frame looks through them.
    into_free: against cells that are surely free: the frame sees something there. at_edge: those of them that are next
        to an unknown cell, where surfaces come to light that the camera saw edge on before.
    every: all firm hits, whatever the map says of their cells.
    """

    hits: float
    passes: float
    into_free: float
    at_edge: float
    every: float

    @property
    def weight(self) -> float:
        """All log-odds that say something of the map's surfaces."""
        return self.hits + self.through + self.into_free

    @property
    def through(self) -> float:
        """What the frame looks through, as much as if it were hit."""
        return LOOKED_THROUGH * self.passes

    @property
    def against(self) -> float | None:
        """Share of them that is against the map, 0 to 1; None if there are too few to tell.

        What is new is often seen first where noise at the end of the range has cleared some cells before; so a frame
        is judged only where a good part of what it sees is known, or where it looks through much; and what is at the
        edge of the known counts no more than all else that is against the map.
        """
        if self.weight < FEW or (self.weight < KNOWN * self.every and self.through < FEW):
            return None
        within = self.through + self.into_free - self.at_edge
        against = within + min(self.at_edge, within)
        return against / (self.hits + against) if against else 0.0


class BeamAgreement(NamedTuple):
    """How many beams of a scan agree with what a grid is sure of.

    agree: end at a surface. into_free: end in what is surely free. through: clear what is surely occupied, and end at
    nothing known. every: all that say something.
    """

    agree: int
    into_free: int
    through: int
    every: int

    @property
    def against(self) -> float | None:
        """Share of beams that are against the grid, of those it knows something of; None if they are too few.

        Where it knows little of what the scan sees, so many against it are enough to judge.
        """
        against = self.into_free + self.through
        known = self.agree + against
        judged = known >= FEW_BEAMS and (known >= KNOWN * self.every or against >= AGAINST_BEAMS)
        return against / known if judged else None


def agreement(stored: StoredCells, rules: CellRules, evidence: Evidence, firm: int) -> Agreement:
    """Weigh `evidence` against the cells of a map; see `Storage.agreement`."""

    def weigh(least: np.int16, mask: np.uint32) -> NDArray[np.float64]:
        weights = np.zeros(5)
        _add.weigh(
            stored, rules.sure, least, evidence.coords, evidence.values, evidence.uniform, evidence.uniform_values,
            mask, weights,
        )  # fmt: skip
        return weights

    return sampled(len(evidence.coords) + len(evidence.uniform), firm, weigh)


def sampled(blocks: int, firm: int, weigh: Callable[[np.int16, np.uint32], NDArray[np.float64]]) -> Agreement:
    """Return what `weigh` finds: it takes `least` and `mask` as `_add.weigh` does, and returns its five weights.

    Of a frame with more than SAMPLE blocks every second, fourth ... is looked at, by a hash of its coordinates: the
    same ones whatever their order.
    """
    mask = (1 << max(blocks // SAMPLE, 1).bit_length() - 1) - 1
    weights = weigh(np.int16(min(firm, LARGEST)), np.uint32(mask))
    return Agreement(*((mask + 1) / LOG_ODDS_SCALE * weights).tolist())
