# SPDX-License-Identifier: Apache-2.0
"""Commands as a user calls them, and their output."""

import pytest


@pytest.fixture
def told(told_with_notes):
    """Runs a command with `--json` and returns the result."""
    return lambda *words: told_with_notes(*words)[0]
