# SPDX-License-Identifier: Apache-2.0
"""The offset of an autopilot's clock: from TIMESYNC messages, or else from the least message delay.

TIMESYNC (https://mavlink.io/en/services/timesync.html): we send our time ts1, the autopilot returns it with its own,
tc1; if both directions take equally long, its clock was ahead of ours by tc1 - (ts1 + now) / 2, as in PX4's
mavlink_timesync.cpp. The latest answer with the shortest round trip counts; its error is at most half of that.
"""

from __future__ import annotations

from collections import deque
from threading import Lock

ANSWERS = 32
"""Number of latest TIMESYNC answers kept."""
HEARD = 200
"""Number of latest message delays kept."""
ENOUGH = 20
"""Fewest messages before their least delay is trusted."""
LONGEST_ROUND_TRIP_NS = 100_000_000
"""Answers that took longer are ignored."""
SET_BACK_NS, SLACK_NS = 100_000_000, 5_000_000
"""A clock that goes back by more than messages overtake each other was set; so was one that contradicts its earlier
answers: each is off by at most half of its round trip plus drift meanwhile."""


class RemoteClock:
    """Converts times of another machine to this one's. Thread-safe.

    Without TIMESYNC, times are late by the least delay of the link, which is unknown.

    Attributes:
        times_set: Number of times the other clock was set or restarted; earlier data is then dropped.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self.times_set = 0
        self._forget()

    def answered(self, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Take an answer to TIMESYNC.

        Args:
            sent_ns: Time of the request, by this machine (`ts1`).
            remote_ns: Time of the answer, by the other clock (`tc1`).
            received_ns: Arrival of the answer, by this machine.
        """
        round_trip_ns = received_ns - sent_ns
        if not 0 <= round_trip_ns <= LONGEST_ROUND_TRIP_NS:
            return
        with self._lock:
            offset_ns = remote_ns - (sent_ns + received_ns) // 2
            if self._answers:
                best_trip_ns, best_ns = min(self._answers)
                if abs(offset_ns - best_ns) > (round_trip_ns + best_trip_ns) // 2 + SLACK_NS:
                    self._set_anew()
            self._answers.append((round_trip_ns, offset_ns))

    def heard(self, remote_ns: int, received_ns: int) -> None:
        """Add a message's time, in the other machine's nanoseconds, and its arrival, in this one's."""
        with self._lock:
            if remote_ns < self._latest_heard_ns - SET_BACK_NS:
                self._set_anew()
            self._latest_heard_ns = max(self._latest_heard_ns, remote_ns)
            self._heard.append(remote_ns - received_ns)

    @property
    def offset_ns(self) -> int | None:
        """How far the other clock is ahead of this one; None while too little is known."""
        with self._lock:
            if self._answers:
                return min(self._answers)[1]
            return max(self._heard) if len(self._heard) >= ENOUGH else None

    @property
    def error_ns(self) -> int | None:
        """Largest error of `offset_ns`; None if unknown, without TIMESYNC."""
        with self._lock:
            return min(self._answers)[0] // 2 if self._answers else None

    def local_ns(self, remote_ns: int) -> int | None:
        """Return a time of the other machine in this one's nanoseconds; None while too little is known."""
        offset = self.offset_ns
        return None if offset is None else remote_ns - offset

    def _set_anew(self) -> None:
        self.times_set += 1
        self._forget()

    def _forget(self) -> None:
        self._latest_heard_ns = -(1 << 62)
        self._answers: deque[tuple[int, int]] = deque(maxlen=ANSWERS)
        self._heard: deque[int] = deque(maxlen=HEARD)
