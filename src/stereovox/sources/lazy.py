# SPDX-License-Identifier: Apache-2.0
"""A sequence whose items are read when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar, overload

T = TypeVar("T")


class Lazy(Sequence[T]):
    """The items `read(k)` of the numbers `k`, each read anew whenever it is asked for; a slice is as lazy."""

    def __init__(self, read: Callable[[int], T], numbers: range):
        self._read, self._numbers = read, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, i: int) -> T: ...
    @overload
    def __getitem__(self, i: slice) -> Lazy[T]: ...
    def __getitem__(self, i: int | slice) -> T | Lazy[T]:
        if isinstance(i, slice):
            return Lazy(self._read, self._numbers[i])
        return self._read(self._numbers[i])
