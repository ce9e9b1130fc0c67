# SPDX-License-Identifier: Apache-2.0
"""The last check before a frame may change the map: does it fit to the frames before it, and to the map?"""

from __future__ import annotations

import zlib
from math import inf, radians
from typing import NamedTuple

import numpy as np

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, DepthImage, Scan, StereoFrame, name_of
from stereovox.se3 import apart
from stereovox.trust.history import (
    CHANGED,
    MAX_NAME_LENGTH,
    MAX_SENSORS,
    MOVED,
    Doubt,
    History,
    Look,
    Seen,
    Streak,
    Usual,
)

WHY = {"": "disagrees_with_map", CHANGED: "disagrees_with_map", MOVED: "camera_moved"}
"""Reasons by the verdict on a doubt."""
USUAL_AT_FIRST, USUAL_GAIN = Usual(0.25, 0.06), 0.2
"""Disagreement that a sensor is taken for at first, and how quickly it follows its frames (exponential mean)."""
SPREADS = 4
"""Spreads beyond the mean that are usual."""
MAX_LIMIT = 0.8
"""Disagreement that is too much whatever is usual."""
AGAIN = 0.6
"""Share of what a frame may disagree beyond the usual up to which one ends a doubt: it must really agree."""
SOON_S, LATE_S = 0.2, 1.0
"""What comes later than so many seconds after the frame before may disagree more, in proportion, up to twice as much
after one second more: it sees much that is new, and the world had time to change."""
MIN_FRAMES = 5
"""Frames that must disagree before anything is made of it, however far apart they were taken."""
FITS = 1 / 3
"""Share of the frames that agree from elsewhere where it is the camera that was moved: some find no such place."""
UNTIMED_HZ = 30
"""Frames a second where stamps stand still."""


class Judged(NamedTuple):
    """A frame that is believed: how far it disagrees with the map (None: that cannot be told), and the doubt that
    remains. `after`: what it is believed again after ("": it was never doubted)."""

    against: float | None
    doubt: Doubt | None = None
    after: str = ""


