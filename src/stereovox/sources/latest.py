# SPDX-License-Identifier: Apache-2.0
"""The newest frames of a live camera: frames that are not consumed in time are dropped, oldest first."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
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
