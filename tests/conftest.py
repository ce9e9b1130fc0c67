# SPDX-License-Identifier: Apache-2.0
"""What tests of several rooms need."""

import signal

import pytest


@pytest.fixture
def obeys_signals():
    """A process started in the background or by nohup ignores some, and so would its tests and its children."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL, signal.SIGHUP: signal.SIG_DFL}
    before = {number: signal.signal(number, handler) for number, handler in usual.items()}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)
