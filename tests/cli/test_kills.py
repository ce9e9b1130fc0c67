# SPDX-License-Identifier: Apache-2.0
"""Runs that are killed while they write: the disk holds a whole map, and the next run tidies up."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "helpers/made_kills.py"


KILLS = {"merge": 6, "slam": 7, "grid": 4, "node, floor": 6, "node, space": 6}


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """Returns what the script printed of each kind, and its errors."""
    words = [f"{kind}:{kills}" for kind, kills in KILLS.items()]
    command = [sys.executable, SCRIPT, tmp_path_factory.mktemp("kills"), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return dict(line.rsplit(":", 1) for line in done.stdout.splitlines()), done.stderr


@pytest.mark.parametrize(
    ("kind", "least"), [("merge", 40), ("slam", 25), ("grid", 40), ("node, floor", 60), ("node, space", 90)]
)
def test_a_writer_that_is_killed_leaves_a_map_that_opens_and_nothing_that_stays(killed, kind, least):
    """One of the maps that it saved, or the one from before; the run after it leaves just its own files."""
    steps, said = killed
    assert kind in steps, said
    assert int(steps[kind]) >= least
