# SPDX-License-Identifier: Apache-2.0
"""The clock of a live camera: changes are noticed, measured from motion, and corrected.

`ClockWatch` notices images that arrive earlier or later than expected, which does not show whether their stamps are
wrong. The camera's own motion, tracked from its images, does: it fits the poses' motion at one clock offset. Until that
is found, an image is refused unless the body rests and its pose is the same either way.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.tracker import PoseTrack
from stereovox.config import Config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, Rays, Scan, name_of
from stereovox.geometry.se3 import Transform, apart
from stereovox.sources.poses.clock_watch import CLOCK, LATE, START_NS, ClockDoubt, ClockWatch, Delays, Heard
from stereovox.sources.poses.poses import Poses
from stereovox.track.tracker import Tracker

REASON = "clock_doubt"
"""Reason of refusal of images whose clock may be wrong."""
TELL_NS, REMIND_NS = 300_000_000, 10_000_000_000
"""How long a doubt lasts until the user is informed, and until the user is informed again."""
SAME_M, SAME_RAD, SAMPLES = 0.02, np.radians(0.5), 5
"""A body rests if it moves by less between the two possible times of an image, at this many samples."""
BEFORE_NS, AFTER_NS = 500_000_000, 300_000_000
"""How much longer, and how much less, an image may take to arrive than poses."""
GRID_NS, ALIKE_NS = 20_000_000, 100_000_000
"""Step between tried offsets, and difference below which two are not distinguished."""
APART = 0.4
"""The same for small changes of the delay, as a share: zero must be distinguishable from the whole change."""
PAIR_NS, LONGEST_NS, MOST_PAIRS = 200_000_000, 450_000_000, 60
"""Least and largest time between the images of a pair, and number of latest pairs compared."""
FEWEST, COVERED = 8, 0.6
"""Fewest pairs needed, and least share of them within the poses' time span."""
TURN_RAD, WAY_M, CAP = np.radians(0.6), 0.015, 25.0
"""Errors of a tracked motion and of a mount, which scale misfits; cap on each squared misfit."""
EXPLAINED, UNIQUE, SURE = 0.25, 2.0, 25.0
"""An offset may leave at most this share of the motion; others must fit this many times worse, and by this much."""


class PosesNow(Protocol):
    """The poses of a body as they arrive."""

    def at(self, stamp_ns: int) -> Transform:
        """Return T_world_body (4, 4) at a time; raises FrameRefused."""
        ...

    def between(self, first_ns: int, last_ns: int) -> Poses | None:
        """Return the poses of a time span, None if there are fewer than two."""
        ...


