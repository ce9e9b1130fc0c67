# SPDX-License-Identifier: Apache-2.0
"""The clock on the wall, by which cameras and other programs stamp: to measure ages and to stamp what is played.

It may be set at any moment, so nothing waits, ends or is decided by it; a test keeps it out of all other files.
"""

from __future__ import annotations

from time import time_ns


def epoch_ns() -> int:
    """Return nanoseconds since 1970 by this machine's clock."""
    return time_ns()
