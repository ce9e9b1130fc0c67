# SPDX-License-Identifier: Apache-2.0
"""Check by arrival times whether the clocks of sensors and poses agree: live and in a replay.

A bag may be played at any rate, with or without `/clock`, paused, and restarted. So time is counted at the rate at
which the stamps of the poses pass. While these do not arrive steadily, only a stamp that goes back is evidence.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Protocol

import numpy as np

from stereovox.calibrate.live_clock import CameraClock, PosesNow
from stereovox.config import Config
from stereovox.frame import AnyFrame
from stereovox.sources.poses.clock_watch import ANNOUNCED_NS, ClockDoubt, Delays, Heard

WINDOW_NS, SPAN_NS, FEWEST = 1_000_000_000, 250_000_000, 3
"""Time over which the rate of poses is measured; the least span and number of poses for it."""
PAUSE_NS = 300_000_000
"""After a longer gap in the poses, perhaps a pause, the measurement starts again."""
LIVE, LIVE_OFF_NS, PLAYED_OFF_NS = 0.1, 150_000_000, 40_000_000
"""A rate this near to 1 counts as 1; largest jitter of poses at that rate, and at another rate."""
SLOWEST, FASTEST = 0.1, 2.5
"""Rates between which arrivals are evidence: in a faster replay a few milliseconds weigh too much."""
BEGUN_AGAIN_NS = 1_000_000_000
"""If stamps go back by more, no clock was set back: the bag may have restarted."""


class Pace:
    """The pace at which stamps of poses arrive. simulated: whether time may stop while nothing plays (use_sim_time).

    Attributes:
        delays: Their delays, in the time of the stamps.
        rate: The speed of that time: 1 live, the player's rate in a replay; NaN while poses do not arrive steadily.
    """

    def __init__(self, simulated: bool = False) -> None:
        self.delays, self.rate, self._simulated = Delays(), float("nan"), simulated
        self._recent: deque[tuple[int, int]] = deque()  # arrival and stamp
        self._anchor, self._used = (0, 0), 1.0  # an arrival in both times, and the rate in use

    def heard(self, stamp_ns: int, arrived_ns: int) -> None:
        """Record the stamp of a pose. arrived_ns: monotonic."""
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
        """Return a time of arrival in the time of the stamps."""
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


class PosesOfSensor(PosesNow, Protocol):
    """Poses of a sensor in the world as they arrive. pace: None while nothing moves it."""

    @property
    def pace(self) -> Pace | None:
        """The pace of their messages."""
        ...


class SensorClock(CameraClock):
    """Watches the clock of one topic in the time of the stamps of its poses.

    Args: as for `CameraClock`. pace: of its poses. apart_ns: as `start_ns`.
    """

    def __init__(
        self, topic: str, poses: PosesNow, pace: Pace, config: Config, apart_ns: int, notify: Callable[[str], object],
        background: bool = True,
    ):  # fmt: skip
        super().__init__(topic, poses, pace.delays, np.eye(4), config, notify, cure, background, apart_ns)
        self.pace = pace
        self._before_ns: int | None = None

    def heard(self, stamp_ns: int, arrived_ns: int) -> Heard:
        """Record the corrected stamp of a message. arrived_ns: monotonic."""
        back_ns, self._before_ns = (self._before_ns or stamp_ns) - stamp_ns, stamp_ns
        passed_ns, set_back = self.pace.passed_ns(arrived_ns), self.pace.delays.set_back
        if self.pace.rate == self.pace.rate:
            judged = self.pace.delays.least_ns(passed_ns) is not None
            return Heard(self._watch.heard(stamp_ns, passed_ns), set_back, judged)
        if ANNOUNCED_NS < back_ns < BEGUN_AGAIN_NS:
            self._watch.announce(back_ns, passed_ns)
        return Heard(self._watch.doubt, set_back, judged=False)


def cure(doubt: ClockDoubt, ahead_s: float) -> str:
    """Return the user's remedy for a doubt."""
    late = f"; if delivery does take that long, set ros.apart_s {abs(doubt.off_ns) / 1e9 + 0.1:.1f}"
    return f"{CURE}{late if doubt.start and abs(doubt.off_ns) < LATE_AT_MOST_NS else ''}"


CURE = (
    "stamp sensor and poses by one clock (the driver's option for system time, chrony or PTP between machines; "
    "use_sim_time for all nodes or none), then restart the node or call ~/reset"
)
LATE_AT_MOST_NS = 5_000_000_000
"""Nothing takes longer to deliver than this."""


class SensorClocks:
    """The clocks of all topics. apart_s: as `Options.apart_s`. notify: called with each line that a user should see.

    background: whether images in doubt are tracked in threads.
    """

    def __init__(self, config: Config, apart_s: float, notify: Callable[[str], object], background: bool = True):
        self._config, self._apart_ns, self._notify = config, round(1e9 * apart_s), notify
        self._background, self._clocks = background, dict[str, SensorClock]()

    def shift_ns(self, topic: str) -> int:
        """Return the shift added to the stamps of a topic, as found from its motion."""
        clock = self._clocks.get(topic)
        return clock.shift_ns if clock else 0

    def heard(self, topic: str, stamp_ns: int, arrived_ns: int, poses: PosesOfSensor) -> Heard:
        """Record the shifted stamp of a message. arrived_ns: monotonic."""
        pace, clock = poses.pace, self._clocks.get(topic)
        if pace is None:
            return Heard(judged=False)
        if clock is None or clock.pace is not pace:
            if clock is not None:
                clock.close()
            clock = SensorClock(topic, poses, pace, self._config, self._apart_ns, self._notify, self._background)
            self._clocks[topic] = clock
        return clock.heard(stamp_ns, arrived_ns)

    def check(self, topic: str, view: Callable[[], AnyFrame], heard: Heard, now_ns: int) -> None:
        """Learn from a message, in its turn; raises FrameRefused if its pose is not certain.

        view: returns its evidence of the sensor's motion, with the stamp that was `heard`. now_ns: monotonic.
        """
        clock = self._clocks.get(topic)
        if clock is not None and clock.doubts(heard):
            clock.check(view(), heard, clock.pace.passed_ns(now_ns))

    def forget(self) -> None:
        """Start again, as at the beginning."""
        for clock in self._clocks.values():
            clock.close()
        self._clocks.clear()
