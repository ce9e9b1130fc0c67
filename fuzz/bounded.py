# SPDX-License-Identifier: Apache-2.0
"""Run a target on bytes, with limits on its exceptions, time and memory."""

from __future__ import annotations

import resource
import time
from pathlib import Path

from stereovox.errors import StereovoxError
from targets import Target

MAX_SECONDS = 1.0
"""Processor time over all threads: a busy machine must not look like a hang."""
MAX_GROWTH = 1 << 30
"""Largest growth of the process's peak memory in one run, in bytes."""


class Unbounded(AssertionError):  # noqa: N818 - reads as what happened
    """A reader took too much time or memory."""


def check(target: Target, data: bytes, folder: Path, most_seconds: float = MAX_SECONDS) -> str:
    """Return `read` or `refused`; raises the target's forbidden exceptions, and Unbounded."""
    memory, start = peak_bytes(), time.process_time()
    try:
        target.read(data, folder)
        outcome = "read"
    except StereovoxError as error:
        outcome = "refused"
        if not str(error).isprintable() or not str(error):
            raise AssertionError(f"no single line: {error!r}") from error
    if (took := time.process_time() - start) > most_seconds:
        raise Unbounded(f"took {took:.1f} s")
    if (grown := peak_bytes() - memory) > MAX_GROWTH:
        raise Unbounded(f"took {grown >> 20} MiB")
    return outcome


def peak_bytes() -> int:
    """Return the peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
