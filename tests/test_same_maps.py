# SPDX-License-Identifier: Apache-2.0
"""Maps are the same cells as ever: what recordings and simulations became is written down in `same_maps.json`.

    python tests/test_same_maps.py         write it anew, after a change that is meant to change maps

With the libraries of the table, on any x86-64 processor with fused multiply-add, maps must be the same bit for bit.
Elsewhere sums are rounded otherwise (docs/integrators.md), and a few cells may differ.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import zlib
from base64 import b64decode, b64encode
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from hashlib import sha256
from itertools import islice
from math import log1p
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import llvmlite.binding
import numba
import numpy as np
import pytest

import stereovox as sv
from stereovox.opening import open_robot

TABLE = Path(__file__).with_name("same_maps.json")
DATA = Path(__file__).resolve().parents[2] / "shared/data"
KITCHEN = DATA / "sevenscenes_redkitchen"
DRIVE = DATA / "kitti_raw/2011_09_26/2011_09_26_drive_9001_sync"
LOG = DATA / "carmen/fr079.clf.bz2"
FLIGHT = "sim:flight?length=120&speed=10&frames=90"
WINDOW = {"voxel_size": 0.2, "max_range": 4.0, "window.size": [14, 14, 12]}
FLOOR = "sim:floor?plan=testbed&seconds=10&scan_hz=4&depth_hz=2&image_width=160"
BINS = 1024
MIX = np.array([73_856_093, 19_349_663, 83_492_791])
"""Large primes: neighbours fall into bins far apart (Teschner et al. 2003)."""
MAX_OTHER = 1e-3
"""Share of the cells that may differ with other libraries or processors; without fused multiply-add it was 1.4e-4."""
FEW = 3
"""Cells that may differ of a small map."""


@dataclass(frozen=True)
class Cells:
    """What is known of a map of `frames`: integer indices (N, D), ascending; log-odds (N,); states (N,) uint8."""

    indices: np.ndarray
    log_odds: np.ndarray
    states: np.ndarray
    frames: int

    def rows(self) -> np.ndarray:
        """Return one row of bytes for each cell, in little endian."""
        parts = (self.indices.astype("<i8"), self.log_odds.astype("<f4")[:, None], self.states.astype("u1")[:, None])
        return np.hstack([np.ascontiguousarray(part).view(np.uint8) for part in parts])


@dataclass(frozen=True)
class Digest:
    """A map in a few words: how many frames it took, its cells, how many are in each `State`, and a hash of them all.

    bins: each cell belongs to one of BINS by its indices; a byte of the checksum of each, in base64. They tell about
    how many cells of two maps differ when only one of the maps is there.
    """

    frames: int
    cells: int
    states: list[int]
    sha256: str
    bins: str

    @classmethod
    def of(cls, cells: Cells) -> Digest:
        """Return what is written down of a map."""
        rows = cells.rows()
        bin_of = cells.indices.astype(np.int64) @ MIX[: cells.indices.shape[1]] % BINS
        order = np.argsort(bin_of, kind="stable")
        parts = np.split(rows[order], np.searchsorted(bin_of[order], np.arange(1, BINS)))
        sums = bytes(zlib.crc32(part.tobytes()) & 0xFF for part in parts)
        states = np.bincount(cells.states, minlength=4).tolist()
        return cls(cells.frames, len(rows), states, sha256(rows.tobytes()).hexdigest(), b64encode(sums).decode())

    def different_cells(self, other: Digest) -> float:
        """Return about how many cells are not the same: k cells hit BINS (1 - exp(-k / BINS)) bins."""
        mine, theirs = (np.frombuffer(b64decode(digest.bins), np.uint8) for digest in (self, other))
        share = min(float((mine != theirs).mean()) * 256 / 255, 1 - 1 / BINS)
        return -BINS * log1p(-share)


def cells_of(grown: Any) -> Cells:
    """Return all known cells of a `VoxelMap` or `GridMap` by its public queries."""
    indices, log_odds = grown.cells()
    centres = (indices + 0.5) * grown.voxel_size
    np.testing.assert_array_equal(grown.log_odds(centres), log_odds)
    return Cells(indices, log_odds, grown.state(centres), grown.history.frames)


def mapped(source: str | Path, frames: str, **settings: Any) -> Cells:
    """Return the cells of a map of `frames`; of one with a window what was saved."""
    with TemporaryDirectory() as folder:
        mapper = sv.Mapper(**settings, tiles=Path(folder) / "tiles" if "window.outside" in settings else None)
        for frame in sv.open_source(source, frames):
            mapper.add(frame)
        if "window.size" not in settings:
            return cells_of(mapper.map)
        mapper.map.save(Path(folder) / "map")
        mapper.map.close()
        return cells_of(sv.load_map(Path(folder) / "map"))


def floor(robot: str | Path, what: str, step: int, most: int, **settings: Any) -> Cells:
    """Return the cells of a floor by the robot's `scans` or `frames`, along its odometry, which drifts."""
    mapper = sv.GridMapper(**{"trust.max_disagreement": 1.0, **settings})
    for seen in islice(getattr(open_robot(robot), what), 0, most * step, step):
        mapper.add(seen)
    return cells_of(mapper.map)


