# SPDX-License-Identifier: Apache-2.0
"""Whether a frame that disagrees with the map is to be believed: not one alone, nor a camera that was knocked."""

from __future__ import annotations

from typing import NamedTuple

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, name_of
from stereovox.history import CHANGED, MOST_SENSORS, MOVED, Doubt, History, Usual

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
LEAST_FRAMES = 5
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

    A frame that disagrees more is refused. Where at least LEAST_FRAMES have done so for `trust.changed_s`, the world
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
        return doubt.lasted_ns(UNTIMED_HZ) >= enough_ns and (doubt.frames >= LEAST_FRAMES or enough_ns == 0)

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
        if sensor in self._history.doubts or len(self._history.doubts) < MOST_SENSORS:
            self._history.doubts[sensor] = doubt

    def _refused(self, frame: AnyFrame, against: float | None, limit: float, doubt: Doubt) -> FrameRefused:
        if doubt.verdict == MOVED:
            said = "it would agree with the map from elsewhere; calibrate where the camera is, or reset the tracker"
        else:
            said = f"it disagrees with the map ({against or 0:.0%} of what it says, {limit:.0%} may)"
        seconds = self._trust.moved_s if doubt.verdict == MOVED else self._trust.changed_s
        said += f"; believed once frames do for {seconds:g} s"
        return FrameRefused(WHY[doubt.verdict], f"{name_of(frame)}: {said}")
