# SPDX-License-Identifier: Apache-2.0
"""Poses that arrive while a camera runs: one thread adds them, another waits for the pose at the time of an image."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import Counter
from collections.abc import Callable, Sequence
from threading import Condition
from time import monotonic
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import FrameRefused
from stereovox.geometry.se3 import Transform, rigidity_error, rotation_vector
from stereovox.sources.poses.clock_watch import Delays
from stereovox.sources.poses.poses import Poses, seconds_from_ns

KEPT = 4000
"""Poses that are kept: 20 s at 200 Hz. The older half is dropped if there are more."""
RESET_NS = 1_000_000_000
"""A pose this much older than the newest one means that the clock was set back: all earlier ones are dropped."""
SET_BACK, REORDERED_NS = 3, 50_000_000
"""This many consecutive poses, ascending as time passes but all older than the newest one, mean the same. A pose that
is older by more than messages overtake each other waits for the next ones, since it may use another clock."""
RIGID = 1e-3
"""Largest rigidity error of a usable pose."""
MAX_SPEED_MPS, MAX_TURN_DPS = 10.0, 720.0
"""Speeds beyond which two neighbouring poses are a jump; as in `pair.toml`."""
CLOCKS_APART_NS = 10_000_000_000
"""Images and poses further apart than this use different clocks."""


class _Late(NamedTuple):
    """A pose not newer than an earlier one, and its arrival."""

    stamp_ns: int
    T: Transform
    arrived_ns: int


class NewestPose(NamedTuple):
    """The newest pose of a body, and what its tracker says of it; fields as the arguments of `LivePoses.add`."""

    stamp_ns: int
    T_world_body: Transform
    covariance: NDArray[np.float64] | None
    quality: int


class LivePoses:
    """A buffer of poses of a body in a world, in order of time. Thread-safe.

    A pose between two others is interpolated as in `Poses.at`: linear in position, with a constant
    turn rate in rotation. It is never extrapolated, and not interpolated across a gap (a neighbour 0.1 s or more away),
    a jump, or an unusable pose.

    Args:
        where: Origin of the poses, for messages.
        max_speed_mps: Poses further apart than this speed allows are a jump, in metres a second.
        max_turn_dps: The same in degrees a second.
        clock: Monotonic seconds, for waiting.

    Attributes:
        added: Number of poses that were added.
        counts: How many were `unusable`, `late` (older than an earlier one), `repeated`, `clock_reset`,
            `jumps`.
        delays: Delays of the poses, by `clock`.
    """

    def __init__(
        self,
        where: str = "poses",
        *,
        max_speed_mps: float = MAX_SPEED_MPS,
        max_turn_dps: float = MAX_TURN_DPS,
        clock: Callable[[], float] = monotonic,
    ):
        self.where, self.added = where, 0
        self.counts: Counter[str] = Counter()
        self._speed, self._turn, self._clock = max_speed_mps, np.radians(max_turn_dps), clock
        self._stamps: list[int] = []
        self._poses: dict[int, Transform] = {}
        self._unsure: set[int] = set()
        self._change, self._ended = Condition(), ""
        self._listeners: list[Callable[[], object]] = []
        self._late: list[_Late] = []
        self._said: tuple[int, NDArray[np.float64] | None, int] = (0, None, 0)
        self.delays = Delays()

    def add(
        self,
        stamp_ns: int,
        T_world_body: ArrayLike,
        confident: bool = True,
        covariance: ArrayLike | None = None,
        quality: int = 0,
    ) -> None:
        """Add a pose; the first of several with one stamp counts.

        Args:
            stamp_ns: Its time in int64 nanoseconds.
            T_world_body: (4, 4), maps the body (x forward, y left, z up) into the world (z up). A non-finite or
                non-rigid one is stored as unusable, and frames that need it are refused: pass NaN if a tracker is lost.
            confident: Whether its tracker trusts it; if not, the pose is unusable, too.
            covariance: (6, 6) of a small rotation about the body (radians), then of its shift (metres), along the
                world's axes; None: unknown. An autopilot gets it (`PoseSender`).
            quality: 1 to 100 per cent, 0 unknown; for an autopilot, too.
        """
        stamp_ns, T = int(stamp_ns), np.array(T_world_body, float)
        if not confident:
            self._unsure.add(stamp_ns)
            T = np.full((4, 4), np.nan)
        if rigidity_error(T) > RIGID or not np.isfinite(T).all():
            self.counts["unusable"] += 1
            T = np.full((4, 4), np.nan)
        now_ns = round(1e9 * self._clock())
        self.delays.heard(stamp_ns, now_ns)
        with self._change:
            self.added += 1
            self._said = stamp_ns, None if covariance is None else np.array(covariance, float), int(quality)
            self._take(stamp_ns, T, now_ns)
            self._change.notify_all()
        for tell in self._listeners:
            tell()

    def at(self, stamp_ns: int, wait_s: float = 0.0) -> Transform:
        """Return T_world_body (4, 4) at a time, once both its neighbours have arrived.

        Args:
            stamp_ns: The time in nanoseconds, by the clock of the poses.
            wait_s: Longest wait for a pose that is not earlier, in seconds.

        Returns:
            The pose at exactly that time, else interpolated between its neighbours.

        Raises:
            FrameRefused: `no_pose` if a neighbour did not arrive in time or is 0.1 s or more away, `pose_jump` if
                the body jumped between them, `low_confidence` if its tracker does not trust a neighbour,
                `bad_pose_file` if a neighbour is unusable for another reason.
        """
        stamp_ns = int(stamp_ns)
        with self._change:
            if wait_s > 0:
                end = self._clock() + wait_s
                while not self._is_final(stamp_ns) and (left := end - self._clock()) > 0:
                    self._change.wait(left)
            near, ended = self._near(stamp_ns), self._ended
            poses = [self._poses[stamp] for stamp in near]
            unsure = [stamp for stamp in near if stamp in self._unsure]
        if not near:
            raise FrameRefused("no_pose", f"{self.where}: {ended or 'no pose has arrived yet'}")
        if near[0] - stamp_ns > CLOCKS_APART_NS or stamp_ns - near[-1] > CLOCKS_APART_NS:
            raise FrameRefused("no_pose", self._apart(stamp_ns, near))
        try:
            found = Poses(near, poses, where=self.where).at(stamp_ns)
        except FrameRefused as refused:
            if ended and refused.reason == "no_pose":
                raise FrameRefused("no_pose", f"{refused} ({ended})") from None
            if unsure and refused.reason == "bad_pose_file":
                said = f"{self.where}: the tracker does not trust its pose at {seconds_from_ns(unsure[0])} s"
                raise FrameRefused("low_confidence", f"{said}; leave the image out") from None
            raise
        if len(near) == 2 and self._is_jump(near, poses):
            times = " and ".join(seconds_from_ns(stamp) for stamp in near)
            raise FrameRefused("pose_jump", f"{self.where}: the body jumped between {times} s; leave the image out")
        return found

    def between(self, first_ns: int, last_ns: int) -> Poses | None:
        """Return the poses of a time span, with one more at either end; None if there are fewer than two."""
        with self._change:
            begin = max(bisect_left(self._stamps, first_ns) - 1, 0)
            stamps = self._stamps[begin : bisect_left(self._stamps, last_ns) + 1]
            poses = [self._poses[stamp] for stamp in stamps]
        return Poses(stamps, poses, where=self.where) if len(stamps) > 1 else None

    def is_final(self, stamp_ns: int) -> bool:
        """Return whether the result of `at` is final: a pose that is not earlier arrived, or no more will arrive."""
        with self._change:
            return self._is_final(int(stamp_ns))

    def end(self, why: str) -> None:
        """Report that no more poses will arrive, and why in a few words; all waiting threads continue."""
        with self._change:
            self._ended = why
            self._change.notify_all()
        for tell in self._listeners:
            tell()

    def resume(self) -> None:
        """Report that poses arrive again."""
        with self._change:
            self._ended = ""

    def listen(self, tell: Callable[[], object]) -> None:
        """Call `tell` after each pose, in the thread that adds it."""
        self._listeners.append(tell)

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose; None without any."""
        with self._change:
            return self._stamps[-1] if self._stamps else None

    @property
    def newest(self) -> NewestPose | None:
        """The newest pose, NaN if it is unusable; None without any."""
        with self._change:
            if not self._stamps:
                return None
            stamp_ns, (of_ns, covariance, quality) = self._stamps[-1], self._said
            said = (covariance, quality) if of_ns == stamp_ns else (None, 0)
            return NewestPose(stamp_ns, self._poses[stamp_ns], *said)

    def __len__(self) -> int:
        return len(self._stamps)

    def _take(self, stamp_ns: int, T: Transform, now_ns: int) -> None:
        """Add a pose; drop those of another clock if it was set back."""
        newest = self._stamps[-1] if self._stamps else stamp_ns
        if stamp_ns < newest - RESET_NS:
            self._reset(-1)
        elif self._stamps and stamp_ns <= newest:
            if self._late and stamp_ns <= self._late[-1].stamp_ns:
                self._insert_late()
            self._late.append(_Late(stamp_ns, T, now_ns))
            if newest - stamp_ns <= REORDERED_NS:
                self._insert(stamp_ns, T)
            if len(self._late) >= SET_BACK:
                self._decide()
            return
        self._insert_late()
        self._insert(stamp_ns, T)

    def _decide(self) -> None:
        """Insert late poses: among the earlier ones if they arrive all at once; else they use a new clock."""
        first, last = self._late[0], self._late[-1]
        if 2 * (last.arrived_ns - first.arrived_ns) > last.stamp_ns - first.stamp_ns:
            self._reset(first.stamp_ns)
        self._insert_late()

    def _reset(self, before_ns: int) -> None:
        """Drop all poses from a time on, because the clock was set back. -1: all."""
        self.counts["clock_reset"] += 1
        left = 0 if before_ns < 0 else bisect_left(self._stamps, before_ns)
        for stamp in self._stamps[left:]:
            del self._poses[stamp]
        del self._stamps[left:]
        self._unsure &= self._poses.keys()

    def _insert_late(self) -> None:
        late, self._late = self._late, []
        for one in late:
            if one.stamp_ns not in self._poses:
                self._insert(one.stamp_ns, one.T)

    def _insert(self, stamp_ns: int, T: Transform) -> None:
        stamps = self._stamps
        if stamp_ns in self._poses:
            self.counts["repeated"] += 1
            return
        if stamps and stamp_ns < stamps[-1]:
            self.counts["late"] += 1
        if len(stamps) >= KEPT:
            for old in stamps[: KEPT // 2]:
                del self._poses[old]
            del stamps[: KEPT // 2]
            self._unsure &= self._poses.keys()
        self._poses[stamp_ns] = T
        insort(stamps, stamp_ns)
        if len(stamps) > 1 and stamps[-1] == stamp_ns:
            last = stamps[-2:]
            if self._is_jump(last, [self._poses[stamp] for stamp in last]):
                self.counts["jumps"] += 1

    def _is_final(self, stamp_ns: int) -> bool:
        return bool(self._ended) or bool(self._stamps and self._stamps[-1] >= stamp_ns)

    def _near(self, stamp_ns: int) -> list[int]:
        """Return the stamp of the pose at that time, else those before and after it, as far as available."""
        if stamp_ns in self._poses:
            return [stamp_ns]
        after = bisect_left(self._stamps, stamp_ns)
        return self._stamps[max(after - 1, 0) : after + 1]

    def _is_jump(self, stamps: Sequence[int], poses: Sequence[Transform]) -> bool:
        """Return whether the body moved or turned too fast from one pose to the next; False if one is unusable."""
        before, after = poses
        if not (np.isfinite(before).all() and np.isfinite(after).all()):
            return False
        seconds = max((stamps[1] - stamps[0]) / 1e9, 1e-3)
        moved = float(np.linalg.norm(after[:3, 3] - before[:3, 3]))
        turned = float(np.linalg.norm(rotation_vector(before[:3, :3].T @ after[:3, :3])))
        return moved > self._speed * seconds or turned > self._turn * seconds

    def _apart(self, stamp_ns: int, near: list[int]) -> str:
        nearest = min(near, key=lambda stamp: abs(stamp - stamp_ns))
        offset = (stamp_ns - nearest) / 1e9
        return (
            f"{self.where}: the nearest pose is {abs(offset):.0f} s away from the image at {seconds_from_ns(stamp_ns)} "
            f"s, so their clocks differ; give clock_offset_s (about {offset:.3f}: image stamp - pose stamp)"
        )
