# SPDX-License-Identifier: Apache-2.0
"""A short run of `fuzz/calls.py`, and that it would see what it looks for."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from calls import Outcome

CALLS = Path(__file__).resolve().parents[2] / "fuzz/calls.py"
QUICK_WORKERS = {"DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver"}
"""Those of a fleet import what they need once and not each; tests/fleet has some that begin as they do for users."""


def test_random_calls_of_all_commands_end_with_a_result_or_one_short_line():
    done = subprocess.run(
        [sys.executable, str(CALLS), "--calls", "150", "--seed", "1", "--json"],
        env={**os.environ, **QUICK_WORKERS},
        capture_output=True,
        text=True,
    )
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["problems"] == []
    assert (done.returncode, found["calls"]) == (0, 150)
    assert set(found["status"]) == {"0", "2"}
    assert found["status"]["0"] > 15
    assert len(found["command"]) > 15


@pytest.mark.parametrize(
    ("status", "printed", "problem"),
    [
        (0, "saved in a.svox\n", ""),
        (2, "a note\nstereovox: a.ply: empty; write it again\n", ""),
        (None, "Traceback (most recent call last)\n", "raised"),
        (2, "Traceback (most recent call last)\nstereovox: a.ply: empty\n", "raised"),
        (130, "stereovox: stopped\n", "ended with 130"),
        (0, "stereovox: a.ply: empty\n", "an error and yet 0"),
        (2, "", "0 errors, or not the last line"),
        (2, "stereovox: a.ply: empty\nlibpng: bad\n", "1 errors, or not the last line"),
        (2, "stereovox: a.ply: empty\nstereovox: a.ply: empty\n", "2 errors, or not the last line"),
        (2, f"stereovox: a.ply: {'x' * 300}\n", "an error of 318 characters"),
        (2, "stereovox: something is wrong\n", "names nothing of the call"),
    ],
)
def test_what_must_not_happen_is_seen(status, printed, problem, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert Outcome(["info", "folder/a.ply"], status, printed, 0.1).problem() == problem
