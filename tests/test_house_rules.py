# SPDX-License-Identifier: Apache-2.0
"""Lint, format and types are clean: the same three commands a contributor runs by hand."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
COMMANDS = {
    "lint": ["ruff", "check", "--no-cache"],
    "format": ["ruff", "format", "--no-cache", "--check"],
    "types": ["basedpyright", "--pythonpath", sys.executable],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_house_rule(name):
    command = [sys.executable, "-m", *COMMANDS[name]]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{' '.join(command[2:])}\n{done.stdout[-4000:]}{done.stderr[-2000:]}"