class MotionClock:
    """Finds the error of image stamps, from their motion and the poses' motion.

    T_body_camera: (4, 4) float64, the mount of the camera.
    """

    def __init__(self, config: Config, T_body_camera: Transform, poses: PosesNow):
        self._tracker, self._mount, self._poses = Tracker(config), T_body_camera, poses
        self._tracked: list[tuple[int, Transform]] = []
        self._pairs: list[tuple[int, int, Transform]] = []

    def see(self, frame: AnyFrame) -> None:
        """Track an image, whose stamp is by the poses' clock as far as known."""
        tracked = self._tracker.add(frame)
        if tracked.lost:
            self._tracked.clear()
            if tracked.begins:
                self._pairs.clear()
            return
        now_ns, T_now = frame.stamp_ns, tracked.T_world_sensor
        for then_ns, T_then in reversed(self._tracked):
            if PAIR_NS <= now_ns - then_ns <= LONGEST_NS:
                self._pairs.append((then_ns, now_ns, np.linalg.inv(T_then) @ T_now))
                break
        self._tracked = [one for one in self._tracked if 0 < now_ns - one[0] <= LONGEST_NS] + [(now_ns, T_now)]
        del self._pairs[:-MOST_PAIRS]

    def shift_ns(self, low_ns: int, high_ns: int, alike_ns: int = ALIKE_NS) -> int | None:
        """Return the shift, between two limits, from stamps to the poses' clock; None if it is uncertain.

        Zero and its surroundings are always tried. alike_ns: difference of two fitting shifts that count as one.
        """
        if len(self._pairs) < FEWEST:
            return None
        first_ns, last_ns = self._pairs[0][0], self._pairs[-1][1]
        near = np.arange(-ALIKE_NS - GRID_NS, ALIKE_NS + 2 * GRID_NS, GRID_NS)
        shifts = np.unique(np.concatenate([np.arange(low_ns, high_ns + GRID_NS, GRID_NS), near])).astype(np.int64)
        misfits, moved = self._misfits(shifts, first_ns, last_ns)
        known = np.isfinite(misfits).any(axis=1)
        if not known.any():
            return None
        usual = np.full(len(shifts), np.inf)
        usual[known] = np.nanmean(misfits[known], axis=1)
        best = int(np.argmin(usual))
        if usual[best] > EXPLAINED * moved or not self._is_unique(
            np.abs(shifts - shifts[best]) > alike_ns, misfits, usual, best
        ):
            return None
        return int(shifts[best])

    def _is_unique(
        self, others: NDArray[np.bool_], misfits: NDArray[np.float64], usual: NDArray[np.float64], best: int
    ) -> bool:
        """Return whether all other offsets fit clearly worse, among those with known poses."""
        for k in np.flatnonzero(np.isfinite(usual) & others):
            both = np.isfinite(misfits[k]) & np.isfinite(misfits[best])
            here, there = misfits[best][both].sum(), misfits[k][both].sum()
            if there < UNIQUE * here or there - here < SURE:
                return False
        return True

    def _misfits(self, shifts: NDArray[np.int64], first_ns: int, last_ns: int) -> tuple[NDArray[np.float64], float]:
        """Return squared misfits (shifts, pairs), NaN if no poses are near, and how much the camera moved."""
        from scipy.spatial.transform import Rotation

        observed = np.array([T for _, _, T in self._pairs])
        misfits = np.full((len(shifts), len(self._pairs)), np.nan)
        for part in _near_each_other(shifts):
            poses = self._poses.between(first_ns + int(shifts[part[0]]), last_ns + int(shifts[part[-1]]))
            try:
                track = None if poses is None else PoseTrack(poses, 0.0, 10.0, 720.0)
            except StereovoxError:  # no usable pose among these
                track = None
            if track is None or len(track.times) < 2:
                continue
            starts, ends = (
                (np.array([pair[end] for pair in self._pairs], np.int64) - track.start_ns) / 1e9 for end in (0, 1)
            )
            for k in part:
                begun, ended = starts + shifts[k] / 1e9, ends + shifts[k] / 1e9
                inside = (track.parts(begun) >= 0) & (track.parts(begun) == track.parts(ended))
                if inside.sum() < max(FEWEST, COVERED * len(self._pairs)):
                    continue
                first, then = track.at(begun[inside]) @ self._mount, track.at(ended[inside]) @ self._mount
                left = np.linalg.inv(np.linalg.inv(first) @ then) @ observed[inside]
                misfits[k, inside] = _squares(left, Rotation)
        return misfits, float(np.mean(_squares(observed, Rotation)))


