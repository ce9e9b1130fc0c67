# SPDX-License-Identifier: Apache-2.0
"""Agreement of one frame with the sure cells of a map."""

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
"""Least log-odds on sure cells to judge a frame by: some 50 hits."""
FEW_BEAMS, AGAINST_BEAMS = 12, 8
"""Least beams of a scan on known cells to judge it by; and beams against the map that suffice, however little of the
scan is known."""
KNOWN = 0.3
"""Share of a frame's evidence that must be on sure cells."""
SAMPLE = 512
"""Blocks that are enough to judge a frame by."""
SEEN_THROUGH = 3.0
"""Weight of a pass relative to a hit: a surface that is seen through says as much, although the sensor model gives it
less evidence, and only if a whole patch of pixels sees through."""


class Agreement(NamedTuple):
    """Log-odds that a frame gives to sure cells of the map.

    Hits that are not firm count for cells, but not against them.

    A cell is surely free or occupied if it is past the middle between its threshold and its limit; an occupied cell
    that the frame confirms need not be sure.

    hits: for occupied cells. passes: against surely occupied cells: the frame sees through them. into_free: against
        surely free cells: the frame sees something there. at_edge: the part of into_free next to unknown cells, where
        surfaces appear that the camera saw edge-on before.
    every: all firm hits, whatever the state of their cells.
    """

    hits: float
    passes: float
    into_free: float
    at_edge: float
    every: float

    @property
    def weight(self) -> float:
        """All log-odds that count for or against the map."""
        return self.hits + self.through + self.into_free

    @property
    def through(self) -> float:
        """The passes, weighted like hits."""
        return SEEN_THROUGH * self.passes

    @property
    def against(self) -> float | None:
        """Share of them that is against the map, 0 to 1; None if there are too few to judge.

        New surfaces often appear where noise at the end of the range had cleared some cells. So a frame is judged only
        if a good part of what it sees is known, or if it sees through much; and hits at the edge of known space count
        no more than all the rest that is against the map.
        """
        if self.weight < FEW or (self.weight < KNOWN * self.every and self.through < FEW):
            return None
        within = self.through + self.into_free - self.at_edge
        against = within + min(self.at_edge, within)
        return against / (self.hits + against) if against else 0.0


class BeamAgreement(NamedTuple):
    """How many beams of a scan agree with the sure cells of a grid.

    agree: end at a surface. into_free: end in surely free cells. through: clear surely occupied cells, and end at
    nothing known. every: all that carry evidence.
    """

    agree: int
    into_free: int
    through: int
    every: int

    @property
    def against(self) -> float | None:
        """Share of the beams on known cells that are against the grid; None if they are too few to judge.

        If little of what the scan sees is known, AGAINST_BEAMS against it are enough to judge.
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
    """Return the agreement by `weigh`, which takes `least` and `mask` as `_add.weigh`, and returns its five weights.

    A frame with more than SAMPLE blocks is sampled: a hash of the coordinates picks every second, fourth, ... block,
    the same ones in whatever order.
    """
    mask = (1 << max(blocks // SAMPLE, 1).bit_length() - 1) - 1
    weights = weigh(np.int16(min(firm, LARGEST)), np.uint32(mask))
    return Agreement(*((mask + 1) / LOG_ODDS_SCALE * weights).tolist())
