# SPDX-License-Identifier: Apache-2.0
"""Frames that contradict the map: are they faulty, or has the world changed?"""

from __future__ import annotations

from typing import NamedTuple

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, Scan, name_of
from stereovox.maps.record.glance import Glance, Votes
from stereovox.maps.record.history import CHANGED, MAX_SENSORS, MOVED, DisagreementSpell, History, RunningMean

DISAGREES, CONTRADICTS, CAMERA_MOVED = "disagrees_with_map", "contradicts_map", "camera_moved"
"""Refusal reasons: while a doubt is young, once it has lasted for `trust.changed_s`, and if another pose fits."""
USUAL_AT_FIRST, USUAL_GAIN = RunningMean(0.25, 0.06), 0.2
"""Disagreement assumed of a new sensor, and the weight of each frame in the exponential mean."""
SPREADS = 4
"""How many spreads above the mean are still usual."""
MAX_LIMIT = 0.8
"""Disagreement that is always too much, whatever is usual."""
AGAIN = 0.6
"""Share of the tolerance above the usual that a frame may use if it is to end a doubt: it must clearly agree."""
SOON_S, LATE_S = 0.2, 1.0
"""More than SOON_S after the previous frame, a frame may disagree more: twice as much from LATE_S later on. It sees
much that is new, and the world had time to change."""
FITS = 1 / 6
"""Share of doubted frames that must agree from another pose for the verdict MOVED; only some are registered."""
UNTIMED_HZ = 30
"""Frame rate assumed if stamps do not advance."""
ANCHORED = 0.5
"""Share of a frame's points on known cells that must agree with the map: a change of the world is local."""
EXPLAINED = 0.4
"""Share of the disagreeing points that a fault must explain to count as the cause."""
MOSTLY_KNOWN, AGREES = 0.5, 0.95
"""Share of a frame's points that must be known, and share of these that must agree, to end a doubt that has lasted."""
FEW = 20
"""Fewer points than this are too few to judge by."""
DECISIVE = 0.2
"""Share of the contradicting points that must separate a changed world from a fault; fewer: the camera hardly moved."""
WORLDLY = 0.6
"""Share of these that must have stayed at their place in the world."""
LOOKS = 3
"""Frames in a row, each from another pose, in which a changed world must have stayed in place."""
PARTLY = "less than half of the known space that it sees is as mapped: it is elsewhere, or faulty"
CURES = {
    "moved": "it would agree from another pose; calibrate the sensor's mount, or reset the tracker",
    "unanchored": f"{PARTLY}; check the sensor, or start a new map",
    "still": "move the sensor: at rest, a fault looks the same as a changed world",
    "fixed": "the contradiction moves with the sensor; clean the sensor, or restart it",
    "restless": "the contradiction is never at the same place twice; check the sensor, or wait",
    "": "views from more places will decide",
}
"""Cause and cure of each outcome that keeps a doubt open."""


class Sight(NamedTuple):
    """How a frame in doubt fits the map, point by point.

    anchored: share of its points on known cells that agree with the map; None if less than MOSTLY_KNOWN of all points
    are known. fault: the fault under which it would agree, "" if none fits. against: how many points contradict the
    map. behind: how many points are on known surfaces, but seen through occupied cells. votes: where the previous
    glance saw the contradicting points. glance: what the frame sees.
    """

    anchored: float | None
    fault: str
    against: int
    behind: int
    votes: Votes
    glance: Glance

    @property
    def agrees(self) -> bool:
        """Whether it ends a doubt that has lasted: it sees much known space, and nearly all of it agrees."""
        return (self.anchored or 0.0) >= AGREES and not self.fault

    @property
    def decided(self) -> int:
        """How many points separate a changed world from a fault."""
        return self.votes.world + self.votes.sensor + self.votes.neither

    @property
    def decisive(self) -> bool:
        """Whether these are enough; they are few if the sensor has hardly moved."""
        return self.decided >= max(FEW, DECISIVE * self.against)

    @property
    def outcome(self) -> str:
        """The name of its fault, or a key of CURES; "" if it shows a changed world."""
        if self.fault:
            return self.fault
        if self.anchored is None or self.anchored < ANCHORED:
            return "unanchored"
        if self.behind >= max(FEW, WORLDLY * (self.behind + self.against)):
            return ""
        if not self.decisive:
            return "still"
        if self.votes.world >= WORLDLY * self.decided:
            return ""
        return "fixed" if self.votes.sensor > self.votes.neither else "restless"

    def kept(self, before: Glance | None) -> Glance:
        """Return the glance to compare the next frame with: a new one once both differ enough or hardly overlap."""
        in_view = sum(self.votes) >= max(FEW, DECISIVE * self.against)
        return before if before is not None and in_view and not self.decisive else self.glance


class Agreement(NamedTuple):
    """How an accepted frame agrees with the map.

    against: its disagreement, None if too little is known. doubt: the doubt that remains. after: the reason of the
    refusals that this acceptance ends, "" if there were none.
    """

    against: float | None
    doubt: DisagreementSpell | None = None
    after: str = ""


