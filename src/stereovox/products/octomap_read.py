# SPDX-License-Identifier: Apache-2.0
"""Read OctoMap's `.bt` and `.ot` files into a voxel map."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.errors import ConfigError, MapFileError
from stereovox.maps import VoxelMap
from stereovox.maps.evidence import Evidence, to_units
from stereovox.products import _octree
from stereovox.products.octomap_write import BINARY_TITLE, TREE_NODE, TREE_TITLE
from stereovox.products.octree import BRANCH
from stereovox.untrusted import read_bounded

MOST_BLOCKS = 2**18
"""Blocks of 8x8x8 cells a file may unfold to (134 million cells); one node can claim 35 million million cells."""
BLOCKS_OF_ANY, BLOCKS_A_LEAF = 2**16, 256
"""Few leaves may unfold to fewer: a file of 40 bytes is not to take a second."""
LARGEST_LOG_ODDS = 30.0
OCTOMAP: dict[str, Any] = {"map.prior": 0.5, "map.log_odds_min": -2.0, "map.log_odds_max": 3.5}
"""What OctoMap does when nothing else is said; the files do not tell."""
LONGEST_HEADER = 1 << 16
MOST_NODES = 2 * 512 * MOST_BLOCKS
MOST_BYTES = 8 * MOST_NODES
"""A tree of so many cells has fewer nodes and bytes."""


@dataclass(frozen=True, eq=False)
class _Leaves:
    corners: NDArray[np.int32]
    heights: NDArray[np.uint8]
    log_odds: NDArray[np.float32]


def read_octomap(path: str | Path) -> VoxelMap:
    """Return the map in an OctoMap file of the tree type OcTree; pruned nodes become the cells they stand for.

    `.bt` cells get OctoMap's own clamping limits (log-odds -2 and 3.5). `.ot` cells keep their log-odds to the nearest
    thousandth, at most 30 either way; a log-odds of zero becomes 0.001, "just known". The map's settings are the
    default profile's with the file's voxel size, OctoMap's prior of 0.5, and limits that hold the file's values.
    Raises MapFileError: one line with the file and what is wrong.
    """
    content = _read(Path(path))
    try:
        title, header, body = _split(content)
        return map_of_nodes(title, body, _voxel_size(header), _size(header))
    except (ValueError, ConfigError) as error:
        raise MapFileError(f"{path}: not a whole OctoMap file: {error}; export it again") from None


def map_of_nodes(title: str, body: bytes, voxel_size: float, size: int | None = None) -> VoxelMap:
    """Return the map in the nodes `body` of a tree, those of BINARY_TITLE or of TREE_TITLE.

    voxel_size: metres. size: how many nodes there should be, if that is known.
    Raises ValueError for damaged nodes, ConfigError for a size that no cell can have.
    """
    config = load_config(voxel_size=voxel_size, **OCTOMAP)
    leaves = _binary_leaves(body, size, config) if title == BINARY_TITLE else _tree_leaves(body, size)
    return _map_of(leaves, _with_limits(config, leaves.log_odds))


def _read(path: Path) -> bytes:
    try:
        return read_bounded(path, MOST_BYTES)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name an OctoMap file") from None


def _split(content: bytes) -> tuple[str, dict[str, str], bytes]:
    """Return the title, the words of the header by their name, and the bytes of the tree."""
    title, _, rest = content[:LONGEST_HEADER].partition(b"\n")
    known = next((t for t in (BINARY_TITLE, TREE_TITLE) if title.startswith(t.encode())), None)
    if known is None:
        raise ValueError(f"its first line is not '{BINARY_TITLE}' or '{TREE_TITLE}'")
    header: dict[str, str] = {}
    start = len(title) + 1
    while rest:
        line, newline, rest = rest.partition(b"\n")
        start += len(line) + len(newline)
        name, _, value = line.decode("ascii", "replace").strip().partition(" ")
        if name == "data" and newline:
            return known, header, content[start:]
        header[name] = value.strip()
    raise ValueError("its header has no line 'data'")


def _size(header: dict[str, str]) -> int:
    tree = header.get("id", "")
    if tree not in ("OcTree", "1"):  # "1" in files of OctoMap's first years
        raise ValueError(f"its tree type is '{tree}', only OcTree can be read")
    text = header.get("size", "")
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise ValueError(f"its size '{text}' is not a number of nodes")
    return int(text)


def _voxel_size(header: dict[str, str]) -> float:
    text = header.get("res", "")
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"its res '{text}' is not a number of metres") from None


def _binary_leaves(body: bytes, size: int | None, config: Config) -> _Leaves:
    if len(body) % 2:
        raise ValueError("it ends inside a node")
    records = np.frombuffer(body, "<u2")
    size = _checked_size(size, _nodes_in(body), len(body))
    corners, heights = _room_for(size)
    occupied = np.zeros(size, bool)
    n = _octree.read_binary_leaves(records, corners, heights, occupied)
    limits = config.map
    log_odds = np.where(occupied[:n], limits.log_odds_max, limits.log_odds_min).astype(np.float32)
    return _Leaves(corners[:n], heights[:n], log_odds)


def _nodes_in(body: bytes) -> int:
    """Count the nodes of a `.bt` tree without walking it: the root, and one for each pair of bits that is not 0."""
    numbers = np.bincount(np.frombuffer(body, np.uint8), minlength=256)
    pairs = [sum(byte >> shift & BRANCH != 0 for shift in (0, 2, 4, 6)) for byte in range(256)]
    return int(numbers @ pairs) + 1 if body else 0


def _tree_leaves(body: bytes, size: int | None) -> _Leaves:
    if len(body) % TREE_NODE.itemsize:
        raise ValueError("it ends inside a node")
    nodes = np.frombuffer(body, TREE_NODE)
    size = _checked_size(size, len(nodes), len(body))
    corners, heights = _room_for(size)
    records = np.zeros(size, np.int64)
    n = _octree.read_tree_leaves(nodes["children"].copy(), corners, heights, records)
    log_odds = nodes["log_odds"][records[:n]]
    if not np.isfinite(log_odds).all():
        raise ValueError("a cell's log-odds is not a number")
    return _Leaves(corners[:n], heights[:n], log_odds)


def _checked_size(size: int | None, found: int, length: int) -> int:
    if not found:
        raise ValueError("it holds no cell: the map was empty when it was saved, or the rest is lost")
    if found > MOST_NODES:
        raise ValueError(f"its {found} nodes are more than {MOST_NODES}")
    if size not in (None, found):
        raise ValueError(f"its header says {size} nodes, its {length} bytes of data hold {found}")
    return found


def _room_for(size: int) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    return np.zeros((size, 3), np.int32), np.zeros(size, np.uint8)


def _with_limits(config: Config, log_odds: NDArray[np.float32]) -> Config:
    """Widen the clamping limits where the file's values lie beyond them."""
    if not len(log_odds):
        return config
    lowest = max(min(config.map.log_odds_min, float(log_odds.min())), -LARGEST_LOG_ODDS)
    highest = min(max(config.map.log_odds_max, float(log_odds.max())), LARGEST_LOG_ODDS)
    return load_config(config, **{"map.log_odds_min": lowest, "map.log_odds_max": highest})


