# SPDX-License-Identifier: Apache-2.0
"""Frames that wait: for their pose, and for a map that is busy."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass
class Arrival(Generic[T]):
    """A message that is to become a frame.

    sensor: its topic. stamp_ns, frame_id: of its header. content: the message. arrived_ns: by the clock of the queue;
    ready_ns: the same, since when all that it needs is there, None: it waits.
    """

    sensor: str
    stamp_ns: int
    frame_id: str
    content: T
    arrived_ns: int
    ready_ns: int | None = None


class Waiting(Generic[T]):
    """A short queue for each sensor. Frames of one sensor keep their order.

    most: frames of a sensor that wait; one on top pushes the oldest out. wait_ns: a frame that is not ready by then
    goes on as it is. late_ns: a frame that was ready for so long gives way where a newer one is ready too.
    dropped: how many went so, by sensor. clock: nanoseconds of a clock that never steps.
    """

    def __init__(self, most: int, wait_ns: int, late_ns: int, clock: Callable[[], int]):
        self._most, self._wait_ns, self._late_ns, self._clock = most, wait_ns, late_ns, clock
        self._queues: dict[str, deque[Arrival[T]]] = {}
        self.dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))

    def put(self, sensor: str, stamp_ns: int, frame_id: str, content: T) -> None:
        """Let a message wait from now on."""
        queue = self._queues.setdefault(sensor, deque())
        if len(queue) == self._most:
            self._drop(queue)
        queue.append(Arrival(sensor, stamp_ns, frame_id, content, self._clock()))

    def take(self, is_ready: Callable[[Arrival[T]], bool]) -> Arrival[T] | None:
        """Return the frame that is next, None where all have to wait: the oldest of those that are first of a sensor.

        is_ready: tells whether all is there that a frame needs.
        """
        now = self._clock()
        due = [queue for queue in self._queues.values() if queue and self._due(queue[0], is_ready, now)]
        for queue in due:
            while len(queue) > 1 and self._late(queue[0], now) and self._due(queue[1], is_ready, now):
                self._drop(queue)
        return min(due, key=lambda queue: queue[0].stamp_ns).popleft() if due else None

    def clear(self) -> None:
        """Forget all frames; they do not count as dropped."""
        self._queues.clear()

    def _due(self, one: Arrival[T], is_ready: Callable[[Arrival[T]], bool], now: int) -> bool:
        if one.ready_ns is None and is_ready(one):
            one.ready_ns = now
        return one.ready_ns is not None or now - one.arrived_ns > self._wait_ns

    def _late(self, one: Arrival[T], now: int) -> bool:
        return one.ready_ns is not None and now - one.ready_ns > self._late_ns

    def _drop(self, queue: deque[Arrival[T]]) -> None:
        self.dropped[queue.popleft().sensor] += 1
