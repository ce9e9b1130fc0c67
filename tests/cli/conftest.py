# SPDX-License-Identifier: Apache-2.0
"""Commands as a user calls them, and what they tell."""

import json

import pytest

from stereovox.cli import main


@pytest.fixture
def told_with_notes(capsys):
    """Runs a command with `--json` and returns the result and what it said besides."""

    def run(*words):
        status = main([*map(str, words), "--json"])
        out, err = capsys.readouterr()
        assert status == 0, err
        return json.loads(out.splitlines()[-1]), err

    return run


@pytest.fixture
def told(told_with_notes):
    """Runs a command with `--json` and returns the result."""
    return lambda *words: told_with_notes(*words)[0]
