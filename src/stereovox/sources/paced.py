# SPDX-License-Identifier: Apache-2.0
"""Recordings and simulations played as if their camera were connected now."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from threading import Event
from time import monotonic_ns

from stereovox.frame import AnyFrame
from stereovox.frame.stamp_clock import epoch_ns
from stereovox.sources.base import Stream


class Paced(Stream):
    """The frames of a recording at their own pace, in real time, stamped by the clock of this machine.

    Args:
        source: The recording or simulation.
        rate: Speed relative to real time.
        restamp: Stamp the first frame with the current time and keep the intervals between frames; else keep
            their stamps.

    Attributes:
        source: The recording or simulation.
        late: Number of frames that the recording delivered late, by more than half a frame at 30 Hz.
    """

    LATE_NS = 16_000_000

    def __init__(self, source: Stream, rate: float = 1.0, restamp: bool = True):
        self.source, self._rate, self._restamp = source, rate, restamp
        self.name, self.camera, self.notes = source.name, source.camera, tuple(source.notes)
        self.posed = source.posed
        self.late = 0
        self._stopped = Event()

    def __iter__(self) -> Iterator[AnyFrame]:
        begin_ns = first_ns = shift_ns = 0
        for k, frame in enumerate(self.source):
            if k == 0:
                begin_ns, first_ns, shift_ns = monotonic_ns(), frame.stamp_ns, epoch_ns() - frame.stamp_ns
            due_ns = begin_ns + round((frame.stamp_ns - first_ns) / self._rate)
            left_ns = due_ns - monotonic_ns()
            self.late += left_ns < -self.LATE_NS
            if left_ns > 0:
                self._stopped.wait(left_ns / 1e9)
            if not self._restamp:
                yield frame
                continue
            yield replace(frame, stamp_ns=first_ns + shift_ns + round((frame.stamp_ns - first_ns) / self._rate))
