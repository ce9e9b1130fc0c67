# SPDX-License-Identifier: Apache-2.0
"""Whether a sensor's clock still agrees with that of the poses, by when stamps arrive.

Whatever a stamp is by, it arrives later than it was taken. The least of these delays within a second hardly changes,
unless a clock was set, one of the clocks drifts, or messages come later than before. So the delay of each image is
compared with that of the poses, and with what it was at the start. The clock of this machine does not matter: arrivals
are counted by one that never steps, and what sets both other clocks changes both delays.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from threading import Lock
from typing import NamedTuple

WINDOW_NS = 1_000_000_000
"""Time over which the least delay counts."""
USUAL_NS, ANNOUNCED_NS = 80_000_000, 20_000_000
"""By how much the delay of an image may differ from the usual; and once a stamp went back, which is how a clock that
is set back announces itself."""
START_NS = 300_000_000
"""By how much images and poses may come apart at the start: a camera takes some time to deliver, and so does what finds
poses."""
SETTLE_NS = 1_000_000_000
"""Time from the first image on in which the usual delay is found."""
OPEN, GONE, LATE, CLOCK = "", "gone", "late", "clock"
"""What became of a doubt: still open; delays are as usual again; images come later, and their stamps are right; the
clock was set."""


class Delays:
    """The least delay from stamp to arrival within the last second. Threads may share it.

    Attributes:
        set_back: How often the stamps went back.
    """

    def __init__(self) -> None:
        self._lock, self._newest_ns, self.set_back = Lock(), 0, 0
        self._least: deque[tuple[int, int]] = deque()  # arrival and delay; delays ascend

    def heard(self, stamp_ns: int, arrived_ns: int) -> None:
        """Take in a stamp. arrived_ns: monotonic. A clock that goes back begins anew."""
        delay_ns = arrived_ns - stamp_ns
        with self._lock:
            if stamp_ns < self._newest_ns - ANNOUNCED_NS:
                self._least.clear()
                self._newest_ns, self.set_back = stamp_ns, self.set_back + 1
            self._newest_ns = max(self._newest_ns, stamp_ns)
            while self._least and self._least[-1][1] >= delay_ns:
                self._least.pop()
            self._least.append((arrived_ns, delay_ns))

    def least_ns(self, now_ns: int) -> int | None:
        """Return the least delay of the last second; None if nothing came within it."""
        with self._lock:
            while self._least and now_ns - self._least[0][0] > WINDOW_NS:
                self._least.popleft()
            return self._least[0][1] if self._least else None

    def forget(self) -> None:
        """Forget what was heard so far."""
        with self._lock:
            self._least.clear()
            self._newest_ns = 0


@dataclass(eq=False)
class ClockDoubt:
    """Images that come earlier or later than their stamps and those of the poses allow.

    Attributes:
        off_ns: By how much later they come; the clock was set back by this much, unless they are late.
        since_ns: When the first one arrived.
        start: Whether it was so from the first image on.
        announced: Whether a stamp went back.
        became: OPEN, GONE, LATE or CLOCK.
        told: Whether the user was informed.
    """

    off_ns: int
    since_ns: int
    start: bool = False
    announced: bool = False
    became: str = OPEN
    told: bool = False

    @property
    def cleared(self) -> bool:
        """Whether the stamps of its images have turned out to be right."""
        return self.became == LATE or (self.became == GONE and not self.announced)


class Heard(NamedTuple):
    """What was known of the stamp of a message when it arrived.

    doubt: what it is in; None: nothing. set_back: how often the clock of the poses had been. judged: whether anything
    could be said; else it shares a doubt that comes up later.
    """

    doubt: ClockDoubt | None = None
    set_back: int = 0
    judged: bool = True

    @property
    def is_open(self) -> bool:
        """Whether the next message may show that this one was late."""
        doubt = self.doubt
        return doubt is not None and doubt.became == OPEN and not (doubt.told or doubt.announced)


class ClockWatch:
    """Compares the stamps of a sensor with those of the poses, as both arrive.

    poses: delays of the poses, which whoever receives them takes in. start_ns: as START_NS.
    Any thread may ask; one calls `heard`.

    Attributes:
        doubt: The doubt that is open; None: the clocks agree, or no poses come to compare with.
    """

    def __init__(self, poses: Delays, start_ns: int = START_NS):
        self._poses, self._delays, self._start_ns = poses, Delays(), start_ns
        self._newest_ns: int | None = None
        self._usual_ns: int | None = None
        self._begun_ns = 0
        self.doubt: ClockDoubt | None = None

    def heard(self, stamp_ns: int, arrived_ns: int) -> ClockDoubt | None:
        """Take in the stamp of an image; return the doubt that it belongs to.

        Args:
            stamp_ns: By the clock of the poses, as far as is known.
            arrived_ns: Monotonic.
        """
        backwards = self._newest_ns is not None and stamp_ns < self._newest_ns
        self._newest_ns = stamp_ns
        poses_ns = self._poses.least_ns(arrived_ns)
        if poses_ns is None:
            return self.doubt
        self._delays.heard(stamp_ns, arrived_ns)
        late_ns = arrived_ns - stamp_ns - poses_ns
        announced = backwards or (self.doubt is not None and self.doubt.announced)
        least_ns = self._delays.least_ns(arrived_ns)
        assert least_ns is not None  # that of this image
        early = self.doubt is not None and self.doubt.off_ns < 0  # then the least counts: any image may come late
        if self._is_usual(least_ns - poses_ns if early else late_ns, announced):
            self._end(GONE)
            if self._usual_ns is None:
                self._usual_ns, self._begun_ns = late_ns, arrived_ns
            elif arrived_ns - self._begun_ns < SETTLE_NS:
                self._usual_ns = min(self._usual_ns, late_ns)
            return None
        if self.doubt is None:
            self._delays.forget()
            self._delays.heard(stamp_ns, arrived_ns)
            self.doubt, least_ns = ClockDoubt(0, arrived_ns, self._usual_ns is None), arrived_ns - stamp_ns
        self.doubt.announced |= backwards
        self.doubt.off_ns = least_ns - poses_ns - (self._usual_ns or 0)
        return self.doubt

    def announce(self, back_ns: int, arrived_ns: int) -> None:
        """Say that a stamp went back while nothing could be said of arrivals."""
        if self.doubt is None:
            self.doubt = ClockDoubt(back_ns, arrived_ns, announced=True)

    def late(self) -> None:
        """Say that the stamps are right: images come as much later, or earlier, as they do now."""
        if self.doubt is not None:
            self._usual_ns = (self._usual_ns or 0) + self.doubt.off_ns
        self._end(LATE)

    def corrected(self) -> None:
        """Say that the clock was set, and that the stamps from now on are corrected for it."""
        self._newest_ns = None
        self._delays.forget()
        self._end(CLOCK)

    def _is_usual(self, late_ns: int, announced: bool) -> bool:
        if self._usual_ns is None:
            return abs(late_ns) <= self._start_ns
        return abs(late_ns - self._usual_ns) <= (ANNOUNCED_NS if announced else USUAL_NS)

    def _end(self, became: str) -> None:
        if self.doubt is not None:
            self.doubt.became, self.doubt = became, None
