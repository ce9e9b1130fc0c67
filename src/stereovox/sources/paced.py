# SPDX-License-Identifier: Apache-2.0
"""Recordings and simulations played as if their camera were connected now.

A recording in another world: all poses rotated by the same motion.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from threading import Event
from time import monotonic_ns

from stereovox.frame import AnyFrame
from stereovox.frame.stamp_clock import epoch_ns
from stereovox.geometry.se3 import Transform
from stereovox.sources.base import Changed, Source, Stream
from stereovox.sources.imu import Imu


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


class Turned(Changed):
    """The frames of `stream` in a new world; T_new_world (4, 4) maps the recording's world into it."""

    def __init__(self, stream: Stream, T_new_world: Transform):
        super().__init__(stream)
        self._T_new_world = T_new_world

    def change(self, frame: AnyFrame) -> AnyFrame:
        """Return a frame with its pose in the new world."""
        return _in_world(frame, self._T_new_world)


class TurnedRecording(Source):
    """A recording in a new world, whose frames can still be read in any order."""

    def __init__(self, source: Source, T_new_world: Transform):
        self._source, self._T_new_world = source, T_new_world
        self.name, self.camera, self.notes = source.name, source.camera, source.notes

    def imu(self) -> Imu | None:
        """Return the IMU of the recording."""
        return self._source.imu()

    def __len__(self) -> int:
        return len(self._source)

    def frame(self, i: int) -> AnyFrame:
        """Return frame `i` in the new world."""
        return _in_world(self._source.frame(i), self._T_new_world)


def _in_world(frame: AnyFrame, T_new_world: Transform) -> AnyFrame:
    return replace(frame, T_world_sensor=T_new_world @ frame.T_world_sensor)