class DisagreementMonitor:
    """Judges each frame's disagreement with the map by that of its sensor's recent frames, kept in `history`.

    A frame that disagrees more is refused, and so are the next frames until one agrees again. The world counts as
    changed if, after `trust.changed_s` at least, LOOKS frames in a row saw the contradiction from different poses at
    one place of the world, while no fault explained it and half of the known points still agreed (`Sight.outcome`).
    From then on frames are accepted, as long as that holds, until they agree again. While a sensor is in doubt, its
    frames that see nothing known are refused, for the next ones would agree with them. Otherwise frames that see
    nothing known cannot be judged, and are accepted.
    """

    def __init__(self, config: Config, history: History):
        self._history, self._trust = history, config.trust
        self._excess = max(config.trust.max_disagreement, config.trust.pose_error_m / config.voxel_size)
        self._changed_ns = round(1e9 * config.trust.changed_s)

    def limit(self, sensor: str, stamp_ns: int, share: float = 1.0) -> float:
        """Return how far a frame may disagree with the map, 0 to 1; `share`: usable part of the tolerance."""
        mean, spread = self._history.usual.get(sensor, USUAL_AT_FIRST)
        late_s = 1e-9 * (stamp_ns - self._last_ns(sensor, stamp_ns)) - SOON_S
        share *= 1 + min(max(late_s / LATE_S, 0.0), 1.0)
        return min(mean + share * max(self._excess, mean, SPREADS * spread), MAX_LIMIT)

    def in_doubt(self, sensor: str, stamp_ns: int, against: float | None) -> bool:
        """Return whether `check` needs a `Sight` of the frame."""
        doubt = self._history.doubts.get(sensor)
        if against is None:
            return doubt is not None and doubt.verdict != CHANGED
        return not self._agrees(doubt, sensor, stamp_ns, against)

    def check(
        self, frame: AnyFrame | Scan, sensor: str, stamp_ns: int, against: float | None, sight: Sight | None
    ) -> Agreement:
        """Return what `accept` needs once the map has changed.

        against: share of the frame's evidence that contradicts the map, None if too little is known. sight: how it
        fits the map, if it is `in_doubt`. Raises FrameRefused: `disagrees_with_map`, `camera_moved`,
        `contradicts_map`.
        """
        before = self._history.doubts.get(sensor)
        if sight is None:
            return Agreement(against, before if against is None else None)
        limit = self.limit(sensor, stamp_ns)
        doubt = DisagreementSpell(stamp_ns, stamp_ns) if before is None else before.going_on(stamp_ns)
        if sight.agrees and self._lasted(doubt, self._changed_ns):
            return Agreement(1 - (sight.anchored or 0.0) if against is None else against)
        doubt = self._judged(doubt, sight)
        if doubt.verdict == CHANGED:
            waited = before is not None and before.verdict == CHANGED
            return Agreement(against, doubt, "" if waited or before is None else self._reason(before))
        if before is not None or not sight.agrees:  # otherwise only this frame is in doubt, not the next ones
            self._remember(sensor, doubt)
        raise self._refusal(frame, against, limit, doubt, sight)

    def accept(self, sensor: str, agreement: Agreement) -> None:
        """Remember a frame that was integrated."""
        if agreement.doubt is not None:
            self._remember(sensor, agreement.doubt)
        elif agreement.against is not None:
            self._history.doubts.pop(sensor, None)
            usual = self._history.usual.get(sensor, USUAL_AT_FIRST)
            self._history.usual[sensor] = usual.updated(agreement.against, USUAL_GAIN)

    def _last_ns(self, sensor: str, now_ns: int) -> int:
        """Return the stamp of the previous frame, accepted or in doubt; `now_ns` if there is none."""
        stamps_ns = [self._history.doubts[sensor].last_ns] if sensor in self._history.doubts else []
        stamps_ns += [self._history.trusted[sensor].stamp_ns] if sensor in self._history.trusted else []
        return max(stamps_ns, default=now_ns)

    def _agrees(self, doubt: DisagreementSpell | None, sensor: str, stamp_ns: int, against: float) -> bool:
        return against <= self.limit(sensor, stamp_ns, AGAIN if doubt else 1.0)

    def _judged(self, doubt: DisagreementSpell, sight: Sight) -> DisagreementSpell:
        """Return a doubt after one more frame."""
        outcome = sight.outcome
        looks = doubt.looks + 1 if not outcome else doubt.looks if outcome == "still" else 0
        fits = doubt.fits + (outcome == "moved")
        doubt = doubt._replace(looks=looks, fits=fits, glance=sight.kept(doubt.glance), verdict="")
        if self._lasted(doubt, self._changed_ns) and looks >= LOOKS:
            return doubt._replace(verdict=CHANGED)
        if self._lasted(doubt, self._changed_ns) and fits >= FITS * (doubt.frames + 1):
            moved_s = self._trust.moved_s
            waited = moved_s is not None and self._lasted(doubt, round(1e9 * moved_s))
            return doubt._replace(verdict=CHANGED if waited else MOVED)
        return doubt

    def _lasted(self, doubt: DisagreementSpell, enough_ns: int) -> bool:
        return doubt.lasted_ns(UNTIMED_HZ) >= enough_ns

    def _remember(self, sensor: str, doubt: DisagreementSpell) -> None:
        if sensor in self._history.doubts or len(self._history.doubts) < MAX_SENSORS:
            self._history.doubts[sensor] = doubt

    def _reason(self, doubt: DisagreementSpell) -> str:
        if doubt.verdict == MOVED:
            return CAMERA_MOVED
        return CONTRADICTS if self._lasted(doubt, self._changed_ns) else DISAGREES

    def _refusal(
        self,
        frame: AnyFrame | Scan,
        against: float | None,
        limit: float,
        doubt: DisagreementSpell,
        sight: Sight,
    ) -> FrameRefused:
        detail = f"it disagrees with the map in {against or 0:.0%} of its evidence (limit {limit:.0%})"
        if against is None:
            detail = "it sees nothing known, and the frames just before it disagree with the map"
        outcome = "moved" if doubt.verdict == MOVED else sight.outcome
        cure = CURES.get(outcome, f"it would agree if it were {outcome}; check driver, units and calibration")
        return FrameRefused(self._reason(doubt), f"{name_of(frame)}: {detail}; {cure}")
