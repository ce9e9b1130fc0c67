# SPDX-License-Identifier: Apache-2.0
"""Time of a window's distance field: built from scratch, and updated after each frame; against SciPy.

    python benchmarks/distance.py RECORDING [FRAMES] [--voxel-size 0.05] [--size 10,3,10] [--json]

SciPy, and edt if it is installed, build the same field from scratch. Milliseconds of CPU, of all threads together, with
one thread, and of wall clock with two; medians of all frames (for builds from scratch: of some). If other programs run,
CPU and the ratios are more reliable.
"""

from __future__ import annotations

import argparse
import json
import os
from time import perf_counter, process_time

import numpy as np

import stereovox as sv
from stereovox.products.distance import DistanceField

RUNS, WARM = 5, 3
OBSTACLES = {"obstacles": [sv.State.OCCUPIED], "obstacles or unknown": [sv.State.OCCUPIED, sv.State.UNKNOWN]}
CASES = [(to, reach) for to in OBSTACLES for reach in (np.inf, 2.0)]
HEADS = (
    "to",
    "within",
    "scipy",
    "edt",
    "anew",
    "x scipy",
    "update",
    "90 %",
    "x scipy",
    "2: anew",
    "2: update",
    "changed",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recording")
    parser.add_argument("frames", nargs="?", default="::1")
    parser.add_argument("--voxel-size", type=float, default=0.05)
    parser.add_argument("--size", default="10,3,10", help="of the window, metres")
    parser.add_argument("--json", action="store_true", help="one line of JSON in place of the table")
    wanted = parser.parse_args()
    rows = [case(wanted, *each) for each in CASES]
    if wanted.json:
        print(json.dumps({"voxel_size": wanted.voxel_size, "size": wanted.size, "rows": rows}))
        return
    print(f"{rows[0]['cells']} cells, load {os.getloadavg()[0]:.1f}, ms")
    print(f"{HEADS[0]:22}" + "".join(f"{head:>10}" for head in HEADS[1:]))
    for row in rows:
        one, two = row["one"], row["two"]
        figures = [
            row["scipy"], row["edt"] or np.nan, one["anew_cpu"], row["scipy"] / one["anew_cpu"], one["update_cpu"],
            one["update_cpu_p90"], row["scipy"] / one["update_cpu"], two["anew"], two["update"], one["changed"],
        ]  # fmt: skip
        print(f"{row['to']:22}{row['within'] or 'all':>10}" + "".join(f"{figure:10.1f}" for figure in figures))


def case(wanted: argparse.Namespace, to: str, reach: float) -> dict:
    """Return the figures of one kind of field."""
    rows = {}
    for name, threads in (("one", 1), ("two", 2)):
        rows[name], made = run(wanted, threads, to=OBSTACLES[to], max_distance=reach)
    return {
        "to": to,
        "within": None if reach == np.inf else reach,
        "cells": int(made.obstacles.size),
        "scipy": timed(lambda: scipys(made, wanted.voxel_size))[1],
        "edt": edts(made, wanted.voxel_size),
        **rows,
    }


def run(wanted: argparse.Namespace, threads: int, **asked) -> tuple[dict, DistanceField]:
    """Return the figures of a run through the recording, and the field at its end."""
    mapper = sv.Mapper(voxel_size=wanted.voxel_size, threads=threads)
    field, updates, changed = None, [], []
    half = np.array([float(side) for side in wanted.size.split(",")]) / 2
    for frame in sv.open_source(wanted.recording, wanted.frames):
        mapper.add(frame)
        if field is None:  # a box about what the first camera looks at: no frame is spent on moving it
            T = mapper.map.viewpoint.T_world_camera
            middle = T[:3, 3] + 1.5 * T[:3, 2]
            field = DistanceField(mapper.map, middle - half, middle + half, **asked)
        start, cpu = perf_counter(), process_time()
        changed.append(field.update())
        updates.append((1e3 * (perf_counter() - start), 1e3 * (process_time() - cpu)))
    anew, anew_cpu = timed(lambda: DistanceField(mapper.map, middle - half, middle + half, **asked))
    assert (DistanceField(mapper.map, middle - half, middle + half, **asked).metres == field.metres).all()
    (update, update_cpu), p90 = np.median(updates[WARM:], axis=0), np.percentile(updates[WARM:], 90, axis=0)
    return {
        "anew": anew,
        "anew_cpu": anew_cpu,
        "update": float(update),
        "update_cpu": float(update_cpu),
        "update_cpu_p90": float(p90[1]),
        "changed": float(np.median(changed[WARM:])),
    }, field


def scipys(field: DistanceField, voxel_size: float) -> np.ndarray:
    from scipy.ndimage import distance_transform_edt

    return distance_transform_edt(~field.obstacles, sampling=voxel_size)


def edts(field: DistanceField, voxel_size: float) -> float | None:
    """Return the CPU of edt in milliseconds; None if it is not installed."""
    try:
        import edt
    except ImportError:
        return None
    return timed(lambda: edt.edt(np.ascontiguousarray(~field.obstacles), anisotropy=(voxel_size,) * 3))[1]


def timed(call) -> tuple[float, float]:
    """Return the median wall clock and CPU of some calls in milliseconds, after one that may compile."""
    call()
    times = []
    for _ in range(RUNS):
        start, cpu = perf_counter(), process_time()
        call()
        times.append((1e3 * (perf_counter() - start), 1e3 * (process_time() - cpu)))
    wall, cpu = np.median(times, axis=0)
    return float(wall), float(cpu)


if __name__ == "__main__":
    main()
