# SPDX-License-Identifier: Apache-2.0
"""Threads: locks of maps, kernels in shards, and work of which only the newest request counts."""

from __future__ import annotations

import os
import threading
from _thread import RLock
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from functools import lru_cache, wraps
from inspect import isgeneratorfunction
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

from stereovox.errors import StereovoxError

First = TypeVar("First")
Second = TypeVar("Second")

MAX_THREADS = 256


def in_shards(work: Callable[[slice], None], parts: list[slice]) -> None:
    """Call `work(part)` for all parts at the same time; the outcome must not depend on the cut.

    Returns, or raises what one of them raised, when all are done.
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


def together(threads: int, first: Callable[[], First], second: Callable[[], Second]) -> tuple[First, Second]:
    """Return what two calls return that have nothing to do with each other, made at the same time if threads allow."""
    if threads == 1:
        return first(), second()
    running = _pool().submit(second)
    try:
        one = first()
    finally:
        wait([running])
    return one, running.result()


def shards(length: int, threads: int) -> list[slice]:
    """Return slices of nearly equal size that cover range(length): one a thread, or just one where little is to do."""
    if threads == 1 or length < 2 * threads:
        return [slice(0, length)]
    return [slice(length * i // threads, length * (i + 1) // threads) for i in range(threads)]


@lru_cache
def _pool() -> ThreadPoolExecutor:
    """Return the threads of this process; only as many are started as are busy at once."""
    return ThreadPoolExecutor(MAX_THREADS, thread_name_prefix="stereovox")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads


class Newest:
    """Runs `job` for whoever calls, one at a time; of calls that wait for one that runs, one run serves all.

    A page's controls call from many threads, and a slider that is dragged faster than it is drawn.
    """

    def __init__(self, job: Callable[[], None]):
        self._job = job
        self._running, self._counting = threading.RLock(), threading.Lock()
        self._asked = self._done = 0

    def __call__(self) -> None:
        """Return when the job was begun and ended after this call."""
        with self._counting:
            self._asked += 1
            mine = self._asked
        with self._running:
            if self._done < mine:
                with self._counting:
                    self._done = self._asked
                self._job()


P = ParamSpec("P")
T = TypeVar("T")


CHANGING = ("_pool", "_times", "history")
"""What `add` changes in place."""


class MapLock(RLock):  # pyright: ignore[reportGeneralTypeIssues] - only its stub calls it final
    """A re-entrant lock that can be copied and pickled: the copy is a lock of its own, which nobody holds."""

    def refuse_holder(self) -> None:
        """Raise StereovoxError where this thread holds the lock: who waits for another with it might wait for ever."""
        if self._is_owned():  # pyright: ignore[reportAttributeAccessIssue] - what threading.Condition asks
            raise StereovoxError(
                "a frame cannot be added by a thread that holds the map's lock, as a listener does; add it afterwards"
            )

    def __reduce__(self) -> tuple[type[MapLock], tuple[()]]:
        return MapLock, ()


class Guarded:
    """A map whose public methods and properties each hold `lock`, so that each meets the state between two changes.

    Generators do not: what they yield is made with the lock held (`in_steps`), and their reader works without it.
    lock: re-entrant; hold it over several calls that must meet the same state.
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
        return deepcopy(self)  # two maps must not share cells, each with a lock of its own

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        twin = memo[id(self)] = type(self).__new__(type(self))
        with self.lock:
            vars(twin).update({name: deepcopy(value, memo) for name, value in self._without_listeners().items()})
        return twin

    def __getstate__(self) -> dict[str, Any]:
        with self.lock:  # what it returns is pickled when the lock is given back
            changing = {name: deepcopy(value) for name, value in vars(self).items() if name in CHANGING}
            return {**self._without_listeners(), **changing}

    def _without_listeners(self) -> dict[str, Any]:
        """Return what a copy has: all but who listens to this map."""
        return {name: [] if name == "listeners" else value for name, value in vars(self).items()}


def in_steps(lock: MapLock, items: Iterator[T]) -> Iterator[T]:
    """Yield what an iterator yields; it holds the lock while it makes an item, its reader does not."""
    while True:
        with lock:
            item = next(items, None)
        if item is None:
            return
        yield item


def one_state(function: Callable[P, T]) -> Callable[P, T]:
    """Let none of the maps that `function` is given change while it runs: for what asks a map several times."""

    @wraps(function)
    def still(*args: P.args, **kwargs: P.kwargs) -> T:
        with _held([*args, *kwargs.values()]):
            return function(*args, **kwargs)

    return still


@contextmanager
def _held(values: list[Any]) -> Iterator[None]:
    locks = {id(value.lock): value.lock for value in values if isinstance(value, Guarded)}
    with ExitStack() as stack:
        for _, lock in sorted(locks.items()):  # in the same order in all threads, or two might wait for each other
            stack.enter_context(lock)
        yield


def _locked(method: Callable[..., T]) -> Callable[..., T]:
    @wraps(method)
    def alone(self: Guarded, *args: Any, **kwargs: Any) -> T:
        with self.lock:
            return method(self, *args, **kwargs)

    return alone
