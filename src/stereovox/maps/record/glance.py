# SPDX-License-Identifier: Apache-2.0
"""A glance: the range that a sensor saw in each direction; later frames are compared with it.

Two glances from different poses separate a changed world from a fault: things in the world stay in place, faults of the
camera (dirt, a dead half, a frozen image) move with it, and noise does neither.

Agreement of one frame with the sure cells of a map.
"""

from __future__ import annotations

import zlib
from base64 import b64decode, b64encode
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.geometry.se3 import Transform
from stereovox.maps.cells import _add
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import LARGEST, LOG_ODDS_SCALE, Evidence
from stereovox.maps.record._glance import SAME, SIDE, UNSEEN, bin_points, place
from stereovox.maps.storage.blocks import StoredCells

MARKS = 300
"""Most points of a glance that later frames are compared with."""
AT_REST = np.eye(4, dtype=np.float32)[:3]
"""Motion of points that are fixed to the sensor, not to the world."""


class Glance(NamedTuple):
    """The view of a sensor at one time.

    pose: first three rows of T_world_sensor, 12 numbers. ranges: SIDE x SIDE float16 in metres as bytes, 0 for none.
    stamp_ns: its time, 0 if it is not needed.
    """

    pose: tuple[float, ...]
    ranges: bytes
    stamp_ns: int = 0

    @classmethod
    def at(cls, points: NDArray[np.float64], T_world_sensor: Transform) -> Glance:
        """Return the glance of points (N, 3) in the sensor's frame."""
        return cls.of(binned(points), tuple(T_world_sensor[:3].ravel().tolist()))

    @classmethod
    def of(cls, ranges: NDArray[np.float32], pose: tuple[float, ...], stamp_ns: int = 0) -> Glance:
        """Return the glance with ranges (SIDE, SIDE) in metres, 0 for none."""
        packed = np.minimum(ranges, np.float32(6e4)).astype(np.float16)
        return cls(pose, packed.tobytes(), stamp_ns)

    @property
    def typical_m(self) -> float:
        """Median of its ranges in metres, 0 if it saw nothing."""
        return _median(self.ranges)

    def packed(self) -> str:
        """Return its ranges as text, which `unpacked` reads."""
        return b64encode(zlib.compress(self.ranges, 1)).decode()

    @classmethod
    def unpacked(cls, pose: tuple[float, ...], text: str, stamp_ns: int = 0) -> Glance:
        """Return a saved glance. Raises ValueError if the text cannot be one."""
        try:
            ranges = zlib.decompressobj().decompress(b64decode(text, validate=True), 2 * SIDE * SIDE + 1)
        except (TypeError, zlib.error) as error:
            raise ValueError(f"history: a glance is damaged: {error}") from None
        metres = np.frombuffer(ranges, np.float16) if len(ranges) == 2 * SIDE * SIDE else np.full(1, np.nan)
        if not (np.isfinite(metres) & (metres >= 0)).all():
            raise ValueError("history: the ranges of a glance are not distances")
        return cls(pose, ranges, stamp_ns)

    def votes(self, points: NDArray[np.float64], T_world_sensor: Transform, tolerance: NDArray[np.float64]) -> Votes:
        """Compare points (N, 3) in the sensor's frame, which a later frame saw, with this glance.

        tolerance: (N,) metres by which ranges may differ.
        """
        T = np.reshape(self.pose, (3, 4))
        here = np.column_stack([T[:, :3].T @ T_world_sensor[:3, :3], T[:, :3].T @ (T_world_sensor[:3, 3] - T[:, 3])])
        there, off = np.ascontiguousarray(points, np.float32), np.asarray(tolerance, np.float32)
        found = np.empty((2, len(points)), np.uint8)
        for motion, out in zip((here.astype(np.float32), AT_REST), found, strict=True):
            place(_metres(self.ranges), there, motion, off, out)
        in_view, (in_world, in_sensor) = found[0] != UNSEEN, found == SAME
        return Votes(
            int(np.count_nonzero(in_world & ~in_sensor)),
            int(np.count_nonzero(in_view & in_sensor & ~in_world)),
            int(np.count_nonzero(in_view & ~(in_sensor | in_world))),
            int(np.count_nonzero(in_world & in_sensor)),
        )


class Votes(NamedTuple):
    """How many points an earlier glance saw at the same place in the world, or at the same place in the sensor's frame.

    world, sensor: only there. neither: at neither. both: at both, which decides nothing.
    """

    world: int = 0
    sensor: int = 0
    neither: int = 0
    both: int = 0


def binned(points: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return the ranges (SIDE, SIDE) in metres of points (N, 3) in the sensor's frame, 0 for none."""
    ranges = np.zeros((SIDE, SIDE), np.float32)
    bin_points(np.ascontiguousarray(points, np.float32), ranges)
    return ranges


@lru_cache(maxsize=64)
def _metres(ranges: bytes) -> NDArray[np.float32]:
    """Return the ranges (SIDE, SIDE) of a glance in metres."""
    return np.frombuffer(ranges, np.float16).reshape(SIDE, SIDE).astype(np.float32)


@lru_cache(maxsize=64)
def _median(ranges: bytes) -> float:
    metres = _metres(ranges)
    return float(np.median(metres[metres > 0])) if metres.any() else 0.0


class Marks(NamedTuple):
    """Points of a glance that later frames are compared with, (N, 3) each, in the sensor's and in the world frame."""

    sensor: NDArray[np.float32]
    world: NDArray[np.float64]


@lru_cache(maxsize=64)
def marks_of(glance: Glance) -> Marks:
    """Return at most MARKS points of a glance, each in the middle of its bin."""
    metres = _metres(glance.ranges)
    row, column = np.nonzero(metres)
    some = slice(None, None, max(1, -(-len(row) // MARKS)))
    row, column = row[some], column[some]
    b, a = ((2 * side + 1) / SIDE - 1 for side in (row, column))
    z = 1 - np.abs(a) - np.abs(b)
    x = np.where(z < 0, (1 - np.abs(b)) * np.sign(a), a)
    y = np.where(z < 0, (1 - np.abs(a)) * np.sign(b), b)
    points = np.stack([x, y, z], axis=1)
    points *= (metres[row, column] / np.linalg.norm(points, axis=1))[:, None]
    T = np.reshape(glance.pose, (3, 4))
    return Marks(points.astype(np.float32), points @ T[:, :3].T + T[:, 3])


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
