# SPDX-License-Identifier: Apache-2.0
"""The 2-D grid: time of one update, of the map as plain numbers, and of its files, on one thread.

    python benchmarks/grid.py [REPEATS]

IST 2019 (Table I) needs 31 ms an update in simulation, and 15 s more to publish a map of 3000 x 3000 cells.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from itertools import product
from pathlib import Path
from time import perf_counter

import numpy as np

from stereovox import Scan
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.geometry import se2
from stereovox.mapper import GridMapper
from stereovox.maps.occupancy import OccupancyGrid

BEAMS = 700
SCENES = {
    "Kinect, 57 degrees, 5 m, cells of 0.02": (57.0, 4.9, 0.02, 5.0),
    "full turn, 5 m, cells of 0.02": (360.0, 4.9, 0.02, 5.0),
    "full turn, 30 m, cells of 0.05": (360.0, 29.0, 0.05, 30.0),
}
"""Field of view, distance of all hits, cell side, max_range."""
CELLS = 3000


def main() -> None:
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    print(
        f"one update of {BEAMS} beams into a map of {CELLS} x {CELLS} cells, ms: median (quickest), {repeats} updates"
    )
    for (name, scene), traversal, update in product(SCENES.items(), ("exact", "bresenham"), ("once", "every")):
        times = update_ms(*scene, traversal, update, repeats)
        print(f"  {name:40} {traversal:10} {update:6} {np.median(times):6.3f} ({times.min():.3f})")
    print(f"a map of {CELLS} x {CELLS} cells, ms: median (quickest)")
    for name, times in map_ms().items():
        print(f"  {name:58} {np.median(times):6.1f} ({times.min():.1f})")


def update_ms(
    fov_deg: float, distance: float, size: float, max_range: float, traversal: str, update: str, repeats: int
):
    """Return the time of each update, all Python included, of a robot that drives and turns."""
    settings = {"grid.traversal": traversal, "grid.update": update, "min_range": 0.05}
    mapper = GridMapper(voxel_size=size, max_range=max_range, resume=full_map(size), **settings)
    rng, fov, times = np.random.default_rng(0), np.radians(fov_deg), []
    for i in range(repeats + 5):
        ranges = (distance + rng.uniform(-0.05, 0.05, BEAMS)).astype(np.float32)
        pose = se2.lifted([0.011 * i, 0.007 * i, 0.05 * i])
        report = mapper.add(Scan(ranges, -fov / 2, fov / BEAMS, 0.05, 2 * max_range, pose))
        assert report.refused is None, report.detail
        times.append(report.depth_ms + report.integrate_ms)
    return np.array(times[5:])


def full_map(size: float) -> OccupancyGrid:
    """A map of known cells with its origin in the middle."""
    cells = np.random.default_rng(1).integers(-1, 101, (CELLS, CELLS)).astype(np.int8)
    return OccupancyGrid(cells, size, (-CELLS / 2 * size, -CELLS / 2 * size, 0.0))


def map_ms() -> dict[str, np.ndarray]:
    grid = full_map(0.02)
    mapper = GridMapper(voxel_size=0.02, resume=grid)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.yaml"
        return {
            "GridMap.occupancy(), what ROS publishes": timed(mapper.occupancy),
            "write_map_server, .pgm": timed(lambda: write_map_server(grid, path)),
            "read_map_server, .pgm": timed(lambda: read_map_server(path)),
            "GridMap.save, .npz": timed(lambda: mapper.map.save(Path(folder) / "map.npz"), 3),
        }


def timed(work: Callable, repeats: int = 15) -> np.ndarray:
    times = []
    for _ in range(repeats + 1):
        start = perf_counter()
        work()
        times.append(1e3 * (perf_counter() - start))
    return np.array(times[1:])


if __name__ == "__main__":
    main()
