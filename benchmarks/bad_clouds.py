# SPDX-License-Identifier: Apache-2.0
"""Share of good and of bad clouds and scans that are refused on their own.

    python benchmarks/bad_clouds.py [--seeds 3,4] [--data FOLDER] [--noise 0,0.02,0.05] [--json]

Good: the lidar's clouds and the 2-D scans of recordings in FOLDER (KITTI raw and stereo 2015, CARMEN logs), also with
only each 5th or 50th point; clouds of lidars of several patterns in simulated scenes, and in thickets of leaves; scans
of simulated floors. Bad: the same in millimetres, with ranges at random, and points at random in boxes. Nothing is
mapped: agreement of frames with each other and with the map is not checked.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

import stereovox as sv
from stereovox.depth.cloud import checked_cloud
from stereovox.depth.quality import checked_scan
from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.geometry.se3 import rotation_matrix
from stereovox.simulate.floors.floor import Floor
from stereovox.sources.robots.carmen import CarmenLog

SCENES = ("sim:room", "sim:town", "sim:apartment", "sim:offices", "sim:racks", "sim:hall", "sim:loop")
CONFIG = sv.load_config()
FAR_M = 100.0
Found = dict[str, Counter[str]]


def directions(pattern: str, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors (N, 3): `RINGSxSTEPS` of a spinning lidar, or `COUNT` at random in 70 by 25 degrees."""
    if "x" in pattern:
        rings, steps = map(int, pattern.split("x"))
        azimuth, height = np.meshgrid(
            np.linspace(-np.pi, np.pi, steps, endpoint=False),
            np.radians(np.linspace(-20, 12, rings)) if rings > 1 else [0.0],
        )
    else:
        azimuth, height = rng.uniform(-0.61, 0.61, int(pattern)), rng.uniform(-0.22, 0.22, int(pattern))
    x, y = np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(height), x.shape)], axis=-1).reshape(-1, 3)


PATTERNS = ("1x360", "1x1800", "4x900", "16x360", "32x512", "128x256", "300", "1000", "20000")


def simulated(seed: int, noises: list[float]) -> Iterator[tuple[str, np.ndarray]]:
    """Yield name and points (N, 3) of good clouds in simulated scenes."""
    rng = np.random.default_rng(seed)
    for where in SCENES:
        source = sv.open_source(f"{where}?seed={seed}")
        for i in np.linspace(0, len(source) - 1, 4).astype(int).tolist():
            T = source.true_pose(i)
            for pattern in PATTERNS:
                rays = directions(pattern, rng) @ rotation_matrix([0, 0, rng.uniform(-np.pi, np.pi)]).T
                ranges = source.scene.cast(T[:3, 3], rays.astype(np.float32))
                met = np.isfinite(ranges) & (ranges < FAR_M)
                for noise in noises:
                    noisy = ranges[met] + rng.normal(0, noise, met.sum())
                    yield f"simulated, noise {noise:g} m", rays[met] * noisy[:, None]


def thickets(seed: int) -> Iterator[tuple[str, np.ndarray]]:
    """Yield clouds of a meadow with bushes, in which a ray travels on average 0.2 or 0.5 m before it hits a leaf."""
    rng = np.random.default_rng(seed)
    for way in (0.2, 0.5):
        for pattern in PATTERNS:
            rays = directions(pattern, rng)
            with np.errstate(divide="ignore"):
                ranges = np.where(rays[:, 2] < -1e-3, -1.5 / rays[:, 2], np.inf)
            for _ in range(150):
                middle, radius = np.append(rng.uniform(-25, 25, 2), rng.uniform(-1.5, 1)), rng.uniform(0.5, 2.5)
                along = rays @ middle
                half = np.sqrt(np.maximum(along**2 - middle @ middle + radius**2, 0))
                leaf = np.maximum(along - half, 0.6) + rng.exponential(way, len(rays))
                ranges = np.where((half > 0) & (leaf < along + half), np.minimum(ranges, leaf), ranges)
            met = ranges < FAR_M
            yield "bushes", rays[met] * (ranges[met] + rng.normal(0, 0.02, met.sum()))[:, None]


