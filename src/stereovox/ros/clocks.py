# SPDX-License-Identifier: Apache-2.0
"""Whether the clocks of the sensors agree with that of their poses, by when messages arrive: live and in a replay.

A bag may be played at any rate, with or without `/clock`, paused, and begun again. So time is counted as it passes for
the stamps of the poses. While these do not come steadily, nothing can be said, except of a stamp that goes back.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stereovox.calibrate.live_clock import REASON, REMIND_NS, TELL_NS, doubt_words
from stereovox.errors import FrameRefused
from stereovox.sources.clock_watch import ANNOUNCED_NS, OPEN, ClockDoubt, ClockWatch, Delays
from stereovox.sources.poses import seconds_from_ns

WINDOW_NS, SPAN_NS, FEWEST = 1_000_000_000, 250_000_000, 3
"""Time over which the rate of poses is found; how long they must have come for it, and how many at least."""
PAUSE_NS = 300_000_000
"""Poses that stay away for longer were paused perhaps, and begin anew."""
LIVE, LIVE_OFF_NS, PLAYED_OFF_NS = 0.1, 150_000_000, 40_000_000
"""A rate this near to 1 is 1; by how much poses may then arrive off it, and at another rate."""
SLOWEST, FASTEST = 0.1, 2.5
"""Rates between which arrivals tell something: in a faster replay a few milliseconds count for too much."""
BEGUN_AGAIN_NS = 1_000_000_000
"""Stamps that go back by more are not those of a clock that announces itself: a bag may begin again."""


class Pace:
    """How the stamps of poses arrive. simulated: whether time may slow down while nothing is played (use_sim_time).

    Attributes:
        delays: Their delays, by time as it passes for the stamps.
        rate: How fast that is: 1 live, that of the player in a replay; NaN while poses do not come steadily.
    """

    def __init__(self, simulated: bool = False) -> None:
        self.delays, self.rate, self._simulated = Delays(), float("nan"), simulated
        self._recent: deque[tuple[int, int]] = deque()  # arrival and stamp
        self._anchor, self._used = (0, 0), 1.0  # arrival and time as it passes for the stamps, and how fast

    def heard(self, stamp_ns: int, arrived_ns: int) -> None:
        """Take in the stamp of a pose. arrived_ns: monotonic."""
        recent = self._recent
        if recent and stamp_ns < recent[-1][1] - ANNOUNCED_NS:
            recent.clear()
        elif recent and arrived_ns - recent[-1][0] > PAUSE_NS:
            recent.clear()
            self.delays.forget()
        recent.append((arrived_ns, stamp_ns))
        while arrived_ns - recent[0][0] > WINDOW_NS:
            recent.popleft()
        self._anchor = arrived_ns, self.passed_ns(arrived_ns)
        self.rate = self._found()
        if self.rate == self.rate and self.rate != self._used:
            if abs(self.rate / self._used - 1) > LIVE / 2:
                self.delays.forget()
            self._used = self.rate
        self.delays.heard(stamp_ns, self._anchor[1])

    def passed_ns(self, arrived_ns: int) -> int:
        """Return a time of arrival as it passes for the stamps."""
        return self._anchor[1] + round(self._used * (arrived_ns - self._anchor[0]))

    def _found(self) -> float:
        arrived, stamps = np.array(self._recent, np.int64).T
        arrived, stamps = (arrived - arrived[0]).astype(float), (stamps - stamps[0]).astype(float)
        if len(arrived) < FEWEST or arrived[-1] < SPAN_NS:
            return float("nan")
        unsteady = 1.0 if self.rate == 1 and not self._simulated else float("nan")  # late poses, or their clock was set
        rate = float(stamps[-1] / arrived[-1])
        if abs(rate - 1) <= LIVE:
            rate = 1.0
        elif not SLOWEST <= rate <= FASTEST:
            return unsteady
        return rate if np.ptp(arrived - stamps / rate) <= (LIVE_OFF_NS if rate == 1 else PLAYED_OFF_NS) else unsteady


class Heard(NamedTuple):
    """What was said of a message when it arrived. doubt: that it is in. judged: whether anything could be said."""

    doubt: ClockDoubt | None
    judged: bool


NOTHING = Heard(None, False)


class SensorClock:
    """Watches the clock of one topic against that of its poses, and tells the user.

    apart_ns: by how much its messages and poses of the same time may come apart at the start.
    """

    def __init__(self, topic: str, apart_ns: int, notify: Callable[[str], object]):
        self._topic, self._apart_ns, self._notify = topic, apart_ns, notify
        self._pace: Pace | None = None
        self._watch = ClockWatch(Delays())
        self._newest_ns: int | None = None
        self._doubt: ClockDoubt | None = None
        self._told_ns = 0

    def heard(self, stamp_ns: int, arrived_ns: int, pace: Pace | None) -> Heard:
        """Take in the stamp of a message. arrived_ns: monotonic. pace: that of its poses; None: not known yet."""
        back_ns = 0 if self._newest_ns is None else self._newest_ns - stamp_ns
        self._newest_ns = stamp_ns
        if pace is None:
            return NOTHING
        if pace is not self._pace:
            self._pace, self._watch = pace, ClockWatch(pace.delays, self._apart_ns)
        passed_ns, judged = pace.passed_ns(arrived_ns), pace.rate == pace.rate
        if judged:
            self._watch.heard(stamp_ns, passed_ns)
        elif ANNOUNCED_NS < back_ns < BEGUN_AGAIN_NS and self._watch.doubt is None:
            self._watch.doubt = ClockDoubt(back_ns, passed_ns, announced=True)
        self._tell(arrived_ns)
        doubt = self._watch.doubt
        return Heard(doubt, judged and pace.delays.least_ns(passed_ns) is not None)

    def is_open(self, heard: Heard) -> bool:
        """Return whether the next message may show that the stamp of this one is right."""
        return heard.doubt is not None and heard.doubt.became == OPEN and not heard.doubt.told

    def check(self, heard: Heard, stamp_ns: int) -> None:
        """Raise FrameRefused `clock_doubt` for a message whose pose is not certain."""
        doubt = heard.doubt if heard.judged or heard.doubt is not None else self._watch.doubt
        if doubt is not None and not doubt.cleared:
            raise FrameRefused(REASON, f"{self._topic} {seconds_from_ns(stamp_ns)}: {doubt_words(doubt)}; {CURE}")

    def _tell(self, now_ns: int) -> None:
        doubt = self._watch.doubt
        if doubt is None:
            return
        if doubt is not self._doubt:
            self._doubt, self._told_ns = doubt, now_ns
        waited_ns = now_ns - self._told_ns
        if not doubt.told and (doubt.announced or waited_ns > TELL_NS):
            doubt.told, self._told_ns = True, now_ns
            self._notify(
                f"{self._topic}: {doubt_words(doubt)}; its messages are refused ({REASON}); {self._cure(doubt)}"
            )
        elif doubt.told and waited_ns > 3 * REMIND_NS:
            self._told_ns = now_ns
            self._notify(f"{self._topic}: still refused ({REASON}): {doubt_words(doubt)}; {self._cure(doubt)}")

    def _cure(self, doubt: ClockDoubt) -> str:
        late = f"; if it does take that long, give ros.apart_s {abs(doubt.off_ns) / 1e9 + 0.1:.1f}"
        return f"{CURE}{late if doubt.start and abs(doubt.off_ns) < 5e9 else ''}"


CURE = (
    "stamp sensor and poses by one clock (the driver's option for system time, chrony or PTP between machines; "
    "use_sim_time for all nodes or none), then start the node anew or call ~/reset"
)


class SensorClocks:
    """Those of all topics. apart_s: as `Options.apart_s`. notify: called with each line that a user should see.

    Attributes:
        refused: Messages that were refused, by topic.
    """

    def __init__(self, apart_s: float, notify: Callable[[str], object]):
        self._apart_ns, self._notify = round(1e9 * apart_s), notify
        self.refused: Counter[str] = Counter()
        self.forget()

    def __getitem__(self, topic: str) -> SensorClock:
        return self._clocks.setdefault(topic, SensorClock(topic, self._apart_ns, self._notify))

    def refusal(self, topic: str, heard: Heard, stamp_ns: int) -> FrameRefused | None:
        """Return why a message must not be mapped, and count it; None: its stamp is right as far as is known."""
        try:
            self[topic].check(heard, stamp_ns)
        except FrameRefused as refused:
            self.refused[topic] += 1
            return refused
        return None

    def forget(self) -> None:
        """Begin anew, as at the start."""
        self._clocks: dict[str, SensorClock] = {}
