# SPDX-License-Identifier: Apache-2.0
"""Poses over time, interpolated at the time of an image."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from decimal import Decimal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry.se3 import Transform, interpolate, inverse, rotation_vector

MAX_GAP_NS = 100_000_000
"""An image whose neighbouring poses are 0.1 s or more away, on either side, has no pose, unless motion is smooth."""
SMOOTH_GAP_NS, USUAL, OFF_M, OFF_RAD = 1_000_000_000, 1.5, 0.01, 0.01
"""Longest time between two poses that is bridged if it is usual (at most 1.5 times the median: a longer one is a loss)
and the motion smooth: if the poses before and after show an acceleration that puts the middle of the gap off its line
by less than 1 cm and 0.01 rad."""


OTHER_CLOCK = "its times are of another clock, so its poses are assigned in order, one for each image"
TOO_LONG = (1000, 1_000_000, 1_000_000_000)
HALF, MOST = 0.5, 0.8
"""Factors by which times in other units are too long, and shares of the images that have a pose, see `in_time_of`."""


class Poses:
    """Poses of a body (a camera, a tracker) in a world, each with a unique time; in order of time.

    stamps_ns: (N,) int64 nanoseconds, in any order; of several with one stamp the first counts.
    T_world_body: (N, 4, 4) float64, in the same order. NaN marks an unusable pose: it is kept, and
        frames that need it are refused.
    confidence: (N,) float64, larger is better (T265: 0 failed to 3 high), or None if unknown.
    where: origin of the poses, for messages: a file or topic.
    faults: why poses are unusable, by stamp; one line each with the cure.
    repeated: number of poses left out because an earlier one has the same stamp.
    max_gap_ns: longest time between neighbours that is bridged, however the body moves; 0: by the two rules above.
    note: what was assumed about their times; "" if nothing.
    Raises SourceError if there is no pose or the arrays do not fit together.
    """

    def __init__(
        self,
        stamps_ns: ArrayLike,
        T_world_body: ArrayLike,
        confidence: ArrayLike | None = None,
        *,
        where: str = "poses",
        faults: Mapping[int, str] | None = None,
    ):
        stamps, T = np.asarray(stamps_ns, np.int64), np.asarray(T_world_body, float)
        if not stamps.size:
            raise SourceError(f"{where}: holds no pose; give at least two")
        trust = stamps if confidence is None else np.asarray(confidence, float)
        if stamps.ndim != 1 or T.shape != (len(stamps), 4, 4) or trust.shape != stamps.shape:
            raise SourceError(f"{where}: {T.shape} poses for {stamps.shape} times; give (N,) times and (N, 4, 4) poses")
        self.stamps_ns, first = np.unique(stamps, return_index=True)
        self.T_world_body = T[first]
        self.repeated = len(stamps) - len(first)
        self.confidence = None if confidence is None else trust[first]
        self.where = where
        self.faults = dict(faults or {})
        self.max_gap_ns, self.note = 0, ""
        self._interval_ns = float(np.median(np.diff(self.stamps_ns))) if len(first) > 1 else 0.0
        self._stamps: list[int] = self.stamps_ns.tolist()

    def __len__(self) -> int:
        return len(self._stamps)

    def of(self, T_world_body: ArrayLike) -> Poses:
        """Return other poses (N, 4, 4) at the same times."""
        found = Poses(self.stamps_ns, T_world_body, self.confidence, where=self.where, faults=self.faults)
        found.max_gap_ns, found.note, found.repeated = self.max_gap_ns, self.note, self.repeated
        return found

    def at(self, stamp_ns: int) -> Transform:
        """Return T_world_body at `stamp_ns`: a pose's own, else interpolated between its neighbours.

        Straight line in position, constant turn rate in rotation.
        Raises FrameRefused: `no_pose` if one of the neighbours is missing, or too far away (`MAX_GAP_NS`),
        `bad_pose_file` if a neighbour is unusable.
        """
        before, after = self.neighbours(stamp_ns)
        if before == after:
            return self._pose(before).copy()
        start, end = self._stamps[before], self._stamps[after]
        return interpolate(self._pose(before), self._pose(after), (stamp_ns - start) / (end - start))

    def neighbours(self, stamp_ns: int) -> tuple[int, int]:
        """Return the numbers of the poses before and after `stamp_ns`, twice the same if one has exactly that time.

        Raises FrameRefused `no_pose` if one of them is missing or too far away.
        """
        stamp_ns = int(stamp_ns)
        after = bisect_left(self._stamps, stamp_ns)
        if after < len(self._stamps) and self._stamps[after] == stamp_ns:
            return after, after
        self._check_gap(stamp_ns, after)
        return after - 1, after

    def _check_gap(self, stamp_ns: int, after: int) -> None:
        gaps = {
            "before": stamp_ns - self._stamps[after - 1] if after else None,
            "after": self._stamps[after] - stamp_ns if after < len(self._stamps) else None,
        }
        if 0 < after < len(self._stamps) and self._bridged(after):
            return
        for side, gap in gaps.items():
            if gap is None or gap >= MAX_GAP_NS:
                found = "there is none" if gap is None else f"the nearest is {gap / 1e9:.3f} s away"
                wanted = f"needs a pose less than {MAX_GAP_NS / 1e9:g} s {side} {stamp_ns / 1e9:.3f} s"
                raise FrameRefused("no_pose", f"{self.where}: {wanted}, {found}; leave the image out or add poses")

    def _bridged(self, after: int) -> bool:
        """Return whether the time before pose `after` may be bridged although it may be long."""
        gap = self._stamps[after] - self._stamps[after - 1]
        if self.max_gap_ns:
            return gap <= self.max_gap_ns
        ends = [k for k in (after - 1, after) if 0 < k < len(self._stamps) - 1]
        return (
            gap <= min(SMOOTH_GAP_NS, USUAL * self._interval_ns)
            and bool(ends)
            and all(self._off(k, gap) < 1 for k in ends)
        )

    def _off(self, k: int, gap: int) -> float:
        """Return how far the middle of a gap next to pose `k` may be off its line, as a share of what is allowed.

        At constant acceleration pose k is off the line of its neighbours by a h g / 2, for h seconds to the one and g,
        the gap, to the other; the middle of the gap is off by a g^2 / 8.
        """
        start, here, end = self._stamps[k - 1 : k + 2]
        other = end - start - gap
        if other > SMOOTH_GAP_NS or not np.isfinite(self.T_world_body[k - 1 : k + 2]).all():
            return np.inf
        line = interpolate(self.T_world_body[k - 1], self.T_world_body[k + 1], (here - start) / (end - start))
        T = inverse(line) @ self.T_world_body[k]
        place, turn = np.linalg.norm(T[:3, 3]) / OFF_M, np.linalg.norm(rotation_vector(T[:3, :3])) / OFF_RAD
        return float(max(place, turn)) * gap / (4 * other)

    def _pose(self, k: int) -> NDArray[np.float64]:
        T = self.T_world_body[k]
        if np.isfinite(T).all():
            return T
        stamp_ns = self._stamps[k]
        said = self.faults.get(stamp_ns, f"{self.where}: the pose at {seconds_from_ns(stamp_ns)} s cannot be used")
        raise FrameRefused("bad_pose_file", said)


def in_time_of(poses: Poses, stamps_ns: Sequence[int]) -> Poses:
    """Return poses with times in the unit of their images' times, ascending; `note` says if that was another one.

    Small stamps in milli-, micro- or nanoseconds are read as seconds, and those of 100 seconds as dates. A unit is
    changed only if it gives most images a pose, between poses of a usual rate, and fewer than half have one without.
    """
    covered = {factor: _covered(poses.stamps_ns // factor, stamps_ns) for factor in (1, *TOO_LONG)}
    best = max(covered, key=lambda factor: covered[factor])
    if covered[1] >= HALF or covered[best] < MOST:
        return poses
    faults = {stamp_ns // best: fault for stamp_ns, fault in poses.faults.items()}
    found = Poses(poses.stamps_ns // best, poses.T_world_body, poses.confidence, where=poses.where, faults=faults)
    found.note = f"{poses.where}: its times are {best:,} times those of the images, and divided by that"
    return found


def _covered(stamps: NDArray[np.int64], images: Sequence[int]) -> float:
    """Return the share of the images between two poses that are less than twice `MAX_GAP_NS` apart."""
    after = np.searchsorted(stamps, images)
    inside = (after > 0) & (after < len(stamps))
    exact = stamps[np.minimum(after, len(stamps) - 1)] == images
    gaps = np.diff(stamps, prepend=stamps[0])[np.minimum(after, len(stamps) - 1)]
    return float(np.mean(exact | (inside & (gaps < 2 * MAX_GAP_NS))))


class UnknownPoses:
    """The poses of a recording whose poses were not searched for: all NaN."""

    def at(self, i: int) -> Transform:
        """Return NaN (4, 4), for any number or time `i`."""
        return np.full((4, 4), np.nan)


def seconds_from_ns(stamp_ns: int) -> str:
    """Return nanoseconds as seconds with all nine decimals."""
    return f"{Decimal(int(stamp_ns)).scaleb(-9):.9f}"
