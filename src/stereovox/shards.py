# SPDX-License-Identifier: Apache-2.0
"""Run one kernel on several threads: kernels release the GIL, each shard writes its own part."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from functools import lru_cache
from typing import TypeVar

First = TypeVar("First")
Second = TypeVar("Second")

MOST_THREADS = 256


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
    return ThreadPoolExecutor(MOST_THREADS, thread_name_prefix="stereovox")


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has none of its parent's threads
