# SPDX-License-Identifier: Apache-2.0
"""Lidar clouds: time per cloud and prediction of held-out ones, against other libraries on the same points.

    python benchmarks/clouds.py 'DRIVE?sensor=velodyne' [--voxel-size 0.2] [--max-range 60] [--every 5] [--frames A:B:S]
        [--peers octomap octomap-cpp wavemap-cpp] [--rounds 3] [setting=value ...]

Each map is made from all clouds except every fifth. Time: of the library's own call, the median over clouds of the best
of some rounds, each starting with an empty map; one thread, and two for stereovox. Libraries in C++ are built by
`benchmarks/build_peers.py` (STEREOVOX_PEERS), with the points in their own types before timing starts; wavemap has an
HDL-64's 64 x 2048 beams, from -24.9 to 2 degrees. Predicted: of the held-out points, the share in occupied cells, or
within a cell of one; of places along their rays, at least two cells before the point and a metre from the sensor, the
shares that are free, unknown and (wrongly) occupied. kiss-icp's map keeps points without free space; if it is
installed, only its time is listed, as for C++ libraries whose adapters cannot be queried.
"""

import argparse
import json
import time
from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config, parse_value
from stereovox.errors import StereovoxError
from stereovox.frame import Cloud
from stereovox.mapper import Mapper
from stereovox.maps import State
from stereovox.opening import open_source
from stereovox_lab.bench.native import WavemapCpp
from stereovox_lab.bench.peers import UNKNOWN, find_peer

ALONG = 8
"""Places on each held-out ray."""
SEED = 0
HDL_64 = float(np.radians(-24.9)), float(np.radians(2.0)), 64, 2048
"""Lowest and highest beam, beams above each other, and directions of a turn at 10 Hz."""
Insert = Callable[[Cloud], Callable[[], object]]
"""Returns the timed call that inserts a cloud."""
Ask = Callable[[NDArray[np.float64]], NDArray[np.uint8]]


def ours(size: float, max_range: float, threads: int, settings: dict[str, Any]) -> tuple[Insert, Ask]:
    mapper = Mapper(load_config(voxel_size=size, max_range=max_range, threads=threads, **settings))

    def insert(cloud: Cloud) -> None:
        report = mapper.add(cloud)
        if report.refused:
            raise StereovoxError(report.detail)

    return lambda cloud: partial(insert, cloud), lambda points: np.asarray(mapper.map.state(points), np.uint8)


def peer(name: str, size: float, max_range: float) -> tuple[Insert, Ask | None]:
    kind: Any = find_peer(name)
    library = kind(size)
    library.reach(max_range)
    if isinstance(library, WavemapCpp):
        return partial(of_wavemap, library), lambda points: states_of(library.log_odds(points))
    states: dict[tuple[int, ...], int] = {}

    def insert(cloud: Cloud) -> Callable[[], object]:
        given = in_world(cloud)
        return library.prepared(*given) if hasattr(library, "prepared") else partial(library.insert, *given)

    def ask(points: NDArray[np.float64]) -> NDArray[np.uint8]:
        if not states:
            cells, log_odds = library.cells()
            limit = np.log(library.occupied_above / (1 - library.occupied_above))
            known = np.where(log_odds > limit, int(State.OCCUPIED), int(State.FREE))
            states.update(zip(map(tuple, cells.tolist()), known.tolist(), strict=True))
        cells = np.floor(points / size).astype(np.int64).tolist()
        return np.array([states.get(tuple(cell), int(State.UNKNOWN)) for cell in cells], np.uint8)

    return insert, ask if hasattr(library, "cells") else None


def of_wavemap(library: WavemapCpp, cloud: Cloud) -> Callable[[], object]:
    far = np.linalg.norm(cloud.points, axis=1) >= cloud.lidar.range_min
    return library.prepared_cloud(cloud.points[far].astype(float), cloud.T_world_sensor, HDL_64)


def states_of(log_odds: NDArray[np.float32]) -> NDArray[np.uint8]:
    known = np.where(log_odds > 0, int(State.OCCUPIED), int(State.FREE))
    return np.where(np.abs(log_odds) > UNKNOWN, known, int(State.UNKNOWN)).astype(np.uint8)