class Belief:
    """Compares the disagreement of each frame with that of its sensor of late; what it remembers is in `history`.

    A frame that disagrees more is refused. Where at least MIN_FRAMES have done so for `trust.changed_s`, the world
    has changed: they are believed until they agree again. But where they would agree if the camera stood elsewhere, it
    is the camera that was moved, or its tracker that is wrong: it is not believed until it agrees again, or has
    disagreed for `trust.moved_s`; nor is what sees nothing known, for the next frames would agree with that.
    Other frames that see nothing known cannot be judged, and are believed.
    """

    def __init__(self, config: Config, history: History):
        self._history, self._trust = history, config.trust
        self._excess = max(config.trust.max_disagreement, config.trust.pose_error_m / config.voxel_size)
        self._changed_ns = round(1e9 * config.trust.changed_s)
        self._moved_ns = round(1e9 * config.trust.moved_s)

    def limit(self, sensor: str, stamp_ns: int, share: float = 1.0) -> float:
        """Return how far a frame may disagree with the map, 0 to 1; `share`: of what it may beyond the usual."""
        mean, spread = self._history.usual.get(sensor, USUAL_AT_FIRST)
        late_s = 1e-9 * (stamp_ns - self._last_ns(sensor, stamp_ns)) - SOON_S
        share *= 1 + min(max(late_s / LATE_S, 0.0), 1.0)
        return min(mean + share * max(self._excess, mean, SPREADS * spread), MAX_LIMIT)

    def _last_ns(self, sensor: str, now_ns: int) -> int:
        """Return the stamp of the frame before, believed or in doubt; that of now where there is none."""
        stamps_ns = [self._history.doubts[sensor].last_ns] if sensor in self._history.doubts else []
        stamps_ns += [self._history.trusted[sensor].stamp_ns] if sensor in self._history.trusted else []
        return max(stamps_ns, default=now_ns)

    def limit_elsewhere(self, sensor: str, stamp_ns: int, against: float | None) -> float | None:
        """Return how far a frame may disagree that is to be looked at from elsewhere; None for one that is not.

        Those are to be that disagree while it is open whether the world has changed or the camera was moved.
        """
        doubt, limit = self._history.doubts.get(sensor), self.limit(sensor, stamp_ns)
        settled = (
            (doubt is not None and doubt.verdict) or against is None or self._agrees(doubt, sensor, stamp_ns, against)
        )
        return None if settled else limit

    def check(self, frame: AnyFrame, sensor: str, stamp_ns: int, against: float | None, fits: bool) -> Judged:
        """Return what `took` is to remember once the map has changed.

        against: share of what the frame says that is against the map; None: too little is known. fits: whether it
        would agree from elsewhere (`limit_elsewhere`). Raises FrameRefused: `disagrees_with_map`, `camera_moved`.
        """
        doubt, limit = self._history.doubts.get(sensor), self.limit(sensor, stamp_ns)
        if against is None and not (doubt and doubt.verdict == MOVED):
            return Judged(None, doubt)
        if against is not None and self._agrees(doubt, sensor, stamp_ns, against):
            return Judged(against)
        waited = doubt is not None and doubt.verdict == CHANGED
        doubt = self._judged(Doubt(stamp_ns, stamp_ns) if doubt is None else doubt.going_on(stamp_ns), fits)
        enough_ns = self._moved_ns if doubt.verdict == MOVED else self._changed_ns
        if self._lasted(doubt, enough_ns):
            return Judged(against, doubt._replace(verdict=CHANGED), "" if waited else WHY[doubt.verdict])
        self._remember(sensor, doubt)
        raise self._refused(frame, against, limit, doubt)

    def _agrees(self, doubt: Doubt | None, sensor: str, stamp_ns: int, against: float) -> bool:
        return against <= self.limit(sensor, stamp_ns, AGAIN if doubt else 1.0)

    def _judged(self, doubt: Doubt, fits: bool) -> Doubt:
        """Return a doubt with its verdict, where it has lasted long enough for one."""
        if doubt.verdict:
            return doubt
        doubt = doubt._replace(fits=doubt.fits + fits)
        if not self._lasted(doubt, self._changed_ns):
            return doubt
        return doubt._replace(verdict=MOVED if doubt.fits >= FITS * (doubt.frames + 1) else CHANGED)

    def _lasted(self, doubt: Doubt, enough_ns: float) -> bool:
        return doubt.lasted_ns(UNTIMED_HZ) >= enough_ns and (doubt.frames >= MIN_FRAMES or enough_ns == 0)

    def took(self, sensor: str, judged: Judged) -> None:
        """Remember a frame that the map took in."""
        if judged.doubt is not None:
            self._remember(sensor, judged.doubt)
        elif judged.against is not None:
            self._history.doubts.pop(sensor, None)
            self._history.usual[sensor] = self._history.usual.get(sensor, USUAL_AT_FIRST).after(
                judged.against, USUAL_GAIN
            )

    def _remember(self, sensor: str, doubt: Doubt) -> None:
        if sensor in self._history.doubts or len(self._history.doubts) < MAX_SENSORS:
            self._history.doubts[sensor] = doubt

    def _refused(self, frame: AnyFrame, against: float | None, limit: float, doubt: Doubt) -> FrameRefused:
        if doubt.verdict == MOVED:
            said = "it would agree with the map from elsewhere; calibrate where the camera is, or reset the tracker"
        else:
            said = f"it disagrees with the map ({against or 0:.0%} of what it says, {limit:.0%} may)"
        seconds = self._trust.moved_s if doubt.verdict == MOVED else self._trust.changed_s
        said += f"; believed once frames do for {seconds:g} s"
        return FrameRefused(WHY[doubt.verdict], f"{name_of(frame)}: {said}")


SLACK_M, SLACK_RAD = 0.05, radians(2)
"""Poses are noisy: so much is no jump, however short the time."""
BACKWARDS, RESET, JUMP = "stamp_backwards", "clock_reset", "pose_jump"
STILL_M, STILL_RAD = 0.01, radians(0.5)
"""So far a camera that stands seems to move where its tracker trembles."""
LOOK_ROWS = 16
"""Rows of an image by which it is known again."""
ROUGH, ROUGH_SHARE = 1e-3, 0.2
"""Measured depths bend by so much of themselves at least, at so many pixels; walls without noise do not, and look the
same from many places."""


class Passed(NamedTuple):
    """A frame that fits: of which sensor, where it stood, and what it was believed again after (mostly: nothing).

    look: which image it is; None for scans. judged: how it fits to the map; None where it was not compared.
    """

    sensor: str
    seen: Seen
    after: str = ""
    look: Look | None = None
    judged: Judged | None = None

    @property
    def told(self) -> str:
        """What a report says about it."""
        return f"frames of '{self.sensor}' are believed again after {self.after}" if self.after else ""


