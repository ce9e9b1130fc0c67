# SPDX-License-Identifier: Apache-2.0
"""Pose corrections: time until the map is right again, equality with a new run, cost of kept frames.

    python benchmarks/correct.py RECORDING [--moved 100] [--voxel-size 0.05] [--runs 20] [--frames A:B:S] [--set ...]

Maps a recording with `map.keep_frames` and two threads. Random rotations (sigma 1 degree) and shifts (10 cm) move the
poses of `--moved` frames, or of all, `--runs` times with different seeds. Frames are offered again at 30 Hz while poses
are corrected, each with its own stamp.
"""

from __future__ import annotations

import argparse
import threading
from collections.abc import Sequence
from dataclasses import replace
from time import perf_counter, sleep
from typing import Any

import numpy as np

import stereovox as sv
from stereovox.config import parse_value
from stereovox.geometry.se3 import rotation_matrix

TRUSTING = {"trust.max_disagreement": 1, "trust.max_speed_mps": 1e6, "trust.max_turn_dps": 1e9, "trust.frozen": False}
"""A new run must not refuse what the corrected map holds."""
PERIOD_S = 1 / 30


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--moved", type=int, default=100)
    parser.add_argument("--voxel-size", type=float, default=0.05)
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--frames", default=":")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    more = {key: parse_value(value) for key, _, value in (one.partition("=") for one in given.set)}
    settings = {"voxel_size": given.voxel_size, "threads": 2, **TRUSTING, **more}
    frames = list(sv.open_source(given.recording, frames=given.frames))
    mapped(frames[:3], settings)  # compiles
    correct_some(frames[:9], 4, 1, settings, "compiling")
    tell_memory(frames, settings)
    keyframes = frames[:: max(1, len(frames) // given.moved)][: given.moved]
    correct_some(keyframes, len(keyframes), given.runs, settings, f"all of {len(keyframes)} keyframes")
    correct_some(frames, given.moved, given.runs, settings, f"{given.moved} of {len(frames)} frames")
    correct_live(frames, settings)


def mapped(frames: Sequence[Any], settings: dict[str, Any], keep: bool = True) -> sv.Mapper:
    mapper = sv.Mapper("default", **settings, **{"map.keep_frames": keep})
    for frame in frames:
        report = mapper.add(frame)
        assert report.refused is None, report.detail
    return mapper


def tell_memory(frames: Sequence[Any], settings: dict[str, Any]) -> None:
    """Print the cost of keeping frames, in time and in bytes."""
    seconds = {}
    for keep in (False, True, False, True):
        start = perf_counter()
        mapper = mapped(frames, settings, keep)
        seconds[keep] = min(seconds.get(keep, np.inf), perf_counter() - start)
    kept = mapper.map.kept_frames
    size = kept.bytes / len(kept)
    print(f"keeping a frame: {1e3 * (seconds[True] - seconds[False]) / len(frames):.2f} ms, {size / 1e3:.1f} kB")
    minute = ", ".join(f"{60 * rate * size / 1e6:.0f} MB at {rate} Hz" for rate in (30, 10, 5))
    print(f"a minute takes {minute}; 60 MB hold {60e6 / size / 60:.1f} frames a second")


def shaken(frames: Sequence[Any], moved: int, seed: int) -> tuple[list[Any], dict[int, Any]]:
    """Return the frames, some at other poses, and these by stamp."""
    random = np.random.default_rng(seed)
    chosen, poses, result = set(random.permutation(len(frames))[:moved].tolist()), {}, []
    for n, frame in enumerate(frames):
        if n in chosen:
            T = np.eye(4)
            T[:3, :3] = rotation_matrix(random.normal(0, np.radians(1), 3))
            T[:3, 3] = random.normal(0, 0.1, 3)
            frame = replace(frame, T_world_sensor=T @ frame.T_world_sensor)
            poses[frame.stamp_ns] = frame.T_world_sensor
        result.append(frame)
    return result, poses


def correct_some(frames: Sequence[Any], moved: int, runs: int, settings: dict[str, Any], what: str) -> None:
    """Correct a map repeatedly, and compare it each time with a new one."""
    mapper, seconds, differing, known = mapped(frames, settings), [], 0, 0
    first = {frame.stamp_ns: frame.T_world_sensor for frame in frames}
    for seed in range(runs):
        others, poses = shaken(frames, moved, seed)
        start = perf_counter()
        report = mapper.correct(poses)
        seconds.append(perf_counter() - start)
        new = mapped(others, settings, keep=False)
        differing += different_cells(mapper.map, new.map)
        known += sum(new.map.counts().values())
        new.close()
        mapper.correct(first)
    print(
        f"{what}: {np.median(seconds):.2f} s (median; {min(seconds):.2f} to {max(seconds):.2f}), {report.mapped} "
        f"frames mapped again, {report.blocks} blocks; {differing} of {known} cells differ from {runs} new runs"
    )


def different_cells(a: sv.VoxelMap, b: sv.VoxelMap) -> int:
    """Return the number of cells whose stored numbers differ."""
    (these, cells), (those, others) = a.storage.blocks(), b.storage.blocks()
    if not np.array_equal(these, those):
        return len(set(map(tuple, a.cells()[0].tolist())) ^ set(map(tuple, b.cells()[0].tolist())))
    return int(np.count_nonzero(cells != others))


def correct_live(frames: Sequence[Any], settings: dict[str, Any]) -> None:
    """Correct all poses while frames arrive at 30 Hz; print how late they were mapped."""
    mapper, late, done = mapped(frames, settings), [], threading.Event()
    last_ns = max(frame.stamp_ns for frame in frames)

    def come() -> None:
        start = perf_counter()
        while not done.is_set():
            n = len(late)
            sleep(max(0.0, start + n * PERIOD_S - perf_counter()))
            again = replace(frames[n % len(frames)], stamp_ns=last_ns + 1 + int(1e9 * n * PERIOD_S))
            mapper.add(again)
            late.append(perf_counter() - start - n * PERIOD_S)

    coming = threading.Thread(target=come)
    coming.start()
    sleep(1.0)
    start = perf_counter()
    mapper.correct(shaken(frames, len(frames), 0)[1])
    seconds = perf_counter() - start
    done.set()
    coming.join()
    over = sum(one > PERIOD_S for one in late)
    print(
        f"all of {len(frames)} frames while others come at 30 Hz: {seconds:.2f} s; of {len(late)} frames {over} were "
        f"in the map later than 33 ms after they came, at most {1e3 * max(late):.0f} ms"
    )


if __name__ == "__main__":
    main()
