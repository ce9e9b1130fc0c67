# SPDX-License-Identifier: Apache-2.0
"""Lint, format and types are clean: the same three commands a contributor runs by hand."""

import ast
import importlib.util
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


@pytest.mark.parametrize("script", sorted(ROOT.glob("benchmarks/*.py")), ids=lambda script: script.stem)
def test_benchmarks_find_what_they_measure(script):
    """Nobody runs them between two changes, so names that moved away would show only when a figure is wanted."""
    for node in ast.walk(ast.parse(script.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("stereovox"):
            module = importlib.import_module(str(node.module))
            for name in node.names:
                assert hasattr(module, name.name) or importlib.util.find_spec(f"{node.module}.{name.name}"), name.name
