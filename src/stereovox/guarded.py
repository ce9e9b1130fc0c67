# SPDX-License-Identifier: Apache-2.0
"""What several threads may use at once: maps with a lock that every public call holds."""

from __future__ import annotations

from _thread import RLock
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from copy import deepcopy
from functools import wraps
from inspect import isgeneratorfunction
from types import FunctionType
from typing import Any, ParamSpec, TypeVar

from stereovox.errors import StereovoxError

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
