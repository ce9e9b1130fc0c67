# SPDX-License-Identifier: Apache-2.0
"""The newest frames of a camera that does not wait: what nobody took in time is dropped, oldest first."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from threading import Condition, Event, Thread
from typing import Generic, TypeVar

from stereovox.frame import AnyFrame
from stereovox.sources.base import Stream

T = TypeVar("T")
WAITING = 2
"""Frames that wait while the map is busy: one to go on with, and one that is being taken meanwhile."""
STOPPING_S = 6.0
"""Seconds that a camera gets to deliver a last frame before it is left to itself; RealSense gives up after 5."""


class Latest(Generic[T]):
    """What `frames` delivers, read by a thread of its own, so that a slow consumer never holds the camera up.

    Of what was not taken yet the newest `waiting` wait, in order; the oldest is dropped for each that comes on top, and
    counted in `dropped`. What `frames` raises is raised here, after the frames before it; its end ends the iteration.
    When the consumer stops, so does the thread, and `frames` is closed.

        for frame in sv.Latest(camera):
            mapper.add(frame)
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
            frames = iter(self._frames)
            try:
                for frame in frames:
                    self.dropped += queue.put(frame)
                    if queue.stopped.is_set():
                        break
            finally:
                close = getattr(frames, "close", None)
                if close:  # a generator: the camera is to stop now
                    close()
        except Exception as raised:
            error = raised
        queue.end(error)


class _Queue(Generic[T]):
    """Items between two threads. stopped: nobody takes them any more."""

    def __init__(self, capacity: int):
        self._capacity, self._waiting = capacity, deque[T]()
        self._change, self._ended, self._error = Condition(), False, None
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
        """Say that no more items come, and why."""
        with self._change:
            self._ended, self._error = True, error
            self._change.notify()

    def items(self) -> Iterator[T]:
        """Yield items as they come; raise what ended them."""
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
    """The frames of a live camera as `Latest` has them."""

    def __init__(self, camera: Stream):
        self._latest: Latest[AnyFrame] = Latest(camera)
        self.name, self.camera = camera.name, camera.camera
        self.notes, self.layout = getattr(camera, "notes", ()), getattr(camera, "layout", "")

    @property
    def dropped(self) -> int:
        """Frames that the camera delivered and nobody took in time."""
        return self._latest.dropped

    def __iter__(self) -> Iterator[AnyFrame]:
        return iter(self._latest)
