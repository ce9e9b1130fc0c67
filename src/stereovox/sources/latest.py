# SPDX-License-Identifier: Apache-2.0
"""The newest frames of a live camera: frames that are not consumed in time are dropped, oldest first.

Queues of messages and images that wait for their pose or for a busy map.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from threading import Condition, Event, Thread
from typing import Generic, TypeVar

from stereovox.frame import AnyFrame
from stereovox.sources.base import Stream, closing
from stereovox.sources.imu import Imu

T = TypeVar("T")
WAITING = 2
"""Frames kept while the map is busy: one to continue with, and one that arrives meanwhile."""
STOPPING_S = 6.0
"""Seconds a camera has to deliver its last frame before its thread is abandoned; RealSense gives up after 5."""


class Latest(Generic[T]):
    """The newest items of an iterable, read by its own thread, so that a slow consumer never delays the camera.

    The newest `waiting` items are kept in order; for each further one the oldest is dropped and counted. An exception
    of `frames` is raised to the consumer after the items before it; the end of `frames` ends the iteration. When the
    consumer stops, the thread stops and `frames` is closed.

        for frame in sv.Latest(camera):
            mapper.add(frame)

    Args:
        frames: The iterable for the thread, usually a live camera.
        waiting: Items kept, at least one.

    Attributes:
        dropped: Items dropped so far.
    """

    def __init__(self, frames: Iterable[T], waiting: int = WAITING):
        self._frames, self._capacity = frames, max(1, waiting)
        self.dropped = 0

    def __iter__(self) -> Iterator[T]:
        queue: _Queue[T] = _Queue(self._capacity)
        reader = Thread(target=self._read, args=(queue,), name="stereovox-camera", daemon=True)
        reader.start()
        try:
            yield from queue.items()
        finally:
            queue.stopped.set()
            reader.join(STOPPING_S)

    def _read(self, queue: _Queue[T]) -> None:
        """Fill the queue until the frames end or the consumer stops."""
        error = None
        try:
            with closing(self._frames) as frames:
                for frame in frames:
                    self.dropped += queue.put(frame)
                    if queue.stopped.is_set():
                        break
        except Exception as raised:
            error = raised
        finally:  # even if a library ends the thread: no consumer may wait forever
            queue.end(error)


class _Queue(Generic[T]):
    """A bounded queue between two threads; `stopped` is set when the consumer is gone."""

    def __init__(self, capacity: int):
        self._capacity, self._waiting = capacity, deque[T]()
        self._change, self._ended = Condition(), False
        self._error: Exception | None = None
        self.stopped = Event()

    def put(self, item: T) -> int:
        """Append an item; return how many were dropped for it."""
        with self._change:
            full = len(self._waiting) == self._capacity
            if full:
                self._waiting.popleft()
            self._waiting.append(item)
            self._change.notify()
        return int(full)

    def end(self, error: Exception | None) -> None:
        """Close the queue, with the error that ended the frames, if any."""
        with self._change:
            self._ended, self._error = True, error
            self._change.notify()

    def items(self) -> Iterator[T]:
        """Yield items as they arrive; raise the error that ended them."""
        while True:
            with self._change:
                self._change.wait_for(lambda: self._waiting or self._ended)
                if not self._waiting:
                    break
                item = self._waiting.popleft()
            yield item
        if self._error is not None:
            raise self._error


class LatestStream(Stream):
    """A live camera read through `Latest`."""

    def __init__(self, camera: Stream):
        self._camera = camera
        self._latest: Latest[AnyFrame] = Latest(camera)
        self.name, self.camera = camera.name, camera.camera
        self.notes, self.layout, self.posed = camera.notes, camera.layout, camera.posed

    @property
    def dropped(self) -> int:
        """Frames that the camera delivered but that were not consumed in time."""
        return self._latest.dropped

    def imu(self) -> Imu | None:
        """Return the IMU of the camera."""
        return self._camera.imu()

    def __iter__(self) -> Iterator[AnyFrame]:
        return iter(self._latest)


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
