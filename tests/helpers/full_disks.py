# SPDX-License-Identifier: Apache-2.0
"""A disk without room, as far as one process can feign it: no file may grow beyond a limit."""

from contextlib import contextmanager

import pytest


@contextmanager
def full_disk(most):
    """Let no file of this process grow beyond `most` bytes; the test is skipped where that cannot be limited."""
    resource = pytest.importorskip("resource", reason="this system limits no file sizes")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