class CameraClock:
    """Watches the clock of one camera against the poses' clock, notifies the user, and corrects it.

    Args:
        name: Name of the camera, for messages.
        poses: Poses of the body.
        delays: Their delays, updated by their receiver.
        T_body_camera: (4, 4) float64, the mount.
        notify: Called with each line that a user should see.
        cure: Returns the user's cure, from the doubt and the seconds by which the clock is ahead of the poses'.
        background: Whether images are tracked in a thread.
        start_ns: Largest difference in arrival of images and poses of the same time at the start.

    Attributes:
        config: Settings, for tracking.
        shift_ns: Shift found from motion, to be added to stamps.
    """

    def __init__(
        self,
        name: str,
        poses: PosesNow,
        delays: Delays,
        T_body_camera: Transform,
        config: Config,
        notify: Callable[[str], object],
        cure: Callable[[ClockDoubt, float], str],
        background: bool = True,
        start_ns: int = START_NS,
    ):
        self.config, self.shift_ns = config, 0
        self._name, self._poses, self._mount = name, poses, T_body_camera
        self._notify, self._how = notify, cure
        self._delays, self._watch = delays, ClockWatch(delays, start_ns)
        self._motion: MotionClock | None = None
        self._doubt: ClockDoubt | None = None
        self._told_ns = 0
        self._worker = ThreadPoolExecutor(1, thread_name_prefix="stereovox-clock") if background else None
        self._seeing: Future[None] | None = None
        self._failed = ""

    def heard(self, stamp_ns: int, arrived_ns: int) -> Heard:
        """Record the stamp of an image, corrected. arrived_ns: monotonic."""
        set_back = self._delays.set_back
        return Heard(self._watch.heard(stamp_ns, arrived_ns), set_back)

    def doubts(self, heard: Heard) -> bool:
        """Return whether `check` has anything to do."""
        return self._doubt_of(heard) is not None or heard.set_back != self._delays.set_back

    def check(self, frame: AnyFrame | Scan, heard: Heard, now_ns: int) -> None:
        """Learn from an image, in its turn; raises FrameRefused if its pose is not certain.

        frame: with the stamp that was `heard`. now_ns: monotonic.
        """
        doubt = self._doubt_of(heard)
        if doubt is not None and doubt is self._watch.doubt:
            self._learn(frame, doubt, now_ns)
        if doubt is not None and not doubt.cleared:
            if doubt.became not in (LATE, CLOCK) and self._rests(frame.stamp_ns, doubt):
                return
            said = f"{doubt_words(doubt)}, and which is not known; {self._cure(doubt)}"
            raise FrameRefused(REASON, f"{name_of(frame)}: {said}")
        if heard.set_back != self._delays.set_back:
            raise FrameRefused(REASON, f"{name_of(frame)}: the clock of the poses was set back while it waited")

    def close(self) -> None:
        """Stop background work."""
        if self._worker is not None:
            self._worker.shutdown(wait=False, cancel_futures=True)

    def _doubt_of(self, heard: Heard) -> ClockDoubt | None:
        return heard.doubt if heard.judged else heard.doubt or self._watch.doubt

    def _cure(self, doubt: ClockDoubt) -> str:
        how = self._how(doubt, -(self.shift_ns + doubt.off_ns) / 1e9)
        return how if self._failed else f"move the camera until its motion shows it, or {how}"

    def _learn(self, frame: AnyFrame | Scan, doubt: ClockDoubt, now_ns: int) -> None:
        """Track an image during a doubt, and end the doubt once its motion decides it; notify the user of both."""
        if doubt is not self._doubt:
            self._doubt, self._motion, self._failed, self._told_ns = doubt, None, "", now_ns
        if isinstance(frame, Rays | Scan):
            self._failed = "clouds, ranges and scans do not show it"
        if not doubt.told and (doubt.announced or now_ns - doubt.since_ns > TELL_NS):
            doubt.told, self._told_ns = True, now_ns
            self._notify(f"{self._name}: {doubt_words(doubt)}; images are left out while it moves; {self._cure(doubt)}")
        elif doubt.told and now_ns - self._told_ns > REMIND_NS:
            self._told_ns = now_ns
            why = self._failed or "its motion does not show it"
            self._notify(f"{self._name}: {doubt_words(doubt)}, and {why}; {self._cure(doubt)}")
        if isinstance(frame, Rays | Scan) or (self._seeing is not None and not self._seeing.done()):
            return
        if self._motion is None:
            self._motion = MotionClock(self.config, self._mount, self._poses)
        bare = replace(frame, T_world_sensor=np.full((4, 4), np.nan))
        if self._worker is None:
            self._see(self._motion, bare, doubt)
        else:
            self._seeing = self._worker.submit(self._see, self._motion, bare, doubt)

    def _see(self, motion: MotionClock, frame: AnyFrame, doubt: ClockDoubt) -> None:
        try:
            motion.see(frame)
            low_ns, high_ns = _range(doubt)
            alike_ns = ALIKE_NS if doubt.start else min(ALIKE_NS, round(APART * abs(doubt.off_ns)))
            shift_ns = motion.shift_ns(low_ns, high_ns, alike_ns)
        except StereovoxError as error:
            self._failed = str(error)
            return
        if shift_ns is None or doubt is not self._watch.doubt:
            return
        late = f"by {doubt.off_ns / 1e9:+.2f} s"
        if abs(shift_ns) <= alike_ns:
            self._watch.late()
            self._notify(f"{self._name}: its motion shows that images come later {late}, and stamps are right")
            return
        if not doubt.start and abs(shift_ns - doubt.off_ns) <= alike_ns:
            shift_ns = doubt.off_ns  # arrivals are more exact
        self.shift_ns += shift_ns
        self._watch.corrected()
        self._notify(
            f"{self._name}: its motion shows that its clock is {-shift_ns / 1e9:+.3f} s off that of the poses, "
            "which is corrected from now on"
        )

    def _rests(self, stamp_ns: int, doubt: ClockDoubt) -> bool:
        """Return whether the pose is the same at all possible times of an image."""
        low_ns, high_ns = _range(doubt) if doubt.start else Limits(min(doubt.off_ns, 0), max(doubt.off_ns, 0))
        times = np.linspace(stamp_ns + min(low_ns, 0), stamp_ns + max(high_ns, 0), SAMPLES).astype(np.int64).tolist()
        try:
            first, *others = [self._poses.at(time_ns) for time_ns in (stamp_ns, *times)]
        except FrameRefused:
            return False
        return all(
            metres <= SAME_M and angle <= SAME_RAD
            for metres, angle in (apart(_numbers(first), _numbers(one)) for one in others)
        )


