# SPDX-License-Identifier: Apache-2.0
"""What a user waits for: until the first frame is in the map, with and without compiled kernels, and for `--help`."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import stereovox
from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.evaluate.bench_frames import Progress, silent
from stereovox.evaluate.bench_table import Table
from stereovox.frame import Frame

FIRST_FRAME = """
import pickle, sys, time
with open(sys.argv[1], "rb") as file:
    config, frame = pickle.load(file)
from stereovox import Mapper
ready = time.perf_counter()
mapper = Mapper(config)
report = mapper.add(frame)
first = time.perf_counter()
assert report.refused is None, report.detail
print("first frame is in", flush=True)
mapper.add(frame)
second = time.perf_counter()
print(first - ready, second - first, mapper.map.counts()["occupied"])
"""
"""What a fresh process does; the file holds settings and a frame."""
STARTS = {
    "python alone": ["-c", "pass"],
    "import stereovox": ["-c", "import stereovox"],
    "stereovox --help": ["-m", "stereovox", "--help"],
}


def first_frame(frame: Frame, config: Config, warm_runs: int = 3, tell: Progress = silent) -> dict[str, Any]:
    """Time fresh processes, from their start until `frame` is in the map: first without any compiled kernel.

    Returns seconds: `cold_s`; `warm_s`, the least of `warm_runs` with the kernels the first one left; `compile_s`,
    which is what lies between them; `cold_add_s`, `warm_add_s`: of these, the first `Mapper.add`; `second_add_s`; and
    `voxel_size`, `integrator`, `occupied` (cells, of the cold and the warm runs the same).
    """
    with tempfile.TemporaryDirectory(prefix="stereovox-bench-") as folder:
        given = Path(folder) / "given.pickle"
        given.write_bytes(pickle.dumps((config, frame)))
        cache = {"STEREOVOX_CACHE": str(Path(folder) / "cache")}
        runs = []
        for number in range(1 + warm_runs):
            tell(number, 1 + warm_runs, "first frame with compiled kernels" if number else "first frame, compiling")
            runs.append(_first_frame(given, cache))
            tell(number + 1, 1 + warm_runs, "first frame")
    cold, *warm = runs
    best = min(warm, key=lambda run: run["s"])
    return {
        "voxel_size": config.voxel_size,
        "integrator": config.integrator,
        "cold_s": cold["s"],
        "warm_s": best["s"],
        "compile_s": round(cold["s"] - best["s"], 3),
        "cold_add_s": cold["add_s"],
        "warm_add_s": best["add_s"],
        "second_add_s": min(run["second_s"] for run in warm),
        "occupied": sorted({run["occupied"] for run in runs}),
    }


def _first_frame(given: Path, environment: dict[str, str]) -> dict[str, Any]:
    start = perf_counter()
    with _process(["-c", FIRST_FRAME, str(given)], environment) as child:
        assert child.stdout
        said = child.stdout.readline()
        seconds = perf_counter() - start
        rest = child.stdout.read().split()
    if child.returncode or not said:
        raise StereovoxError(f"the process that adds a first frame ended with status {child.returncode}; see above")
    add_s, second_s, occupied = rest
    return {
        "s": round(seconds, 3),
        "add_s": round(float(add_s), 4),
        "second_s": round(float(second_s), 5),
        "occupied": int(occupied),
    }


def start_up(repeats: int = 7, tell: Progress = silent) -> dict[str, Any]:
    """Return milliseconds from start to end of fresh processes, by what they do: least and median of `repeats`."""
    times: dict[str, list[float]] = {name: [] for name in STARTS}
    for number in range(repeats):
        for name, words in STARTS.items():
            start = perf_counter()
            with _process(words, {}) as child:
                child.communicate()
            if child.returncode:
                raise StereovoxError(f"'{name}' ended with status {child.returncode}; see above")
            times[name].append(1e3 * (perf_counter() - start))
        tell(number + 1, repeats, "start-up")
    return {
        name: {"ms_min": round(min(took), 1), "ms_median": round(sorted(took)[len(took) // 2], 1)}
        for name, took in times.items()
    }


def _process(words: Sequence[str], environment: dict[str, str]) -> subprocess.Popen[str]:
    """Start Python, with this very stereovox, wherever it lies."""
    here = str(Path(stereovox.__file__).parents[1])
    paths = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    return subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, **environment},
    )


def first_frame_table(result: dict[str, Any]) -> Table:
    """Return the result of `first_frame` as a table."""
    rows = [
        ("no compiled kernels", f"{result['cold_s']:.2f}", f"{result['cold_add_s']:.2f}"),
        ("compiled kernels on the disk", f"{result['warm_s']:.2f}", f"{result['warm_add_s']:.2f}"),
        ("so compiling takes", f"{result['compile_s']:.2f}", ""),
    ]
    title = f"First frame in a fresh process, {result['integrator']}, {result['voxel_size']:g} m"
    second = f"The second frame takes {1e3 * result['second_add_s']:.1f} ms. The frame is in memory before the start."
    return Table(title, ("", "seconds", "of it Mapper.add"), [rows], [second])


def start_up_table(result: dict[str, Any]) -> Table:
    """Return the result of `start_up` as a table."""
    rows = [(name, f"{took['ms_min']:.0f}", f"{took['ms_median']:.0f}") for name, took in result.items()]
    return Table("Start-up", ("a fresh process", "ms, least", "median"), [rows])