def kiss(size: float, max_range: float) -> Insert:
    from kiss_icp.mapping import VoxelHashMap

    library = VoxelHashMap(size, max_range, 20)

    return lambda cloud: partial(library.update, cloud.points.astype(np.float64), cloud.T_world_sensor)


def in_world(cloud: Cloud) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    T = cloud.T_world_sensor
    points = np.asarray(cloud.points, float)
    far = np.linalg.norm(points, axis=1) >= cloud.lidar.range_min
    return points[far] @ T[:3, :3].T + T[:3, 3], T[:3, 3]


def foretold(clouds: list[Cloud], ask: Ask, size: float, max_range: float) -> dict[str, float]:
    """Return how well a map predicts clouds that are not in it."""
    random, found = np.random.default_rng(SEED), {"hit": [], "near": [], "free": [], "unknown": [], "occupied": []}
    around = np.array(list(product((-1, 0, 1), repeat=3))) * size
    for cloud in clouds:
        points, origin = in_world(cloud)
        length = np.linalg.norm(points - origin, axis=1)
        some = random.permutation(np.flatnonzero(length < max_range - 2 * size))[:2000]
        points, length = points[some], length[some]
        hit = ask(points) == State.OCCUPIED
        near = (ask((points[:, None] + around).reshape(-1, 3)).reshape(-1, 27) == State.OCCUPIED).any(axis=1)
        before = length - 2 * size
        share = random.uniform(1, np.maximum(before, 1)[:, None], (len(points), ALONG)) / length[:, None]
        places = origin + share[:, :, None] * (points - origin)[:, None]
        states = ask(places[before > 1].reshape(-1, 3))
        for name, values in {
            "hit": hit, "near": near, "free": states == State.FREE,
            "unknown": (states == State.UNKNOWN) | (states == State.TENTATIVE), "occupied": states == State.OCCUPIED,
        }.items():  # fmt: skip
            found[name].append(float(values.mean()))
    return {name: round(float(np.mean(values)), 4) for name, values in found.items()}


def timed(make: Callable[[], Insert], clouds: list[Cloud], rounds: int) -> float:
    """Return the median over clouds of the least milliseconds over rounds."""
    took = np.empty((rounds, len(clouds)))
    for row in took:
        insert = make()
        for k, cloud in enumerate(clouds):
            call = insert(cloud)
            started = time.perf_counter()
            call()
            row[k] = time.perf_counter() - started
    return 1e3 * float(np.median(took.min(axis=0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("settings", nargs="*")
    parser.add_argument("--voxel-size", type=float, default=0.2)
    parser.add_argument("--max-range", type=float, default=60.0)
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--frames")
    parser.add_argument("--peers", nargs="*", default=["octomap"])
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    settings = {name: parse_value(text) for name, _, text in (one.partition("=") for one in arguments.settings)}
    frames = [frame for frame in open_source(arguments.recording, arguments.frames) if not frame.fault]
    clouds = [frame for frame in frames if isinstance(frame, Cloud)]
    held = clouds[arguments.every // 2 :: arguments.every]
    used = [cloud for cloud in clouds if cloud not in held]
    size, far = arguments.voxel_size, arguments.max_range
    makers: dict[str, Callable[[], tuple[Insert, Ask | None]]] = {
        "stereovox": lambda: ours(size, far, 1, settings),
        "stereovox, 2 threads": lambda: ours(size, far, 2, settings),
        **{name: lambda name=name: peer(name, size, far) for name in arguments.peers},
    }
    print(f"{len(used)} clouds of {np.mean([len(cloud.points) for cloud in used]):,.0f} points, {len(held)} held out")
    for name, make in makers.items():
        rounds = arguments.rounds if name.startswith("stereovox") else 1
        ours(size, far, 1, settings)[0](used[0])()  # compiled now
        row: dict[str, Any] = {"name": name, "ms": round(timed(lambda make=make: make()[0], used, rounds), 1)}
        insert, ask = make()
        for cloud in used:
            insert(cloud)()
        print(json.dumps(row | (foretold(held, ask, size, far) if ask else {})), flush=True)
    try:
        print(json.dumps({"name": "kiss-icp's map of points", "ms": round(timed(lambda: kiss(size, far), used, 1), 1)}))
    except ImportError:
        print("kiss-icp is not installed: pip install kiss-icp")


if __name__ == "__main__":
    main()
