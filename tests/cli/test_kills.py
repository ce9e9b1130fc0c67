# SPDX-License-Identifier: Apache-2.0
"""Runs that are killed while they write: the disk holds a whole map, and the next run tidies up."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "helpers/made_kills.py"


@pytest.mark.parametrize(
    ("kind", "kills", "least"),
    [("merge", 6, 40), ("slam", 7, 25), ("grid", 4, 40), ("node, floor", 6, 60), ("node, space", 6, 90)],
)
def test_a_writer_that_is_killed_leaves_a_map_that_opens_and_nothing_that_stays(tmp_path, kind, kills, least):
    """One of the maps that it saved, or the one from before; the run after it leaves just its own files."""
    words = [sys.executable, SCRIPT, kind, tmp_path, str(kills)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= least
