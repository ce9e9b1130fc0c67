# SPDX-License-Identifier: Apache-2.0
"""Queries a second, one thread, against octomap-python on the same cells if it is installed.

    python benchmarks/queries.py RECORDING [FRAMES] [--voxel-size 0.05] [--json]     for example recordings/kitchen ::4

All methods are called as a user calls them; the fastest of some runs counts. OctoMap answers one query a call.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from time import perf_counter

import numpy as np

import stereovox as sv

POINTS, RAYS, OCTOMAP = 1_000_000, 200_000, 20_000
FARTHEST = 5.0
RUNS = 7


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recording")
    parser.add_argument("frames", nargs="?", default="::1")
    parser.add_argument("--voxel-size", type=float, default=0.05)
    parser.add_argument("--json", action="store_true", help="one line of JSON in place of the table")
    wanted = parser.parse_args()
    mapper = sv.Mapper(voxel_size=wanted.voxel_size)
    for frame in sv.open_source(wanted.recording, wanted.frames):
        mapper.add(frame)
    rates = {**ours(mapper.map), **octomaps(mapper.map)}
    if wanted.json:
        print(json.dumps({"voxel_size": wanted.voxel_size, "cells": mapper.map.counts(), "per_second": rates}))
        return
    print(f"{wanted.voxel_size} m, {mapper.map.counts()}, load {os.getloadavg()[0]:.1f}")
    for name, rate in rates.items():
        print(f"{name:58} {rate / 1e6:8.3f} M/s")


def rate(n: int, query: Callable[..., object], *asked: object) -> float:
    """Return the rate of `n` queries per second; the first run, which may compile, does not count."""
    query(*asked)
    times = []
    for _ in range(RUNS):
        start = perf_counter()
        query(*asked)
        times.append(perf_counter() - start)
    return n / min(times)


def ours(m: sv.VoxelMap) -> dict[str, float]:
    rates = {}
    for name, points in {"random": anywhere(m, POINTS), "nearby": walks(m, POINTS)}.items():
        for dtype in ("float32", "float64"):
            for method in ("state", "log_odds", "probability"):
                rates[f"{method}: {name} points, {dtype}"] = rate(POINTS, getattr(m, method), points.astype(dtype))
    origin, all_round, ahead = rays(m, RAYS)
    rates["cast_rays: all round, to a hit or 5 m"] = rate(RAYS, m.cast_rays, origin, all_round, FARTHEST)
    rates["cast_rays: camera's view, to a hit or 5 m"] = rate(RAYS, m.cast_rays, origin, ahead, FARTHEST)
    points = anywhere(m, RAYS)
    ends = points + np.random.default_rng(3).normal(0, 0.3, (RAYS, 3))
    rates["check_boxes: of 0.4 m"] = rate(RAYS, m.check_boxes, points - 0.2, points + 0.2)
    rates["check_capsules: balls of 0.2 m"] = rate(RAYS, m.check_capsules, points, points, 0.2)
    rates["check_capsules: 0.2 m about 0.5 m"] = rate(RAYS, m.check_capsules, points, ends, 0.2)
    rates["nearest_obstacle: within 0.3 m"] = rate(RAYS, m.nearest_obstacle, points, 0.3)
    rates["nearest_obstacle: within 1 m"] = rate(RAYS, m.nearest_obstacle, points, 1.0)
    return rates


def octomaps(m: sv.VoxelMap) -> dict[str, float]:
    try:
        import octomap
    except ImportError:
        print("octomap-python is not installed; run: pip install 'stereovox[bench]'", file=sys.stderr)
        return {}
    tree = octomap.OcTree(m.voxel_size)
    for centers, occupied in ((m.free(), False), (m.occupied(), True)):
        for center in centers:
            tree.updateNode(center, occupied, True)
    tree.updateInnerOccupancy()
    points, (origin, all_round, ahead), end = anywhere(m, OCTOMAP), rays(m, OCTOMAP), np.empty(3)

    def search(points: np.ndarray) -> None:
        for point in points:
            tree.search(point)

    def cast(directions: np.ndarray) -> None:
        for direction in directions:
            tree.castRay(origin, direction, end, True, FARTHEST)

    return {
        "octomap-python search: random points": rate(OCTOMAP, search, points),
        "octomap-python getLabels: random points, one call": rate(OCTOMAP, tree.getLabels, points),
        "octomap-python castRay: all round, to a hit or 5 m": rate(OCTOMAP, cast, all_round),
        "octomap-python castRay: camera's view, to a hit or 5 m": rate(OCTOMAP, cast, ahead),
    }


def anywhere(m: sv.VoxelMap, n: int) -> np.ndarray:
    """Return points (n, 3) in the map's bounds."""
    low, high = m.bounds()
    return np.random.default_rng(0).uniform(low, high, (n, 3))


def walks(m: sv.VoxelMap, n: int) -> np.ndarray:
    """Return points (n, 3): thousand steps of centimetres from each of some occupied cells."""
    rng = np.random.default_rng(1)
    starts = rng.choice(m.occupied(), n // 1000)
    return (starts[:, None] + np.cumsum(rng.normal(0, 0.02, (n // 1000, 1000, 3)), axis=1)).reshape(-1, 3)


def rays(m: sv.VoxelMap, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the last camera position, and directions (n, 3) all around and within 53 degrees of its view."""
    rng = np.random.default_rng(2)
    T = m.viewpoint.T_world_camera
    ahead = np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)), np.ones(n)]) @ T[:3, :3].T
    return T[:3, 3].copy(), rng.normal(size=(n, 3)), ahead


if __name__ == "__main__":
    main()
