# SPDX-License-Identifier: Apache-2.0
"""Nothing is compiled while the robot drives: in a process of its own, where nothing has been used before."""

from __future__ import annotations

import subprocess
import sys

import pytest

CODE = """
import sys
from numba.core.registry import CPUDispatcher
from stereovox.config import load_config
from stereovox.warm_up import warm_up
from stereovox.ros.localization import {kind}
from stereovox.simulate.floors.floor import Floor

def compiled():
    found = [one for module in list(sys.modules.values()) if getattr(module, "__name__", "").startswith("stereovox.")
             for one in vars(module).values() if isinstance(one, CPUDispatcher)]
    return {{(one.py_func.__module__, one.py_func.__name__, str(signature)) for one in found
             for signature in one.signatures}}

config = load_config("ist2019")
warm_up(config, localised=True)
floor = Floor("sim:floor?plan=testbed&depth_hz=0&scan_hz=4&seconds=30")
grid = floor.true_grid(0.05)
one = {made}
before = compiled()
for scan in floor.scans:
    one.add(scan)
print(sorted(compiled() - before))
"""
WAYS = {
    "SlamLocalization": "SlamLocalization(config)",
    "MapLocalization": "MapLocalization(grid, config, floor.start)",
}


@pytest.mark.parametrize("kind", WAYS)
def test_localisation_compiles_nothing_once_it_runs(kind):
    if kind == "SlamLocalization":
        pytest.importorskip("gtsam", reason="gtsam is not installed: pip install 'stereovox[slam]'")
    code = CODE.format(kind=kind, made=WAYS[kind])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "[]"
