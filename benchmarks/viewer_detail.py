# SPDX-License-Identifier: Apache-2.0
"""Data that a browser first gets of a building of several million cells: python benchmarks/viewer_detail.py."""

from contextlib import closing
from time import process_time

import numpy as np

from stereovox import VoxelMap, load_config, open_viewer
from stereovox.maps import State

CELL, WIDTH, DEPTH, STOREYS, STOREY, ROOM = 0.05, 800, 560, 3, 60, 100
"""Cells of 5 cm: 40 m by 28 m, three storeys of 3 m, rooms of 5 m by 5 m with walls of 10 cm and floors of 5 cm."""


def building() -> VoxelMap:
    """Return the map."""
    solid = np.zeros((WIDTH + 2, DEPTH + 2, STOREYS * STOREY + 36), bool)
    for x in range(0, WIDTH + 1, ROOM):
        solid[x : x + 2, :, : STOREYS * STOREY] = True
    for y in range(0, DEPTH + 1, ROOM):
        solid[:, y : y + 2, : STOREYS * STOREY] = True
    random = np.random.default_rng(0)
    for low in range(0, STOREYS * STOREY, STOREY):
        solid[:, :, low] = True
        for _ in range(400):
            x, y = random.integers(0, WIDTH - 40), random.integers(0, DEPTH - 40)
            width, depth, height = random.integers(8, 36, 3)
            solid[x : x + width, y : y + depth, low + height - 2 : low + height] = True  # a table
    cells = np.argwhere(solid)
    return VoxelMap.from_cells(load_config(voxel_size=CELL), cells, np.full(len(cells), 2.0))


def main() -> None:
    voxel_map = building()
    start = process_time()
    with closing(open_viewer(voxel_map, "building", port=0)) as viewer:
        seconds = process_time() - start
        nodes = viewer.cells.kinds[State.OCCUPIED].sent
        cubes = sum(len(node.batched_positions) for node in nodes)
        sent = sum(
            part.nbytes for node in nodes for part in (node.batched_positions, node.batched_wxyzs, node.batched_colors)
        )
        print(f"{voxel_map.counts()['occupied']:,} occupied cells, {len(viewer.cells.solid):,} below the ceiling")
        print(f"{cubes:,} cubes in {len(nodes)} chunks, {sent / 1e6:.1f} MB; ready after {seconds:.1f} s of one core")


if __name__ == "__main__":
    main()
