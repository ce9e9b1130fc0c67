# SPDX-License-Identifier: Apache-2.0
"""Start-up times: until the first frame is mapped, with and without compiled kernels, and for `--help`."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from time import perf_counter
from typing import Any

import stereovox
from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.frame import Frame
from stereovox_lab.bench.frames import Progress, silent
from stereovox_lab.bench.results import Table

FIRST_FRAMES = 5
"""Frames until every kernel has run: some are needed only once a map is no longer new."""
FIRST_FRAME = """
import pickle, sys, time
with open(sys.argv[1], "rb") as file:
    config, frames = pickle.load(file)
from stereovox import Mapper
mapper = Mapper(config)
for frame in frames:
    start = time.perf_counter()
    report = mapper.add(frame)
    assert report.refused is None, report.detail
    print(time.perf_counter() - start, flush=True)
print(mapper.map.counts()["occupied"])
"""
"""Program of a fresh process; the file has settings and frames. It writes a line per frame added."""
STARTS = {
    "python alone": ["-c", "pass"],
    "import stereovox": ["-c", "import stereovox"],
    "stereovox --help": ["-m", "stereovox", "--help"],
}


def first_frame(frames: Sequence[Frame], config: Config, warm_runs: int = 3, tell: Progress = silent) -> dict[str, Any]:
    """Time fresh processes, from their start until the first of `frames` is in the map, and until the fifth is.

    First without compiled kernels, then `warm_runs` times with the cached ones: the fastest counts. If there are fewer
    than five frames, all are used.

    Returns seconds: `cold_s`, `warm_s` until the first frame is in; `cold_all_s`, `warm_all_s` until all are;
    `compile_s`, the difference of these two; `cold_add_s`, `warm_add_s`: the first `Mapper.add`; `last_add_s`;
    and `frames` (how many), `voxel_size`, `integrator`, `occupied` (cells, of the cold and the warm runs the same).
    """
    first = frames[:FIRST_FRAMES]
    with tempfile.TemporaryDirectory(prefix="stereovox-bench-") as folder:
        given = Path(folder) / "given.pickle"
        given.write_bytes(pickle.dumps((config, first)))
        cache = {"STEREOVOX_CACHE": str(Path(folder) / "cache")}
        runs = []
        for number in range(1 + warm_runs):
            tell(number, 1 + warm_runs, "first frame with compiled kernels" if number else "first frame, compiling")
            runs.append(_first_frame(given, cache))
            tell(number + 1, 1 + warm_runs, "first frame")
    cold, *warm = runs
    best = min(warm, key=lambda run: run["all_s"])
    return {
        "frames": len(first),
        "voxel_size": config.voxel_size,
        "integrator": config.integrator,
        "cold_s": cold["s"],
        "warm_s": best["s"],
        "cold_all_s": cold["all_s"],
        "warm_all_s": best["all_s"],
        "compile_s": round(cold["all_s"] - best["all_s"], 3),
        "cold_add_s": cold["add_s"],
        "warm_add_s": best["add_s"],
        "last_add_s": min(run["last_s"] for run in warm),
        "occupied": sorted({run["occupied"] for run in runs}),
    }


def _first_frame(given: Path, environment: dict[str, str]) -> dict[str, Any]:
    start = perf_counter()
    with _process(["-c", FIRST_FRAME, str(given)], environment) as child:
        assert child.stdout
        said = [(perf_counter() - start, float(line)) for line in child.stdout]
    if child.returncode:
        raise StereovoxError(f"the process that adds a first frame ended with status {child.returncode}; see above")
    *added, (_, occupied) = said
    return {
        "s": round(added[0][0], 3),
        "all_s": round(added[-1][0], 3),
        "add_s": round(added[0][1], 4),
        "last_s": round(added[-1][1], 5),
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


@contextmanager
def _process(words: Sequence[str], environment: dict[str, str]) -> Iterator[subprocess.Popen[str]]:
    """Start Python, with this very stereovox, wherever it is; it never outlives the block.

    A terminal's Ctrl-C does not reach it (it has its own session): we get it, and end the process silently.
    """
    here = str(Path(stereovox.__file__).parents[1])
    paths = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    child = subprocess.Popen(
        [sys.executable, *words],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": paths, **environment},
        start_new_session=True,
    )
    with child:
        try:
            yield child
            child.wait()
        except BaseException:
            child.kill()
            child.wait()
            raise


def first_frame_table(result: dict[str, Any]) -> Table:
    """Return the result of `first_frame` as a table."""
    rows = [
        ("no compiled kernels", *(f"{result[f'cold_{name}']:.2f}" for name in ("s", "add_s", "all_s"))),
        ("compiled kernels on the disk", *(f"{result[f'warm_{name}']:.2f}" for name in ("s", "add_s", "all_s"))),
        ("so compiling takes", f"{result['cold_s'] - result['warm_s']:.2f}", "", f"{result['compile_s']:.2f}"),
    ]
    title = f"First frame in a fresh process, {result['integrator']}, {result['voxel_size']:g} m"
    head = ("", "first frame, s", "of it Mapper.add", f"frame {result['frames']}, s")
    last = f"Frame {result['frames']} takes {1e3 * result['last_add_s']:.1f} ms."
    return Table(title, head, [rows], [f"{last} The frames are in memory before the start."])


def start_up_table(result: dict[str, Any]) -> Table:
    """Return the result of `start_up` as a table."""
    rows = [(name, f"{took['ms_min']:.0f}", f"{took['ms_median']:.0f}") for name, took in result.items()]
    return Table("Start-up", ("a fresh process", "ms, least", "median"), [rows])