RECORDED: dict[str, tuple[Path, Callable[[], Cells]]] = {
    **{
        f"kitchen {size:.2f}": (KITCHEN, partial(mapped, KITCHEN, frames, voxel_size=size))
        for size, frames in ((0.20, "::8"), (0.10, "::8"), (0.05, "::8"), (0.02, "::20"))
    },
    "drive": (DRIVE, partial(mapped, DRIVE, "::2", voxel_size=0.2, max_range=20.0)),
    "log": (LOG, partial(floor, LOG, "scans", 20, 150)),
}
SIMULATED: dict[str, Callable[[], Cells]] = {
    "room": partial(mapped, "sim:room", "::20", voxel_size=0.1),
    "room ray": partial(mapped, "sim:room", "::20", voxel_size=0.1, integrator="ray"),
    "room line": partial(mapped, "sim:room", "::20", profile="chien2020", voxel_size=0.1),
    "pairs": partial(mapped, "sim:surround?moments=4&scale=0.5", "::3", voxel_size=0.2),
    "flight": partial(mapped, FLIGHT, ":", **WINDOW),
    "flight keep": partial(mapped, FLIGHT, ":", **WINDOW, **{"window.outside": "keep"}),
    "floor lidar": partial(floor, FLOOR, "scans", 1, 40),
    "floor depth": partial(floor, FLOOR, "frames", 1, 20, profile="ist2019"),
}
MATCHED = {"drive", "pairs"}
"""Stereo pairs, whose images OpenCV rectifies, halves and clears of speckles: not alike in each of its versions."""
MAPS = {**{name: make for name, (_, make) in RECORDED.items()}, **SIMULATED}


def toolchain() -> dict[str, str | bool]:
    """Return all that rounding depends on.

    Maps were the same on processors with AVX2 and AVX-512, of numba (`NUMBA_CPU_NAME=haswell`), NumPy and OpenCV.
    """
    fused = bool(llvmlite.binding.get_host_cpu_features().get("fma")) and "NUMBA_CPU_NAME" not in os.environ
    libraries = {module.__name__: module.__version__ for module in (np, numba, llvmlite, cv2)}
    return {"machine": platform.machine(), "fma": fused, **libraries}


def problem(now: Digest, before: Digest, exact: bool) -> str | None:
    """Return in what `now` is another map than `before`, None if in nothing."""
    if exact or now.frames != before.frames:
        return (
            None if now == before else f"{now.different_cells(before):.0f} of {before.cells} cells, or frames, differ"
        )
    allowed = FEW + MAX_OTHER * before.cells
    numbers = np.abs(np.array([now.cells, *now.states]) - [before.cells, *before.states])
    off = max(float(numbers.max()), now.different_cells(before))
    return None if off <= allowed else f"{off:.0f} of {before.cells} cells differ, more than {allowed:.0f}"


def check(name: str) -> None:
    written = json.loads(TABLE.read_text())
    here, there = toolchain(), written["toolchain"]
    if name in MATCHED and here["cv2"] != there["cv2"]:
        pytest.skip(f"pairs were rectified by OpenCV {there['cv2']}, here it is {here['cv2']}")
    found = problem(Digest.of(MAPS[name]()), Digest(**written["maps"][name]), here == there)
    assert found is None, f"{name}: {found}; if that is meant: python tests/{Path(__file__).name}"


@pytest.mark.parametrize("name", SIMULATED)
def test_simulations_become_the_same_maps(name):
    check(name)


@pytest.mark.parametrize("name", RECORDED)
def test_recordings_become_the_same_maps(name):
    if not RECORDED[name][0].exists():
        pytest.skip(f"{RECORDED[name][0].name} is not in ../shared/data")
    check(name)


@pytest.fixture(scope="module")
def some():
    random = np.random.default_rng(0)
    indices = np.unique(random.integers(-40, 40, (20_000, 3)), axis=0)
    return Cells(indices, random.normal(size=len(indices)).astype("f4"), random.integers(1, 4, len(indices), "u1"), 9)


def changed(cells, every):
    """The same with a little more log-odds in each cell of so many."""
    log_odds = cells.log_odds.copy()
    log_odds[::every] += np.float32(0.001)
    return Digest.of(replace(cells, log_odds=log_odds))


def test_one_other_cell_is_seen_where_all_should_be_the_same(some):
    before, now = Digest.of(some), changed(some, 10**6)
    assert problem(before, before, exact=True) is None
    assert problem(now, before, exact=True)
    assert problem(now, before, exact=False) is None


@pytest.mark.parametrize("every", [3, 30, 300])
def test_many_other_cells_are_seen_everywhere(some, every):
    before, now = Digest.of(some), changed(some, every)
    assert "more than" in problem(now, before, exact=False)
    if every > 3:  # beyond that all bins differ
        assert now.different_cells(before) == pytest.approx(len(some.indices) / every, rel=0.2)


def test_lost_cells_other_states_and_other_frames_are_seen_everywhere(some):
    before, kept = Digest.of(some), len(some.indices) * 99 // 100
    fewer = Cells(some.indices[:kept], some.log_odds[:kept], some.states[:kept], 9)
    for other in (fewer, replace(some, states=np.full_like(some.states, 3)), replace(some, frames=8)):
        assert problem(Digest.of(other), before, exact=False)


if __name__ == "__main__":
    there = json.loads(TABLE.read_text())["maps"] if TABLE.exists() else {}
    absent = [name for name, (path, _) in RECORDED.items() if not path.exists()]
    if absent:
        sys.exit(f"no {', '.join(absent)} in ../shared/data: the table would be of two minds")
    made = {name: asdict(Digest.of(make())) for name, make in MAPS.items()}
    TABLE.write_text(json.dumps({"toolchain": toolchain(), "maps": made}, indent=1) + "\n")
    print("\n".join(f"{'same   ' if made[name] == there.get(name) else 'another'} {name}" for name in made))
