# SPDX-License-Identifier: Apache-2.0
"""Work in a thread of its own, while the node's thread goes on receiving messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

T = TypeVar("T")


class Background(Generic[T]):
    """Does one piece of work after the other. One thread, the node's, calls all methods.

    name: of the thread.
    """

    def __init__(self, name: str):
        self._pool = ThreadPoolExecutor(1, name)
        self._waiting: deque[Callable[[], T]] = deque()
        self._running: Future[T] | None = None

    def put(self, work: Callable[[], T], newest_only: bool = False) -> None:
        """Add a piece of work; newest_only: in the place of all that has not begun yet."""
        if newest_only:
            self._waiting.clear()
        self._waiting.append(work)
        if self._running is None:
            self._begin()

    def poll(self) -> Future[T] | None:
        """Return a piece of work that has ended, if any, and begin the next one."""
        if self._running is None or not self._running.done():
            return None
        ended = self._running
        self._begin()
        return ended

    def rest(self) -> Iterator[Future[T]]:
        """Do all that is left; yield each piece of work when it has ended."""
        while self._running is not None:
            wait([self._running])
            ended = self.poll()
            if ended is not None:
                yield ended

    def drop(self) -> None:
        """Forget all that has not begun, and wait for what has."""
        self._waiting.clear()
        if self._running is not None:
            wait([self._running])
            self._running = None

    def _begin(self) -> None:
        self._running = self._pool.submit(self._waiting.popleft()) if self._waiting else None
