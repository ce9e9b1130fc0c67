# SPDX-License-Identifier: Apache-2.0
"""Nothing is compiled while the robot drives: in a fresh process, which has used nothing before."""

from __future__ import annotations

import pytest

CODE = """
import sys
import numpy as np
from numba.core.registry import CPUDispatcher
from stereovox import Cloud, Mapper, Tracker, load_config, open_source
from stereovox.runs.warm_up import warm_up
from stereovox.ros.poses.localization import MapLocalization, SlamLocalization
from stereovox.simulate.floors.floor import Floor

def compiled():
    found = [one for module in list(sys.modules.values()) if getattr(module, "__name__", "").startswith("stereovox.")
             for one in vars(module).values() if isinstance(one, CPUDispatcher)]
    return {{(one.py_func.__module__, one.py_func.__name__, str(signature)) for one in found
             for signature in one.signatures if ".simulate." not in one.py_func.__module__}}

{before}
before = compiled()
{then}
print(sorted(compiled() - before))
"""
FLOOR = """
config = load_config("ist2019")
warm_up(config, localised=True)
floor = Floor("sim:floor?plan=testbed&depth_hz=0&scan_hz=4&seconds=30")
grid = floor.true_grid(0.05)
one = {}
"""
SCANS = """
for scan in floor.scans:
    one.add(scan)
"""
ROOM = """
config = load_config("default")
warm_up(config, tracked=True, clouds=True)
"""
FRAMES = """
one = Tracker(config)
for frame in open_source("sim:room?photo=0.5", frames=":8"):
    one.add(frame)
points = np.random.default_rng(0).normal(0.0, 3.0, (1000, 3))
mapper = Mapper(config)
for stamp_ns, dtype in enumerate((np.float32, np.float64)):
    mapper.add(Cloud(points.astype(dtype), np.eye(4), stamp_ns))
"""
WAYS = {
    "slam": (FLOOR.format("SlamLocalization(config)"), SCANS),
    "localised": (FLOOR.format("MapLocalization(grid, config, floor.start)"), SCANS),
    "tracked": (ROOM, FRAMES),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_was_warmed_up_compiles_nothing_once_it_runs(way, tmp_path, run_script):
    if way == "slam":
        pytest.importorskip("gtsam", reason="gtsam is not installed: pip install 'stereovox[slam]'")
    before, then = WAYS[way]
    (tmp_path / "warm.py").write_text(CODE.format(before=before, then=then))
    status, said = run_script(tmp_path / "warm.py")
    assert status == 0, said
    assert said.splitlines()[-1] == "[]"