class Limits(NamedTuple):
    """Least and most nanoseconds."""

    low_ns: int
    high_ns: int


def _range(doubt: ClockDoubt) -> Limits:
    """Return the range of possible shifts of stamps.

    At the start the delays of camera and poses are unknown; later it is zero or the change of the delay.
    """
    if doubt.start:
        return Limits(doubt.off_ns - BEFORE_NS, doubt.off_ns + AFTER_NS)
    return Limits(min(doubt.off_ns, 0) - AFTER_NS, max(doubt.off_ns, 0) + AFTER_NS)


def doubt_words(doubt: ClockDoubt) -> str:
    """Return the doubt in words."""
    seconds, later = abs(doubt.off_ns) / 1e9, doubt.off_ns > 0
    if doubt.start:
        clock = f"its clock is {'behind' if later else 'ahead of'} that of the poses"
        return f"images come {seconds:.2f} s {'later' if later else 'earlier'} than poses of the same time, or {clock}"
    clock = f"its clock was set {'back' if later else 'ahead'} by this much"
    return f"images come {seconds:.2f} s {'later' if later else 'earlier'} than before, or {clock}"


def _near_each_other(shifts: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Return the indices of ascending shifts, split at gaps of a second or more."""
    return np.split(np.arange(len(shifts)), np.flatnonzero(np.diff(shifts) > 1_000_000_000) + 1)


def _squares(T: NDArray[np.float64], rotation: type) -> NDArray[np.float64]:
    """Return the squared misfits (N,), at most CAP, of motions (N, 4, 4) from the identity."""
    turns = rotation.from_matrix(T[:, :3, :3]).magnitude() / TURN_RAD
    ways = np.linalg.norm(T[:, :3, 3], axis=1) / WAY_M
    return np.minimum(turns**2 + ways**2, CAP)


def _numbers(T: Transform) -> tuple[float, ...]:
    return tuple(T.ravel()[:12].tolist())
