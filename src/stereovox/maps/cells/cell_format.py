# SPDX-License-Identifier: Apache-2.0
"""Cell formats: log-odds as thousandths in 16 bits, as steps of 1/32 in 8, or as the byte of Chien 2020."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from math import ceil, floor, log, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import MapConfig
from stereovox.errors import ConfigError
from stereovox.maps.cells import _cells

BYTE_THRESHOLD = 180
"""Byte above which Chien 2020 (3.5) shows a cell as occupied; it is taken as a probability of 0.7."""
UNLIKELY = 0.3
"""A cell at its lower limit is free if its probability is below this, whatever the costs."""
LIKELY = 0.7
"""Lower bound on the probability that counts as certainly occupied, however low the threshold."""


class State(IntEnum):
    """State of a cell, by its probability of being occupied.

    Attributes:
        UNKNOWN: No evidence.
        FREE: p < 1 / `map.missed_obstacle`, or `map.free_below`.
        TENTATIVE: Between both thresholds.
        OCCUPIED: p > 1 - 1 / `map.false_alarm`, or `map.occupied_above`.
    """

    UNKNOWN = _cells.UNKNOWN
    FREE = _cells.FREE
    TENTATIVE = _cells.TENTATIVE
    OCCUPIED = _cells.OCCUPIED


@dataclass(frozen=True)
class CellFormat:
    """Stored number = `unknown` + log-odds * `per_log_odds`, rounded and cut to the type's range.

    drift: change of `shift` from frame to frame.
    """

    dtype: np.dtype
    unknown: int
    per_log_odds: float
    drift: float = 0.0

    def stored(self, log_odds: ArrayLike) -> NDArray[np.int32]:
        """Return the stored numbers of log-odds."""
        limits = np.iinfo(self.dtype)
        number = self.unknown + np.rint(np.asarray(log_odds, float) * self.per_log_odds)
        return np.clip(number, limits.min, limits.max).astype(np.int32)

    def log_odds(self, stored: NDArray[np.integer]) -> NDArray[np.float32]:
        """Return the log-odds of stored numbers."""
        return (stored.astype(np.float32) - np.float32(self.unknown)) / np.float32(self.per_log_odds)

    def shift(self, frame: int) -> float:
        """Return the offset added to a frame's evidence, in stored numbers, before it is rounded down: 0 to 1.

        A half rounds to the nearest number. If it drifts by the golden ratio, evidence of a tenth of a step counts as a
        whole one in every tenth frame: weak evidence is not lost, none is counted twice, and nothing is random.
        """
        return (0.5 + frame * self.drift) % 1.0


class Thresholds(NamedTuple):
    """The stored numbers, other than "unknown", that separate the states, as kernels read them."""

    free_most: np.int32  # free up to this
    occupied_least: np.int32  # occupied from this on


@dataclass(frozen=True)
class CellRules:
    """The `map` section of the settings in stored numbers.

    A cell is free below `free_below`, occupied above `occupied_above`; it never leaves [lowest, highest].
    """

    config: MapConfig

    @cached_property
    def format(self) -> CellFormat:
        """How numbers are stored."""
        return FORMATS[self.config.cell]

    @cached_property
    def lowest(self) -> np.int32:
        """Smallest stored number."""
        return np.int32(min(self.format.stored(self.config.log_odds_min), self.format.unknown - 1))

    @cached_property
    def highest(self) -> np.int32:
        """Largest stored number."""
        return np.int32(max(self.format.stored(self.config.log_odds_max), self.format.unknown + 1))

    @cached_property
    def prior(self) -> np.int32:
        """Stored number from which a cell starts with its first evidence, within the limits."""
        p = self.config.prior
        return np.int32(np.clip(self.format.stored(log(p / (1 - p))), self.lowest, self.highest))

    @property
    def prior_log_odds(self) -> float:
        """Log-odds from which a cell starts, as they are stored."""
        return float(self.format.log_odds(np.array(self.prior)))

    @cached_property
    def free_below(self) -> float:
        """Stored numbers below this are free: unlikely, and no likelier than before the first evidence.

        If costs decide, a cell at its lower limit is free if that is below `UNLIKELY`.
        """
        unlikely = self._exact(self.config.decision.free_below)
        if self.config.free_below is None:
            unlikely = max(unlikely, min(float(self.lowest) + 0.5, self._exact(UNLIKELY)))
        return min(unlikely, float(self.prior) + 0.5)

    @cached_property
    def occupied_above(self) -> float:
        """Stored numbers above this are occupied."""
        return self._exact(self.config.decision.occupied_above)

    @cached_property
    def most_rise(self) -> int | None:
        """Most that one frame may add to a cell, so that `confirm_hits` frames must hit it; None: no limit.

        Fewer frames never make an unknown cell occupied, although it starts from the prior and skips "unknown" by one.
        If numbers are too coarse for exactly that many, more are needed. Raises ConfigError if they are far too coarse.
        """
        frames = self.config.confirm_hits
        if frames == 1:
            return None
        way = int(self.thresholds.occupied_least) - int(self.prior)
        most = min(ceil(way / frames), (way - 2) // (frames - 1))
        if most < 1:
            raise ConfigError(
                f"map.confirm_hits {frames}: cells of {self.config.cell} count at most {max(1, way - 1)} hits from "
                "map.prior to occupied; ask for fewer"
            )
        return most

    @cached_property
    def thresholds(self) -> Thresholds:
        """The same in whole numbers."""
        return Thresholds(np.int32(ceil(self.free_below) - 1), np.int32(floor(self.occupied_above) + 1))

    @cached_property
    def sure(self) -> tuple[np.int16, np.int16, np.int16]:
        """The highest certainly free stored number, the lowest likely occupied one, and the lowest certainly occupied
        one: how frames are compared with the map, whatever wrong decisions cost.

        Likely is at least LIKELY, and unlikely at most UNLIKELY and the prior. Certain means past the middle between
        these and the limit. No certain number is "unknown" or beyond it.
        """
        unknown, (free_most, occupied_least) = self.format.unknown, map(int, self.thresholds)
        unlikely = min(int(self.prior), int(self.format.stored(log(UNLIKELY / (1 - UNLIKELY)))))
        surely_free = min(free_most, (unlikely + int(self.lowest)) // 2, unknown - 1)
        likely = max(occupied_least, unknown + 1, int(self.format.stored(log(LIKELY / (1 - LIKELY)))))
        surely_occupied = -(-(likely + int(self.highest)) // 2)
        return np.int16(surely_free), np.int16(likely), np.int16(max(surely_occupied, likely))

    def yielding(self, values: NDArray[np.signedinteger], stored: NDArray[np.integer], again: bool) -> NDArray:
        """Return weak evidence for cells that hold `stored`, of the same shape; zero where it yields to the map.

        It clears no surely occupied cell, and adds to no occupied one. again: it repeats what was added before, so only
        what is for something in a free cell counts.
        """
        cells = np.where(stored == self.format.unknown, self.prior, stored.astype(np.int32))
        if again:
            counts = (values > 0) & (cells <= self.thresholds.free_most) & (stored != self.format.unknown)
        else:
            counts = np.where(values > 0, cells < self.thresholds.occupied_least, cells < self.sure[2])
        return np.where(counts, values, values.dtype.type(0))

    def states(self, stored: NDArray[np.integer]) -> NDArray[np.uint8]:
        """Return the `State` of stored numbers, uint8 of the same shape."""
        free_most, occupied_least = map(int, self.thresholds)
        states = np.full(stored.shape, State.TENTATIVE, np.uint8)
        states += stored >= occupied_least
        states -= stored <= free_most
        states *= stored != self.format.unknown  # State.UNKNOWN is 0
        return states

    def _exact(self, p: float) -> float:
        return self.format.unknown + round(log(p / (1 - p)) * self.format.per_log_odds, 6)


FORMATS = {
    "int16": CellFormat(np.dtype(np.int16), 0, 1000.0),
    "int8": CellFormat(np.dtype(np.int8), 0, 32.0, drift=(sqrt(5) - 1) / 2),
    "uint8": CellFormat(np.dtype(np.uint8), 127, (BYTE_THRESHOLD - 127) / log(0.7 / 0.3)),
}