def _map_of(leaves: _Leaves, config: Config) -> VoxelMap:
    room, most = _blocks_of(leaves), min(MOST_BLOCKS, max(BLOCKS_OF_ANY, BLOCKS_A_LEAF * len(leaves.heights)))
    if room > most:
        raise ValueError(f"its nodes stand for up to {room * 512:.3g} cells, more than {most * 512:.3g}")
    coords, values = np.zeros((room, 3), np.int32), np.zeros((room, 512), np.int16)
    limits = config.map
    units = to_units(np.clip(leaves.log_odds, limits.log_odds_min, limits.log_odds_max)).astype(np.int16)
    units[units == 0] = 1
    _octree.fill_blocks(leaves.corners, leaves.heights, units, coords, values)
    voxel_map = VoxelMap(config)
    voxel_map.add(Evidence(coords, values, np.zeros((0, 3), np.int32), np.zeros(0, np.int16)))
    return voxel_map


def _blocks_of(leaves: _Leaves) -> int:
    """Count blocks: a leaf as high as a block or higher fills its own, lower ones share with their neighbours."""
    height = _octree.BLOCK_HEIGHT
    large = leaves.heights >= height
    places = (leaves.corners[~large] >> height).astype(np.int64)
    changes = int((np.diff(places, axis=0) != 0).any(axis=1).sum()) + bool(len(places))
    return changes + int((8 ** (leaves.heights[large].astype(np.int64) - height)).sum())
