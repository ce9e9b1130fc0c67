# SPDX-License-Identifier: Apache-2.0
"""Checks whether a sensor's clock still agrees with the clock of the poses, by the arrival of stamps.

Every stamp arrives some time after it was taken. The smallest of these delays within a second hardly changes,
unless a clock was set, a clock drifts, or messages arrive later than before. So the delay of each image is
compared with the delay of the poses, and with its value at the start. This machine's clock does not matter: arrivals
are timed by one that never steps, and setting both other clocks changes both delays.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from threading import Lock
from typing import NamedTuple

WINDOW_NS = 1_000_000_000
"""Time over which the smallest delay counts."""
USUAL_NS, ANNOUNCED_NS = 80_000_000, 20_000_000
"""Tolerated change of the delay of an image; and the one after a stamp went back, which indicates that a clock was
set back."""
START_NS = 300_000_000
"""Tolerated difference of the delays of images and poses at the start: both the camera and the source of poses take
some time to deliver."""
SETTLE_NS = 1_000_000_000
"""Time from the first image during which the usual delay is measured."""
OPEN, GONE, LATE, CLOCK = "", "gone", "late", "clock"
"""Outcomes of a doubt: still open; delays are normal again; images arrive later, with correct stamps; the
clock was set."""


class Delays:
    """The smallest delay from stamp to arrival within the last second. Thread-safe.

    Attributes:
        set_back: How often the stamps went back.
    """

    def __init__(self) -> None:
        self._lock, self._newest_ns, self.set_back = Lock(), 0, 0
        self._least: deque[tuple[int, int]] = deque()  # arrival and delay; delays ascend

    def heard(self, stamp_ns: int, arrived_ns: int) -> None:
        """Record a stamp. arrived_ns: monotonic. A clock that goes back starts anew."""
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
        """Return the smallest delay of the last second; None if nothing arrived within it."""
        with self._lock:
            while self._least and now_ns - self._least[0][0] > WINDOW_NS:
                self._least.popleft()
            return self._least[0][1] if self._least else None

    def forget(self) -> None:
        """Forget all recorded stamps."""
        with self._lock:
            self._least.clear()
            self._newest_ns = 0


@dataclass(eq=False)
class ClockDoubt:
    """Images that arrive earlier or later than their stamps and those of the poses allow.

    Attributes:
        off_ns: How much later they arrive; the clock was set back by this much, unless they are late.
        since_ns: When the first one arrived.
        start: Whether this was so from the first image on.
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
        """Whether the stamps of its images have proved right."""
        return self.became == LATE or (self.became == GONE and not self.announced)


class Heard(NamedTuple):
    """State of a message's stamp at its arrival.

    doubt: the doubt it belongs to; None: none. set_back: how often the poses' clock had been set back. judged: whether
    it could be judged; else it shares a later doubt.
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

    poses: delays of the poses, filled by their receiver. start_ns: as START_NS.
    Any thread may read; one calls `heard`.

    Attributes:
        doubt: The open doubt; None: the clocks agree, or there are no poses to compare with.
    """

    def __init__(self, poses: Delays, start_ns: int = START_NS):
        self._poses, self._delays, self._start_ns = poses, Delays(), start_ns
        self._newest_ns: int | None = None
        self._usual_ns: int | None = None
        self._begun_ns = 0
        self.doubt: ClockDoubt | None = None

    def heard(self, stamp_ns: int, arrived_ns: int) -> ClockDoubt | None:
        """Record the stamp of an image; return the doubt that it belongs to.

        Args:
            stamp_ns: By the clock of the poses, as far as known.
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
        assert least_ns is not None  # at least this image's own
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
        """Report that a stamp went back while arrivals could not be judged."""
        if self.doubt is None:
            self.doubt = ClockDoubt(back_ns, arrived_ns, announced=True)

    def late(self) -> None:
        """Report that the stamps are right: images arrive with the current delay from now on."""
        if self.doubt is not None:
            self._usual_ns = (self._usual_ns or 0) + self.doubt.off_ns
        self._end(LATE)

    def corrected(self) -> None:
        """Report that the clock was set, and that the stamps from now on are corrected for it."""
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