class Gate:
    """Watches stamps and poses of each sensor. What it remembers is in `history`, which is saved with the map.

    A frame that jumped, or whose clock was reset, is refused; so are those after it that belong to it. When they have
    agreed with each other for `trust.settle_s` (by their stamps) they are believed again: a tracker that found itself
    anew is not refused for ever. A frame belongs to the refused ones, and not to the trusted one, where it would have
    to move slower from there. One that fits to the trusted one ends the waiting of the others.
    """

    def __init__(self, config: Config, history: History):
        trust = config.trust
        self._history, self._trust, self._belief = history, trust, Belief(config, history)
        self._turn = radians(trust.max_turn_dps)
        off, reset, ahead, settle = trust.max_pose_off_s, trust.clock_reset_s, trust.max_gap_s, trust.settle_s
        self._off_ns, self._reset_ns, self._ahead_ns, self._settle_ns = (
            round(1e9 * seconds) for seconds in (off, reset, ahead, settle)
        )

    def check(self, frame: AnyFrame | Scan, image: DepthImage | Scan) -> Passed:
        """Return what `took` is to remember once the map has changed.

        image: holds the frame's pose, exactly rigid. Raises FrameRefused: `bad_sensor`, `pose_extrapolated`,
        `stamp_backwards`, `clock_reset`, `pose_jump`, `frozen_image`. Of a refused frame nothing is remembered but that
        it may agree with the next one.
        """
        sensor, stamp_ns = self._told(frame)
        numbers = image.T_world_sensor.ravel().tolist()
        now = Seen(stamp_ns, tuple(numbers[:12]))
        passed = self._fitting(frame, sensor, now)._replace(look=self._look(frame, sensor, now))
        if passed.after:
            self._history.doubts.pop(sensor, None)  # they were of another place, or another time
        return passed

    def limit_elsewhere(self, passed: Passed, against: float | None) -> float | None:
        """Return as `Belief.limit_elsewhere`."""
        return self._belief.limit_elsewhere(passed.sensor, passed.seen.stamp_ns, against)

    def believe(self, frame: AnyFrame, passed: Passed, against: float | None, fits: bool) -> Passed:
        """Return what `took` is to remember of a frame that was compared with the map.

        Arguments, and what it raises: as of `Belief.check`.
        """
        judged = self._belief.check(frame, passed.sensor, passed.seen.stamp_ns, against, fits)
        return passed._replace(judged=judged, after=passed.after or judged.after)

    def took(self, passed: Passed) -> None:
        """Remember a frame that the map took in."""
        self._history.trusted[passed.sensor] = passed.seen
        self._history.waiting.pop(passed.sensor, None)
        if passed.look is not None:
            self._history.looks[passed.sensor] = passed.look
        if passed.judged is not None:
            self._belief.took(passed.sensor, passed.judged)
        if passed.after:
            self._history.settled[passed.after] += 1

    def _look(self, frame: AnyFrame | Scan, sensor: str, now: Seen) -> Look | None:
        """Return which image a frame is. Raises FrameRefused where it is the last one although the camera has moved."""
        if isinstance(frame, Scan) or not self._trust.frozen:
            return None
        look, before = Look(_digest(frame), now.pose), self._history.looks.get(sensor)
        if before is None or before.digest != look.digest:
            return look
        metres, angle = apart(before.pose, now.pose)
        if (metres > STILL_M or angle > STILL_RAD) and (isinstance(frame, StereoFrame) or _is_measured(frame.depth)):
            said = f"the image is the one before, from {metres:.3g} m and {np.degrees(angle):.1f} degrees away"
            raise FrameRefused("frozen_image", f"{name_of(frame)}: {said}; restart the camera")
        return before

    def _fitting(self, frame: AnyFrame | Scan, sensor: str, now: Seen) -> Passed:
        """Return a frame that fits to the trusted one before, or is believed again."""
        trusted = self._history.trusted.get(sensor)
        if trusted is None:
            if len(self._history.trusted) >= MAX_SENSORS:
                raise FrameRefused("bad_sensor", f"{name_of(frame)}: more than {MAX_SENSORS} sensors; name fewer")
            return Passed(sensor, now)
        why, haste = self._against(trusted, now)
        waiting = self._history.waiting.get(sensor)
        if waiting is None and not why:
            return Passed(sensor, now)
        return self._settled(frame, Passed(sensor, now), trusted, (why, haste), waiting)

    def _told(self, frame: AnyFrame | Scan) -> tuple[str, int]:
        """Return sensor and stamp of a frame whose form was checked (`depth.form`); refuse poses that are too old."""
        off_ns = abs(int(frame.pose_off_ns))
        if off_ns > self._off_ns:
            limit = f"trust.max_pose_off_s {self._trust.max_pose_off_s:g}"
            said = f"{name_of(frame)}: its pose is extrapolated by {off_ns / 1e9:.3f} s ({limit}); give poses in time"
            raise FrameRefused("pose_extrapolated", said)
        if len(frame.sensor) > MAX_NAME_LENGTH or not frame.sensor.isprintable():
            said = f"sensor is no word of at most {MAX_NAME_LENGTH} letters that can be shown; name it otherwise"
            raise FrameRefused("bad_sensor", f"{name_of(frame)}: {said}")
        return frame.sensor or ("scan" if isinstance(frame, Scan) else "camera"), int(frame.stamp_ns)

    def _against(self, before: Seen, now: Seen) -> tuple[str, float]:
        """Return why `now` cannot follow `before` ("": it can), and its speed as a share of what is allowed."""
        ahead_ns = now.stamp_ns - before.stamp_ns
        if self._trust.ordered and (ahead_ns < 0 or ahead_ns > self._ahead_ns):
            return (BACKWARDS if -self._reset_ns <= ahead_ns < 0 else RESET), inf
        if ahead_ns <= 0:
            return "", 0.0  # taken at one time, as far as is known: no speed can be said
        metres, angle = apart(before.pose, now.pose)
        allowed = 1e-9 * ahead_ns
        moved, turned = (metres - SLACK_M) / self._trust.max_speed_mps, (angle - SLACK_RAD) / self._turn
        haste = max(moved, turned) / allowed
        return (JUMP if haste > 1 else ""), haste

    def _settled(
        self, frame: AnyFrame | Scan, passed: Passed, trusted: Seen, found: tuple[str, float], waiting: Streak | None
    ) -> Passed:
        """Return the frame where it may be believed, although it does not fit or others wait; else refuse it."""
        (why, haste), now = found, passed.seen
        follows, slower = False, False
        if waiting is not None:
            unfit, their_haste = self._against(waiting.last, now)
            follows, slower = not unfit, their_haste < haste
        if not why and not (follows and slower):
            return passed
        if waiting is not None and follows:
            why, since_ns = waiting.why, waiting.since_ns
        else:
            since_ns = now.stamp_ns
        detail = f"{name_of(frame)}: {self._detail(why, trusted, now)}"
        if why == BACKWARDS:
            raise FrameRefused(why, detail)
        if now.stamp_ns - since_ns >= self._settle_ns:
            return passed._replace(after=why)
        self._history.waiting[passed.sensor] = Streak(why, since_ns, now)
        raise FrameRefused(why, detail)

    def _detail(self, why: str, before: Seen, now: Seen) -> str:
        seconds = (now.stamp_ns - before.stamp_ns) / 1e9
        if why == BACKWARDS:
            return f"taken {-seconds:.6g} s before the last trusted one; put frames in order or set trust.ordered=false"
        until = f"believed again once frames agree for {self._trust.settle_s:g} s"
        if why == RESET:
            return f"its clock is {seconds:+.6g} s off the last trusted frame's, it was reset; {until}"
        metres, angle = apart(before.pose, now.pose)
        return (
            f"the pose jumped by {metres:.3g} m and {round(angle * 57.29578, 1):g} degrees in {seconds:.3g} s; {until}"
        )


def _rows(image: np.ndarray) -> np.ndarray:
    return image[LOOK_ROWS // 2 if len(image) > LOOK_ROWS else 0 :: max(1, len(image) // LOOK_ROWS)]


def _digest(frame: AnyFrame) -> int:
    """Return a number that is another one for another image, as far as LOOK_ROWS of its rows tell."""
    images = (frame.left, frame.right) if isinstance(frame, StereoFrame) else (frame.depth,)
    number = 0
    for image in images:
        number = zlib.crc32(np.ascontiguousarray(_rows(image)).tobytes(), number)
    return number


def _is_measured(depth: np.ndarray) -> bool:
    """Tell whether depths (height, width) have noise: whether inverse depth bends between neighbours."""
    rows = _rows(depth).astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(np.isfinite(rows) & (rows > 0), 1 / rows, np.nan)
        bend = np.abs(np.diff(inverse, 2, axis=1)) / inverse[:, 1:-1]
    bend = bend[np.isfinite(bend)]
    return bool(bend.size and (bend > ROUGH).mean() > ROUGH_SHARE)
