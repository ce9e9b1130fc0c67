# SPDX-License-Identifier: Apache-2.0
"""Queues of messages and images that wait for their pose or for a busy map."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass
class Arrival(Generic[T]):
    """A message waiting to become a frame.

    sensor: its topic. stamp_ns, frame_id: from its header. content: the message. arrived_ns: time of arrival by the
    queue's clock; ready_ns: when everything it needs had arrived, None: not yet.
    """

    sensor: str
    stamp_ns: int
    frame_id: str
    content: T
    arrived_ns: int
    ready_ns: int | None = None


class Waiting(Generic[T]):
    """A short queue for each sensor. Frames of one sensor keep their order.

    max_length: frames that wait per sensor; one more drops the oldest, or returns it unready.
    wait_ns: a frame that is not ready after this time is returned unready. late_ns: a frame that has been ready this
    long is dropped if a newer one is ready too. dropped: number of dropped frames by sensor. clock: monotonic
    nanoseconds.
    """

    def __init__(self, max_length: int, wait_ns: int, late_ns: int, clock: Callable[[], int]):
        self._max_length, self._wait_ns, self._late_ns, self._clock = max_length, wait_ns, late_ns, clock
        self._queues: dict[str, deque[Arrival[T]]] = {}
        self.dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        return sum(map(len, self._queues.values()))

    def put(self, sensor: str, stamp_ns: int, frame_id: str, content: T) -> None:
        """Add a message to the queue of its sensor."""
        queue = self._queues.setdefault(sensor, deque())
        if len(queue) > self._max_length or (len(queue) == self._max_length and queue[0].ready_ns is not None):
            self._drop(queue)
        queue.append(Arrival(sensor, stamp_ns, frame_id, content, self._clock()))

    def pop(self, is_ready: Callable[[Arrival[T]], bool]) -> Arrival[T] | None:
        """Remove and return the next frame, the oldest among the first of each sensor; None if all must wait.

        is_ready: returns whether everything that a frame needs has arrived.
        """
        now = self._clock()
        for queue in self._queues.values():
            for one in queue:  # also behind the first, since the time of readiness counts while others are mapped
                self._note(one, is_ready, now)
        full = self._max_length + 1
        due = [queue for queue in self._queues.values() if queue and (len(queue) == full or self._due(queue[0], now))]
        for queue in due:
            while len(queue) > 1 and self._late(queue[0], now) and self._due(queue[1], now):
                self._drop(queue)
        return min(due, key=lambda queue: queue[0].stamp_ns).popleft() if due else None

    def clear(self) -> None:
        """Remove all frames without counting them as dropped."""
        self._queues.clear()

    def _note(self, one: Arrival[T], is_ready: Callable[[Arrival[T]], bool], now: int) -> None:
        if one.ready_ns is None and is_ready(one):
            one.ready_ns = now

    def _due(self, one: Arrival[T], now: int) -> bool:
        return one.ready_ns is not None or now - one.arrived_ns > self._wait_ns

    def _late(self, one: Arrival[T], now: int) -> bool:
        return one.ready_ns is not None and now - one.ready_ns > self._late_ns

    def _drop(self, queue: deque[Arrival[T]]) -> None:
        self.dropped[queue.popleft().sensor] += 1
