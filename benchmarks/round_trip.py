# SPDX-License-Identifier: Apache-2.0
"""Write a map in every format that can be read again, read it, and count the cells: benchmarks/round_trip.py MAP."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from stereovox import State, export, import_map, load_map
from stereovox.maps.storage.cubes import in_cubes

ENDINGS = (".bt", ".ot", ".npz", ".ply", ".pcd", ".bag", ".mcap")


def main() -> None:
    voxel_map = in_cubes(load_map(sys.argv[1]))
    bounds = voxel_map.bounds()
    heights = (float(bounds.min()), float(bounds.max()))
    indices, log_odds = voxel_map.cells()
    centers = voxel_map.centers(indices)
    state = voxel_map.state(centers)
    print(f"{np.count_nonzero(state == State.OCCUPIED)} occupied, {np.count_nonzero(state == State.FREE)} free cells")
    print("| format | MB | occupied lost | free lost | largest change of log-odds |")
    print("|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for ending in ENDINGS:
            path = Path(folder) / f"map{ending}"
            export(voxel_map, path, heights if ending in (".bag", ".mcap") else None)
            again = import_map(path)
            found = again.state(centers)
            lost = [np.count_nonzero((state == kind) & (found != kind)) for kind in (State.OCCUPIED, State.FREE)]
            change = np.abs(again.log_odds(centers) - log_odds).max()
            print(f"| {ending} | {path.stat().st_size / 1e6:.2f} | {lost[0]} | {lost[1]} | {change:.4f} |", flush=True)


if __name__ == "__main__":
    main()