def recorded(data: Path) -> Iterator[tuple[str, np.ndarray]]:
    """Yield clouds of recordings, whole and thinned."""
    rng = np.random.default_rng(0)
    for path in sorted(data.glob("kitti_*/**/velodyne*/**/*.bin")):
        points = np.fromfile(path, "<f4").reshape(-1, 4)[:, :3]
        for part in (1, 5, 50):
            yield (
                "KITTI, every point" if part == 1 else f"KITTI, each {part}th",
                points[rng.permutation(len(points))[::part]],
            )


def bad_of(points: np.ndarray, rng: np.random.Generator) -> Iterator[tuple[str, np.ndarray]]:
    """Yield bad clouds of as many points as a good one."""
    lengths = np.linalg.norm(points, axis=1)
    yield "in millimetres", 1000 * points
    for name, ranges in {
        "random ranges": rng.uniform(0.6, 20, len(points)),
        "random ranges about a mean": np.abs(rng.normal(8, 3, len(points))) + 0.6,
        "its ranges in any order": rng.permutation(lengths),
    }.items():
        yield name, points / np.maximum(lengths, 1e-9)[:, None] * ranges[:, None]
    yield "random in a cube", rng.uniform(-8, 8, points.shape)
    yield "random in a flat box", rng.uniform([-10, -10, -1], [10, 10, 2], points.shape)
    yield "random, normal", rng.normal(0, 5, points.shape)


def floors(seed: int) -> Iterator[Scan]:
    yield from list(Floor(f"sim:floor?seed={seed}&image_width=16&seconds=60").scans)


def bad_scans(scan: Scan, rng: np.random.Generator) -> Iterator[tuple[str, Scan]]:
    shape = scan.ranges.shape
    yield "in millimetres", replace(scan, ranges=scan.ranges * np.float32(1000), range_max=1000 * scan.range_max)
    yield "random ranges", replace(scan, ranges=rng.uniform(0.3, 10, shape).astype(np.float32))
    yield "its ranges in any order", replace(scan, ranges=rng.permutation(scan.ranges))
    yield "nothing", replace(scan, ranges=np.full(shape, -np.inf, np.float32))


def count(found: Found, name: str, seen: sv.Cloud | Scan) -> None:
    """Count a cloud or scan, and the reason of its refusal ("": accepted)."""
    reason = ""
    try:
        (checked_cloud if isinstance(seen, sv.Cloud) else checked_scan)(seen, CONFIG)
    except FrameRefused as refused:
        reason = refused.reason
    found.setdefault(name, Counter())[reason] += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", default="3,4", help="of scenes and noise; the constants were chosen on 0 and 1")
    parser.add_argument("--noise", default="0,0.02,0.05", help="metres")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--json", action="store_true")
    wanted = parser.parse_args()
    seeds, rng, found = [int(seed) for seed in wanted.seeds.split(",")], np.random.default_rng(7), Found()
    noises = [float(noise) for noise in wanted.noise.split(",")]
    clouds = [*recorded(wanted.data)]
    clouds += [one for seed in seeds for one in [*simulated(seed, noises), *thickets(seed)]]
    for n, (name, points) in enumerate(clouds):
        count(found, f"cloud, good: {name}", sv.Cloud(points, np.eye(4)))
        for bad, wrong in bad_of(points, rng) if n % 5 == 0 and len(points) >= 200 else ():
            count(found, f"cloud, bad: {bad}", sv.Cloud(wrong, np.eye(4)))
    logs = {path.name: CarmenLog(str(path)).scans for path in sorted(wanted.data.glob("carmen/*.clf.bz2"))}
    for name, scans in {**logs, **{f"sim:floor?seed={seed}": floors(seed) for seed in seeds}}.items():
        for n, scan in enumerate(scans):
            count(found, f"scan, good: {name}", scan)
            for bad, wrong in bad_scans(scan, rng) if n % 20 == 0 else ():
                count(found, f"scan, bad: {bad}", wrong)
    if wanted.json:
        print(json.dumps(found))
        return
    for name, counts in sorted(found.items()):
        why = ", ".join(f"{number} {reason}" for reason, number in counts.most_common() if reason)
        print(f"{name:45} {counts.total():6} {1 - counts[''] / counts.total():7.2%} refused  {why}")


if __name__ == "__main__":
    main()
