# SPDX-License-Identifier: Apache-2.0
"""Threads: sharded kernels, locks of maps, steps that Ctrl-C does not interrupt halfway, and jobs for which only
the newest request counts."""

from __future__ import annotations

import os
import threading
from _signal import getsignal, signal  # pyrefly: ignore[missing-import] - without enumerations, so faster
from _thread import RLock
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from functools import lru_cache, wraps
from inspect import isgeneratorfunction
from signal import SIGINT, default_int_handler
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar

from stereovox.errors import StereovoxError

First = TypeVar("First")
Second = TypeVar("Second")
P = ParamSpec("P")
T = TypeVar("T")

MAX_THREADS = 256
CHANGING = ("_pool", "_times", "history", "kept")
"""Attributes of a map that `add` changes in place."""


def in_shards(work: Callable[[slice], None], parts: list[slice]) -> None:
    """Call `work(part)` for all parts in parallel; the result must not depend on the partition.

    It returns when all are done, and raises the error of one that failed.
    """
    mine, *others = parts
    if not others:
        work(mine)
        return
    running = [_pool().submit(work, part) for part in others]
    try:
        work(mine)
    finally:
        wait(running)
    for future in running:
        future.result()


def run_both(threads: int, first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Return the results of two independent calls, made in parallel if `threads` is not 1."""
    if threads == 1:
        return first(), second()
    running = _pool().submit(second)
    try:
        one = first()
    finally:
        wait([running])
    return one, running.result()


class Ahead(Generic[First, Second]):
    """A function, run by one thread at a time, that can start in the background before its result is needed."""

    def __init__(self, function: Callable[[First], Second]):
        self._function, self._alone = function, MapLock()
        self._begun: deque[tuple[First, Future[Second]]] = deque(maxlen=2)

    def begin(self, argument: First) -> None:
        """Call the function in the background; a later call with the same object returns its result or raises its
        error.

        Only the last two unclaimed results are kept. Nothing happens while two calls are unfinished:
        many that wait for one another could occupy the threads that the first of them needs.
        """
        if sum(not result.done() for _, result in tuple(self._begun)) < 2:
            self._begun.append((argument, _pool().submit(self._call, argument)))

    def __call__(self, argument: First) -> Second:
        """Return what the function returns."""
        for begun in tuple(self._begun):  # a copy, since another thread may begin a call meanwhile
            if begun[0] is argument:
                # compare by identity: arguments, such as frames, may not be comparable
                self._begun = deque((one for one in tuple(self._begun) if one is not begun), maxlen=2)
                return begun[1].result()
        return self._call(argument)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_begun": deque(maxlen=2)}  # a copy has no pending calls

    def _call(self, argument: First) -> Second:
        with self._alone:
            return self._function(argument)


def expecting(expect: Callable[[First], None], frames: Iterable[First]) -> Iterator[First]:
    """Yield frames, each after `expect` was called with the next one.

    An error of the source is raised after its last frame, as it would be without this.
    """
    coming = iter(frames)
    frame, failure = next(coming, None), None
    while frame is not None:
        following = None
        try:
            following = next(coming, None)
        except Exception as error:
            failure = error
        if following is not None:
            expect(following)
        yield frame
        if failure is not None:
            raise failure
        frame = following


class Scratch(Generic[T]):
    """Memory for work in parallel threads: each borrows one piece; a new one is made if none is free."""

    def __init__(self, make: Callable[[], T]):
        self._make = make
        self._free: list[T] = []

    def lend(self, work: Callable[[T], None]) -> None:
        """Call `work` with a piece of memory that no other thread uses meanwhile."""
        try:
            piece = self._free.pop()
        except IndexError:
            piece = self._make()
        try:
            work(piece)
        finally:
            self._free.append(piece)


def shards(length: int, threads: int) -> list[slice]:
    """Return slices of nearly equal size that cover range(length): one per thread, or a single one for little work."""
    if threads == 1 or length < 2 * threads:
        return [slice(0, length)]
    return [slice(length * i // threads, length * (i + 1) // threads) for i in range(threads)]


@lru_cache
def _pool() -> ThreadPoolExecutor:
    """Return the thread pool of this process; it starts only as many threads as are busy at once."""
    return ThreadPoolExecutor(MAX_THREADS, thread_name_prefix="stereovox")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked child has none of its parent's threads


class Newest:
    """Runs `job` one at a time; calls that arrive while it runs share the next run.

    For controls of a page, which call from many threads, and sliders that move faster than they can be drawn.
    """

    def __init__(self, job: Callable[[], None]):
        self._job = job
        self._running, self._counting = threading.RLock(), threading.Lock()
        self._asked = self._done = 0

    def __call__(self) -> None:
        """Return once a run of the job that started after this call has ended."""
        with self._counting:
            self._asked += 1
            mine = self._asked
        with self._running:
            if self._done < mine:
                with self._counting:
                    self._done = self._asked
                self._job()


class MapLock(RLock):  # pyrefly: ignore[invalid-inheritance] - only its stub calls it final
    """A re-entrant lock that can be copied and pickled; the copy is a new lock, not held by any thread."""

    def refuse_holder(self, what: str = "a frame cannot be added") -> None:
        """Raise StereovoxError if this thread holds the lock: waiting for another lock now could deadlock.

        what: start of the error message.
        """
        if self._is_owned():  # pyrefly: ignore[missing-attribute] - threading.Condition uses it too
            raise StereovoxError(
                f"{what} by a thread that holds the map's lock, as a listener does; do so once it is released"
            )

    def __reduce__(self) -> tuple[type[MapLock], tuple[()]]:
        return MapLock, ()


class Guarded:
    """A map whose public methods and properties hold `lock`, so that none sees a half-finished change.

    Generators hold it only while they make an item (`in_steps`), not while their caller works.
    lock: re-entrant; hold it over several calls that must see the same state.
    """

    lock: MapLock

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        for name, value in list(vars(cls).items()):
            if name.startswith("_"):
                continue
            if isinstance(value, property) and value.fget:
                setattr(cls, name, value.getter(_locked(value.fget)))
            elif isinstance(value, FunctionType) and not isgeneratorfunction(value):
                setattr(cls, name, _locked(value))

    def __copy__(self) -> Any:
        return deepcopy(self)  # two maps must not share cells while each has its own lock

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        twin = memo[id(self)] = type(self).__new__(type(self))
        with self.lock:
            vars(twin).update({name: deepcopy(value, memo) for name, value in self._without_listeners().items()})
        return twin

    def __getstate__(self) -> dict[str, Any]:
        with self.lock:  # the result is pickled after the lock is released
            changing = {name: deepcopy(value) for name, value in vars(self).items() if name in CHANGING}
            return {**self._without_listeners(), **changing}

    def _without_listeners(self) -> dict[str, Any]:
        """Return the attributes of a copy: all but the listeners."""
        return {name: [] if name == "listeners" else value for name, value in vars(self).items()}


def in_steps(lock: MapLock, items: Iterator[T]) -> Iterator[T]:
    """Yield the items of an iterator, holding the lock only while each is made."""
    while True:
        with lock:
            item = next(items, None)
        if item is None:
            return
        yield item


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C until the block is complete, so that a map is never half changed; then raise it."""
    on_main = threading.current_thread() is threading.main_thread()  # others are never interrupted
    if not on_main or getsignal(SIGINT) is not default_int_handler:
        yield
        return
    received: list[int] = []
    signal(SIGINT, lambda number, _: received.append(number))
    try:
        yield
    finally:
        signal(SIGINT, default_int_handler)
        if received:  # even if the block failed
            raise KeyboardInterrupt


def one_state(function: Callable[P, T]) -> Callable[P, T]:
    """Hold the locks of all maps among the arguments while `function` runs, so that it sees one state of each."""

    @wraps(function)
    def still(*args: P.args, **kwargs: P.kwargs) -> T:
        with _held([*args, *kwargs.values()]):
            return function(*args, **kwargs)

    return still


@contextmanager
def _held(values: list[Any]) -> Iterator[None]:
    locks = {id(value.lock): value.lock for value in values if isinstance(value, Guarded)}
    with ExitStack() as stack:
        for _, lock in sorted(locks.items()):  # the same order in all threads, or two could deadlock
            stack.enter_context(lock)
        yield


def _locked(method: Callable[..., T]) -> Callable[..., T]:
    @wraps(method)
    def alone(self: Guarded, *args: Any, **kwargs: Any) -> T:
        with self.lock:
            return method(self, *args, **kwargs)

    return alone
