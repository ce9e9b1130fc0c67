# SPDX-License-Identifier: Apache-2.0
"""How old is what was stamped: stamps have a clock of their own, and what arrives now may have happened long ago.

An event cannot arrive before it happens, so each stamp that arrives (of a frame or a pose) is a lower bound for the
present time by the stamps' clock. Ages are counted from the best bound that is known, never from arrival alone.

The clock on the wall, by which cameras and other programs stamp: to measure ages and to stamp what is played.

It may be set at any moment, so nothing waits, ends or is decided by it; a test keeps it out of all other files.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from time import time_ns
from typing import Literal

from stereovox.errors import ConfigError
from stereovox.kernels.threads import MapLock

StampsBy = Callable[[], int | None] | Literal["live", "replay"] | None
"""By which clock frames are stamped.

A function: returns the present time by that clock in nanoseconds, None while it is not known, which is then as `live`.
`live`: stamps advance with the time, by a clock that is recognised, or of which only the least delay is known.
`replay`: stamps are those of a recording that is played at any speed. None: by a clock that is recognised, else
`replay`, until something declares the map live.
"""
EPOCH_NS, OWN_NS, AHEAD_NS = 3_600_000_000_000, 10_000_000_000, 1_000_000_000
"""Longest delays of a first stamp that is recognised as one by the clock of this machine: since 1970, and by the
mapper's own clock; and how far it may be ahead."""
OWN_LEAST_NS = 600_000_000_000
"""Readings of the mapper's own clock below which no stamp is recognised as one by it: recordings begin at 0, too."""
RESET_NS = 1_000_000_000
"""A source whose stamps go back by more has a new clock."""
CONFIRMED = 5
"""Successive stamps of a source that must confirm a smaller delay before it counts for good."""
DRIFT = 1e-4
"""Share by which two clocks may run apart: quartzes are within 50 parts in a million."""


class StampClock:
    """The present time by the clock of the stamps, as far as stamps and what was said of them tell.

    now: the mapper's clock in nanoseconds. epoch: nanoseconds since 1970. ordered: whether the newest stamp is the last
    event (`trust.ordered`). Threads may share it. Raises ConfigError for a `stamps_by` that is none of its values.
    """

    def __init__(self, now: Callable[[], int], stamps_by: StampsBy, epoch: Callable[[], int], ordered: bool):
        self._now, self._epoch, self._ordered, self._lock = now, epoch, ordered, MapLock()
        self.by = stamps_by
        self._forget()

    @property
    def by(self) -> StampsBy:
        """By which clock stamps are, as was said."""
        return self._by

    @by.setter
    def by(self, clock: StampsBy) -> None:
        if not (clock is None or callable(clock) or clock in ("live", "replay")):
            raise ConfigError(f"stamp_clock {clock!r}: give 'live', 'replay' or a function that returns nanoseconds")
        self._by: StampsBy = clock

    def heard(self, source: str, stamp_ns: int, now_ns: int) -> None:
        """Take note that something with a stamp came from a source (a sensor, the poses) at `now_ns`."""
        with self._lock:
            if (last := self._last.get(source)) is None or stamp_ns < last - RESET_NS:
                if last is not None:
                    self._forget()
                self._recognise(stamp_ns, now_ns)
            self._last[source] = stamp_ns
            if self._newest is None or stamp_ns >= self._newest[0]:
                self._newest = stamp_ns, now_ns
            if (offsets := self._offsets.get(source)) is None:
                offsets = self._offsets[source] = deque(maxlen=CONFIRMED)
            offsets.append(now_ns - stamp_ns)
            if len(offsets) == CONFIRMED:
                self._least = min(max(offsets), self._least_at(now_ns)), now_ns

    def age_ns(self, stamp_ns: int, now_ns: int) -> int:
        """Return the least age at `now_ns` of what has a stamp; negative if nothing is known of its clock."""
        with self._lock:
            ages = [self.clock_age_ns(stamp_ns, now_ns)]
            if self._newest is not None and self._ordered:
                ages.append(self._newest[0] - stamp_ns + now_ns - self._newest[1])
            return max(ages)

    def clock_age_ns(self, stamp_ns: int, now_ns: int) -> int:
        """Return the same by the clock alone, whatever was newer; negative for a replay."""
        with self._lock:
            told = self._by() if callable(self._by) else None
            if told is None and self._by != "replay" and self._recognised is not None:
                told = self._recognised()
            if told is not None:
                return told - stamp_ns + now_ns - self._now()
            if self._by in (None, "replay") or not self._offsets:
                return -1
            return now_ns - stamp_ns - min([self._least_at(now_ns), *map(max, self._offsets.values())])

    def _least_at(self, now_ns: int) -> int:
        """Return the least confirmed difference of arrival and stamp, as the clocks may have run apart since."""
        if self._least is None:
            return max(map(max, self._offsets.values()), default=0)
        return self._least[0] + round(DRIFT * max(now_ns - self._least[1], 0))

    def _recognise(self, stamp_ns: int, now_ns: int) -> None:
        if -AHEAD_NS <= self._epoch() - stamp_ns <= EPOCH_NS:
            self._recognised = self._epoch
        elif now_ns >= OWN_LEAST_NS and -AHEAD_NS <= now_ns - stamp_ns <= OWN_NS:
            self._recognised = self._now

    def _forget(self) -> None:
        self._last: dict[str, int] = {}
        self._newest: tuple[int, int] | None = None
        self._offsets: dict[str, deque[int]] = {}
        self._least: tuple[int, int] | None = None
        self._recognised: Callable[[], int] | None = None


def epoch_ns() -> int:
    """Return nanoseconds since 1970 by this machine's clock."""
    return time_ns()
