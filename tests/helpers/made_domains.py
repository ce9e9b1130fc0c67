# SPDX-License-Identifier: Apache-2.0
"""ROS domains that no other test process on this machine uses."""

from __future__ import annotations

import socket

import pytest

LOCKS = 23600
"""Ports that stand for domains: who has bound one has the two domains."""


@pytest.fixture(scope="session")
def domains():
    """Two ROS domains that no other test process on this machine uses meanwhile: processes', and this one's."""
    for pair in range(1, 49):  # above 100 their ports may be in use
        with socket.socket() as lock:
            try:
                lock.bind(("127.0.0.1", LOCKS + pair))
            except OSError:
                continue
            yield 2 * pair, 2 * pair + 1
            return
    pytest.fail("all domains are in use")
