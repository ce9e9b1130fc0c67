# SPDX-License-Identifier: Apache-2.0
"""A map in boxes that is too large to load: time to open it, to query a part, and to show the whole; memory.

    python benchmarks/boxed_map.py [--boxes 60] [--at FOLDER]

The map is synthetic: boxes of 256 x 256 x 256 cells of 0.05 m side by side, all cells known, a tenth of the blocks with
noise and a floor, the others as free as possible. It is on an S3 server (moto) in its own process on this machine, or
with --at in a folder. Queries are made by a fresh process.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import socket
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from time import perf_counter

import numpy as np

import stereovox as sv
from stereovox.files.places import Place
from stereovox.maps.cells.pyramid import write_levels
from stereovox.maps.files.boxed_manifest import BoxedManifest, write_boxed_manifest
from stereovox.maps.storage.blocks import CELLS
from stereovox.maps.storage.boxes import BoxBlocks, BoxLayout, write_blocks

SIDE = 256
NOISY = 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--boxes", type=int, default=60)
    parser.add_argument("--at", type=Path)
    parser.add_argument("--ask", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.ask:
        print(json.dumps(asked(given.ask)))
        return
    with server() if given.at is None else no_server() as where:
        name = f"{where}/city.svox" if given.at is None else str(given.at / "city.svox")
        started = perf_counter()
        cells, stored = make(Place.of(name), given.boxes)
        print(f"{cells:.3g} known cells, {stored / 1e6:.0f} MB, made in {perf_counter() - started:.0f} s", flush=True)
        for _ in range(2):  # the first one may compile
            run = subprocess.run([sys.executable, __file__, "--ask", name], capture_output=True, text=True, check=True)
        for key, value in json.loads(run.stdout.splitlines()[-1]).items():
            print(f"{key:60} {value:.3g}")


class server:  # noqa: N801 - a context
    """A moto server in its own process; the usual variables name it."""

    def __enter__(self) -> str:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self._process = subprocess.Popen(
            [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        url = f"http://127.0.0.1:{port}"
        os.environ |= {
            "AWS_ENDPOINT_URL": url, "AWS_ALLOW_HTTP": "true", "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test", "NO_PROXY": "*",
        }  # fmt: skip
        for _ in range(100):
            try:
                urllib.request.urlopen(urllib.request.Request(f"{url}/bucket", method="PUT"))
                break
            except OSError:
                time.sleep(0.2)
        return "s3://bucket"

    def __exit__(self, *_: object) -> None:
        self._process.kill()


class no_server:  # noqa: N801 - a context
    """Nothing, if the map is in a folder."""

    def __enter__(self) -> str:
        return ""

    def __exit__(self, *_: object) -> None:
        pass


def make(place: Place, boxes: int) -> tuple[int, int]:
    """Write a synthetic map; return its number of known cells and its bytes."""
    layout = BoxLayout(sv.load_config("default", voxel_size=0.05), SIDE)
    rules, random, across = layout.rules, np.random.default_rng(0), int(np.ceil(boxes**0.5))
    side = SIDE // 8
    local = np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    entries = []
    for n in range(boxes):
        index = n % across, n // across, 0
        coords = (local + np.array(index) * side).astype(np.int32)
        cells = np.full((len(coords), CELLS), rules.lowest, rules.format.dtype)
        noisy = random.random(len(coords)) < NOISY
        cells[noisy] = random.integers(-2000, -200, (int(noisy.sum()), CELLS))
        floor = cells[local[:, 2] == 2].reshape(-1, 8, 8, 8)
        floor[..., 3] = random.integers(500, 3000, floor.shape[:-1])
        cells[local[:, 2] == 2] = floor.reshape(-1, CELLS)
        entry = write_blocks(place, layout, index, BoxBlocks(coords, cells))
        assert entry is not None
        entries.append(entry)
    levels = write_levels(place, layout, entries)
    write_boxed_manifest(place, BoxedManifest(layout, entries, levels))
    return sum(entry.known for entry in entries), sum(place.sizes().values())


def asked(name: str) -> dict[str, float]:
    """Return the cost of opening and querying."""
    random, result, before = np.random.default_rng(1), {}, peak_mb()
    started = perf_counter()
    city = sv.load_map(name)
    result["seconds to open it"] = perf_counter() - started
    (x0, y0, _), (x1, y1, _) = city.bounds()
    corner = [(x0 + x1) / 2 - 10, (y0 + y1) / 2 - 10, 0.0]
    points = (corner + random.uniform(0, 1, (100_000, 3)) * [20, 20, 10]).astype(np.float32)
    started = perf_counter()
    city.state(points)
    result["seconds for 100,000 points in a box of 20 m, nothing read before"] = perf_counter() - started
    started = perf_counter()
    city.state(points)
    result["the same again"] = perf_counter() - started
    started = perf_counter()
    whole = city.overview()
    result["seconds to load the level that shows the whole"] = perf_counter() - started
    result["its cell in metres"] = whole.voxel_size
    result["MB of memory at most, in all"] = peak_mb()
    result["of that before anything was opened"] = before
    return result


def peak_mb() -> float:
    """Return the peak memory of this process."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


if __name__ == "__main__":
    main()
