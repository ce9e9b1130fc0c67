# SPDX-License-Identifier: Apache-2.0
"""Run one kernel on several threads: kernels release the GIL, each shard writes its own part."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache


def in_shards(work: Callable[[slice], None], length: int, threads: int) -> None:
    """Call `work(part)` for `threads` slices that together cover range(length); the outcome must not depend on the cut."""
    if threads == 1 or length < 2 * threads:
        work(slice(0, length))
        return
    cuts = [length * i // threads for i in range(threads + 1)]
    pending = [_pool(threads).submit(work, slice(a, b)) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]
    for future in pending:
        future.result()


@lru_cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="stereovox")
