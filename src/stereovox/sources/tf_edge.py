# SPDX-License-Identifier: Apache-2.0
"""Where one frame stood in its parent, over time."""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.geometry import Transform, from_quaternion, interpolate
from stereovox.sources.poses import seconds_from_ns

STILL = 1e-9


@dataclass(frozen=True)
class Limits:
    """How far transforms may be from a time they are asked for.

    max_gap_s: longest time between two transforms that is bridged. extrapolate_s: how long the last transform holds
    after its time, and the first before it; a robot of 1 m/s is 0.1 m off after 0.1 s.
    """

    max_gap_s: float = 0.5
    extrapolate_s: float = 0.1


class Edge:
    """Where frame `child` stood in frame `parent`: at the times of its transforms and between them, or always (fixed).

    A frame that has the same transform in all messages, two at least, is taken for a fixed one that is sent again and
    again: any gap between them is bridged, and the ends hold for `max_gap_s`.
    """

    def __init__(self, parent: str, child: str, name: str = ""):
        self.parent, self.child, self._name = parent, child, name or f"{parent} -> {child}"
        self._fixed: Transform | None = None
        self._stamps, self._rows = array("q"), array("d")  # a list of tuples would take five times the memory
        self._sorted: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None
        self._still = False

    @property
    def fixed(self) -> bool:
        """Whether the transform is the same at all times."""
        return self._fixed is not None

    @property
    def count(self) -> int:
        """How many transforms it has, 1 where it is fixed."""
        return 1 if self.fixed else len(self._stamps)

    @property
    def moves(self) -> bool:
        """Whether the child was seen to move in its parent."""
        if not self.fixed:
            self._in_order()
        return not (self.fixed or self._still)

    def add(self, stamp_ns: int, numbers: Iterable[float]) -> None:
        """Take in tx ty tz qx qy qz qw at a time; of several with one time the first counts."""
        self._stamps.append(stamp_ns)
        self._rows.extend(numbers)
        self._sorted = None

    def fix(self, T_parent_child: Transform) -> None:
        """Take in where the child always stands."""
        self._fixed = np.array(T_parent_child, float)

    def at(self, stamp_ns: int, limits: Limits, where: str) -> Transform:
        """Return T_parent_child at a time: straight line in position, constant turn rate in rotation.

        Raises FrameRefused `no_pose`, which names the edge and the gap, where the limits do not allow it.
        """
        if self._fixed is not None:
            return self._fixed
        stamps, rows = self._in_order()
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return _motion(rows[after])
        if after in (0, len(stamps)):
            return self._held(stamp_ns, max(after - 1, 0), limits, where)
        start, end = int(stamps[after - 1]), int(stamps[after])
        if end - start > limits.max_gap_s * 1e9 and not self._still:
            told = f"has no transform for {_seconds(end - start)} after {seconds_from_ns(start)} s"
            raise FrameRefused(
                "no_pose", f"{where}: {self} {told} (at most {limits.max_gap_s:g} s is bridged); record it more often"
            )
        return interpolate(_motion(rows[after - 1]), _motion(rows[after]), (stamp_ns - start) / (end - start))

    def off_ns(self, stamp_ns: int) -> int:
        """Return how far a time lies before the first transform or after the last; 0 where the frame is fixed."""
        if self._fixed is not None:
            return 0
        stamps, _ = self._in_order()
        return 0 if self._still else max(int(stamps[0]) - stamp_ns, stamp_ns - int(stamps[-1]), 0)

    def __str__(self) -> str:
        return self._name

    def _held(self, stamp_ns: int, nearest: int, limits: Limits, where: str) -> Transform:
        stamps, rows = self._in_order()
        away = abs(stamp_ns - int(stamps[nearest]))
        limit_s = max(limits.max_gap_s, limits.extrapolate_s) if self._still else limits.extrapolate_s
        if away > limit_s * 1e9:
            side = "begins after" if stamp_ns < stamps[nearest] else "ends before"
            told = f"{side} {seconds_from_ns(stamp_ns)} s, {_seconds(away)} away (at most {limit_s:g} s)"
            raise FrameRefused("no_pose", f"{where}: {self} {told}; leave that part of the recording out")
        return _motion(rows[nearest])

    def _in_order(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        if self._sorted is None:
            stamps, first = np.unique(np.array(self._stamps, np.int64), return_index=True)
            rows = np.array(self._rows, float).reshape(-1, 7)[first]
            self._sorted = stamps, rows
            self._still = len(rows) > 1 and bool(np.abs(rows - rows[0]).max() <= STILL)
        return self._sorted


def _motion(numbers: NDArray[np.float64]) -> Transform:
    return from_quaternion(numbers[:3], numbers[3:])


def _seconds(ns: int) -> str:
    return f"{ns / 1e9:.3f} s"
