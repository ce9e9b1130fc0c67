# SPDX-License-Identifier: Apache-2.0
"""For how long does a new map believe a bad first image, and does it keep a good one?

    python benchmarks/first_images.py [--seeds 0:20] [--hz 10] [--voxel-size 0.1] [--clouds | --pairs] [--json]

The first frame of a map is bad in one of many ways, or good; three good ones follow. Each seed is a random hall and a
random place on the path through it; with --pairs a place on the way of the surround cameras. refused: at once. kept:
frames that are part of the map after one, two and three good ones; believed: kept, and the map's health is not
`waiting`. free: surface points of the good frames that such a map says are free, less those of a map without the bad
frame, as a share of all; after the three, median and largest.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from typing import Any

import numpy as np

import stereovox as sv
from stereovox.frame import CheckedCloud
from stereovox.simulate.surround import Surround
from stereovox_lab.checks.bad_images import _bad_depths, _bad_pairs
from stereovox_lab.checks.lasting import FAULTS, Bad, Walk, _always

GOOD = 3
"""Good frames after the first."""
ROUND_S, APART_S = 35.0, 15.0


def frames(seed: int, wanted: argparse.Namespace) -> Iterator[tuple[str, Any, list[Any]]]:
    """Yield for each kind its name, the first frame, and the good ones that follow."""
    rng = np.random.default_rng([seed, 3])
    if wanted.pairs:
        source = Surround(f"sim:surround?pair=front&scale=0.3&seed={seed}")
        begin = int(rng.integers(0, len(source) - GOOD - 1))
        first, *good = (source.frame(begin + n) for n in range(GOOD + 1))
        kinds = list(_bad_pairs(first, rng))
    else:
        walk = Walk(seed, wanted.clouds)
        world, begin, seconds = _always(walk.stage.build()), float(rng.uniform(0, ROUND_S)), (GOOD + 1) / wanted.hz
        first, *good = walk.frames(begin, seconds, wanted.hz, world)
        bad = Bad([first, *good], walk.frames(begin + APART_S, seconds, wanted.hz, world), rng)
        kinds = [] if wanted.clouds else list(_bad_depths(first, rng))
        kinds += [(f"fault: {kind}", spoil(first, 0, bad)) for kind, spoil in FAULTS.items()]
    yield "good", first, good
    for kind, frame in kinds:
        yield kind, frame, good


def outcome(first: Any, good: list[Any], wanted: argparse.Namespace) -> dict[str, Any]:
    """Return what became of a first frame."""
    mapper = sv.Mapper(voxel_size=wanted.voxel_size, max_range=5.0)
    refused = mapper.add(first).refused
    kept, believed, here = [], [], not refused
    for frame in good:
        taken_out = mapper.add(frame).taken_out
        here = here and not taken_out
        kept.append(here)
        believed.append(here and mapper.health().state != "waiting")
    return {"refused": refused, "kept": kept, "believed": believed, "free": free(mapper, good, wanted)}


def free(mapper: sv.Mapper, good: list[Any], wanted: argparse.Namespace) -> float:
    """Return the share of the points of good frames in cells that are free in this map, and in one without the bad."""
    control = sv.Mapper(voxel_size=wanted.voxel_size, max_range=5.0)
    points = []
    for frame in good:
        control.add(frame)
        image = control._deadline.quality().prepare(frame)[1]
        seen = image.ends[image.hits] if isinstance(image, CheckedCloud) else _points(image)
        points.append(seen @ image.T_world_sensor[:3, :3].T + image.T_world_sensor[:3, 3])
    there = np.concatenate(points)
    mine, theirs = (one.map.state(there) == sv.State.FREE for one in (mapper, control))
    return float((mine & ~theirs).mean())


def _points(image: Any) -> np.ndarray:
    x, y = image.camera.ray_slopes()
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), axis=-1)
    return (rays * image.depth_m[..., None])[np.isfinite(image.depth_m) & (image.depth_m > 0)]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", default="0:20", help="a Python slice; the constants were chosen on 100:106")
    parser.add_argument("--hz", type=float, default=10.0)
    parser.add_argument("--voxel-size", type=float, default=0.1)
    parser.add_argument("--clouds", action="store_true")
    parser.add_argument("--pairs", action="store_true")
    parser.add_argument("--json", action="store_true")
    wanted = parser.parse_args()
    found: dict[str, list[dict[str, Any]]] = {}
    for seed in range(*map(int, wanted.seeds.split(":"))):
        for kind, first, good in frames(seed, wanted):
            found.setdefault(kind, []).append(outcome(first, good, wanted))
    if wanted.json:
        print(json.dumps(found))
        return
    for kind, all_ in found.items():
        refused = sum(bool(one["refused"]) for one in all_)
        kept, believed = (np.sum([one[name] for one in all_], axis=0).tolist() for name in ("kept", "believed"))
        most = [one["free"] for one in all_]
        print(
            f"{kind:28} {len(all_):3} first frames: refused {refused:3}, kept {kept}, believed {believed}, "
            f"free {np.median(most):.2%}, {max(most):.2%}"
        )


if __name__ == "__main__":
    main()
