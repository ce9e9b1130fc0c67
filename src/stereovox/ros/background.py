# SPDX-License-Identifier: Apache-2.0
"""Work in a thread of its own, while the node's thread keeps receiving messages."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Generic, TypeVar

T = TypeVar("T")


class Background(Generic[T]):
    """Runs tasks in order. One thread, the node's, calls all methods.

    name: of the thread.
    """

    def __init__(self, name: str):
        self._pool = ThreadPoolExecutor(1, name)
        self._waiting: deque[Callable[[], T]] = deque()
        self._running: Future[T] | None = None

    def put(self, work: Callable[[], T], newest_only: bool = False) -> None:
        """Add a task; newest_only: it replaces all tasks that have not begun yet."""
        if newest_only:
            self._waiting.clear()
        self._waiting.append(work)
        if self._running is None:
            self._begin()

    def poll(self) -> Future[T] | None:
        """Return the task that has ended, if any, and begin the next one."""
        if self._running is None or not self._running.done():
            return None
        ended = self._running
        self._begin()
        return ended

    def rest(self) -> Iterator[Future[T]]:
        """Run all remaining tasks; yield each when it has ended."""
        while self._running is not None:
            wait([self._running])
            ended = self.poll()
            if ended is not None:
                yield ended

    def drop(self) -> None:
        """Discard all tasks that have not begun, and wait for the one that has."""
        self._waiting.clear()
        if self._running is not None:
            wait([self._running])
            self._running = None

    def _begin(self) -> None:
        self._running = self._pool.submit(self._waiting.popleft()) if self._waiting else None
