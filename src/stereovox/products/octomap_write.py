# SPDX-License-Identifier: Apache-2.0
"""OctoMap's two file formats: `.bt` (free or occupied) and `.ot` (log-odds).

Both are a short text header and then the nodes of a 16-level octree, each before its children (format: OctoMap 1.10,
classes AbstractOcTree, OccupancyOcTreeBase and OcTreeDataNode). OctoMap's cell i covers the same space as ours.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stereovox.errors import MapFileError
from stereovox.files import replacing
from stereovox.guarded import one_state
from stereovox.maps import State, VoxelMap
from stereovox.products.octree import build_octree

BINARY_TITLE = "# Octomap OcTree binary file"
TREE_TITLE = "# Octomap OcTree file"
TREE_NODE = np.dtype([("log_odds", "<f4"), ("children", "u1")])
"""One node of an `.ot` file; bit i of `children` says that child i exists."""


class Tree(NamedTuple):
    """The nodes of a tree as OctoMap's files and `octomap_msgs/Octomap` hold them, and how many they are."""

    size: int
    data: bytes


def write_bt(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the map as OctoMap's binary tree; see `binary_tree`.

    Raises MapFileError for cells outside [-32768, 32768), no cell at all, or a place that cannot be written.
    """
    _write(path, BINARY_TITLE, voxel_map, binary_tree(voxel_map))


def write_ot(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the map as OctoMap's full tree; see `full_tree`.

    Raises MapFileError for cells outside [-32768, 32768), no cell at all, or a place that cannot be written.
    """
    _write(path, TREE_TITLE, voxel_map, full_tree(voxel_map))


@one_state
def binary_tree(voxel_map: VoxelMap) -> Tree:
    """Return the map as OctoMap's binary tree: each cell free, occupied or unknown; eight equal cells become one.

    Occupied and free cells stay so. The tree has no word for a tentative cell: with p >= 0.5 (OctoMap's own threshold)
    it becomes occupied, below that unknown. So who flies by the file meets no free cell that the map does not call
    free, and no obstacle that the map has reason to suspect is missing; a cell that counts as tentative here may
    count as occupied there.
    Raises MapFileError for cells outside [-32768, 32768).
    """
    indices, log_odds = voxel_map.cells()
    state = voxel_map.state(voxel_map.centers(indices))
    occupied = (state == State.OCCUPIED) | ((state == State.TENTATIVE) & (log_odds >= 0))
    known = occupied | (state == State.FREE)
    nodes = build_octree(indices[known], np.where(occupied, 1, -1)[known].astype(np.float32))
    return Tree(len(nodes), nodes.children[nodes.children > 0].astype("<u2").tobytes())


def full_tree(voxel_map: VoxelMap) -> Tree:
    """Return the map as OctoMap's full tree: every known cell with its log-odds, branches with their highest.

    Raises MapFileError for cells outside [-32768, 32768).
    """
    nodes = build_octree(*voxel_map.cells())
    records = np.zeros(len(nodes), TREE_NODE)
    records["log_odds"] = nodes.values
    for child in range(8):
        records["children"] |= ((nodes.children >> 2 * child & 3 > 0) << child).astype(np.uint8)
    return Tree(len(nodes), records.tobytes())


def _write(path: str | Path, title: str, voxel_map: VoxelMap, tree: Tree) -> None:
    if not tree.size:
        raise MapFileError(f"{path}: the map holds no cell that such a file knows, there is nothing to write")
    lines = [
        title,
        "# (feel free to add / change comments, but leave the first line as it is!)",
        "#",
        "id OcTree",
        f"size {tree.size}",
        f"res {float(voxel_map.voxel_size)!r}",
        "data",
    ]
    with replacing(path) as file:
        file.write("\n".join([*lines, ""]).encode("ascii"))
        file.write(tree.data)
