# SPDX-License-Identifier: Apache-2.0
"""OctoMap's file formats `.bt` (free or occupied) and `.ot` (log-odds), read and written.

Both are a short text header and then the nodes of a 16-level pruned octree, each before its children (format: OctoMap
1.10, classes AbstractOcTree, OccupancyOcTreeBase and OcTreeDataNode). OctoMap's cell i covers the same space as ours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.errors import MapFileError
from stereovox.files.safe_io import read_bounded, replacing
from stereovox.formats import _octree
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import Evidence, to_units
from stereovox.maps.record.history import Imported

DEPTH = 16
"""Levels below the root; a cell of the finest level has a 16-bit key on each axis."""
KEY_ZERO = 1 << (DEPTH - 1)
"""The key of cell index 0: keys are indices plus this."""
FREE, OCCUPIED, BRANCH = 1, 2, 3
"""Two bits per child of a node; 0 for no child."""
BINARY_TITLE = "# Octomap OcTree binary file"
TREE_TITLE = "# Octomap OcTree file"
TREE_NODE = np.dtype([("log_odds", "<f4"), ("children", "u1")])
"""One node of an `.ot` file; bit i of `children` says that child i exists."""
COLOUR_NODE = np.dtype([("log_odds", "<f4"), ("colour", "u1", 3), ("children", "u1")])
"""One node of a ColorOcTree; its colour is ignored."""
TREES = {"OcTree": TREE_NODE, "1": TREE_NODE, "OcTreeStamped": TREE_NODE, "ColorOcTree": COLOUR_NODE}
"""Nodes of an `.ot` file by its tree type ("1" in files of OctoMap's first years); a `.bt` has the same for all."""
MAX_BLOCKS = 2**18
"""Most blocks of 8x8x8 cells a file may expand to (134 million cells); one node can claim 35 million million cells."""
BLOCKS_OF_ANY, BLOCKS_A_LEAF = 2**16, 256
"""Blocks that any file may expand to, and more per leaf: a file of 40 bytes must not take a second."""
MAX_LOG_ODDS = 30.0
OCTOMAP: dict[str, Any] = {"map.prior": 0.5, "map.log_odds_min": -2.0, "map.log_odds_max": 3.5}
"""OctoMap's defaults, which its files do not record."""
MAX_HEADER_LENGTH = 1 << 16
MAX_NODES = 2 * 512 * MAX_BLOCKS
MAX_BYTES = 8 * MAX_NODES
"""A tree of that many cells has fewer nodes and bytes."""


def read_octomap(path: str | Path) -> VoxelMap:
    """Return the map in an OctoMap file of one of the tree types `TREES`; pruned nodes expand to their cells.

    `.bt` cells get OctoMap's own clamping limits (log-odds -2 and 3.5). `.ot` cells keep their log-odds to the nearest
    thousandth, at most 30 either way; a log-odds of zero becomes 0.001, "just known". The map's settings are the
    default profile's with the file's voxel size, OctoMap's prior of 0.5, and limits that include the file's values.
    Raises MapFileError: one line with the file and the problem.
    """
    content = _read(Path(path))
    try:
        title, header, body = _split(content)
        made = map_of_nodes(title, body, _voxel_size(header), _size(header), _tree(header.get("id", "")))
    except ValueError as error:
        raise MapFileError(f"{path}: not a whole OctoMap file: {error}; export it again") from None
    made.history.imported = Imported(Path(path).name, f"OctoMap, {_size(header):,} nodes")
    return made


def write_bt(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the map as OctoMap's binary tree; see `binary_tree`.

    Raises MapFileError for cells outside [-32768, 32768), no cell at all, or an unwritable path.
    """
    _write(path, BINARY_TITLE, voxel_map, binary_tree(voxel_map))


def write_ot(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the map as OctoMap's full tree; see `full_tree`.

    Raises MapFileError for cells outside [-32768, 32768), no cell at all, or an unwritable path.
    """
    _write(path, TREE_TITLE, voxel_map, full_tree(voxel_map))


def map_of_nodes(title: str, body: bytes, voxel_size: float, size: int | None = None, tree: str = "OcTree") -> VoxelMap:
    """Return the map in the nodes `body` of a tree with the title BINARY_TITLE or TREE_TITLE.

    voxel_size: metres. size: expected number of nodes, if known. tree: its type, one of `TREES`.
    Raises ValueError for damaged nodes, ConfigError for an impossible cell size.
    """
    config = load_config(voxel_size=voxel_size, **OCTOMAP)
    kind = TREES[_tree(tree)]
    leaves = _binary_leaves(body, size, config) if title == BINARY_TITLE else _tree_leaves(body, size, kind)
    return _map_of(leaves, _with_limits(config, leaves.log_odds))


@one_state
def binary_tree(voxel_map: VoxelMap) -> Tree:
    """Return the map as OctoMap's binary tree: each cell free, occupied or unknown; eight equal cells become one.

    Occupied and free cells stay so. The format cannot express tentative cells: if evidence has not made them less
    likely they become occupied, otherwise unknown. So a user of the file meets no free cell that is not free in the
    map, and misses no obstacle that the map suspects; but a tentative cell may count as occupied there. Raises
    MapFileError for cells outside [-32768, 32768).
    """
    indices, evidence = _evidence(voxel_map)
    state = voxel_map.state(voxel_map.centers(indices))
    occupied = (state == State.OCCUPIED) | ((state == State.TENTATIVE) & (evidence >= 0))
    known = occupied | (state == State.FREE)
    nodes = build_octree(indices[known], np.where(occupied, 1, -1)[known].astype(np.float32))
    return Tree(len(nodes), nodes.children[nodes.children > 0].astype("<u2").tobytes())


def full_tree(voxel_map: VoxelMap) -> Tree:
    """Return the map as OctoMap's full tree: every known cell with its log-odds, branches with their highest.

    Log-odds are counted from the map's prior, since OctoMap's is one half: it takes all from 0 on as occupied. Raises
    MapFileError for cells outside [-32768, 32768).
    """
    nodes = build_octree(*_evidence(voxel_map))
    records = np.zeros(len(nodes), TREE_NODE)
    records["log_odds"] = nodes.values
    for child in range(8):
        records["children"] |= ((nodes.children >> 2 * child & 3 > 0) << child).astype(np.uint8)
    return Tree(len(nodes), records.tobytes())


def _evidence(voxel_map: VoxelMap) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return the known cells (N, 3) and their log-odds (N,) from even odds on: without the prior."""
    indices, log_odds = voxel_map.cells()
    return indices, log_odds - CellRules(voxel_map.config.map).prior_log_odds


class Tree(NamedTuple):
    """The nodes of a tree as in OctoMap's files and `octomap_msgs/Octomap`, and their number."""

    size: int
    data: bytes


@dataclass(frozen=True, eq=False)
class Nodes:
    """Nodes of one or more levels, in ascending order.

    codes: (n,) uint64 Morton code of the node within its level (x lowest, then y, then z).
    values: (n,) float32, for a branch the largest value below it.
    children: (n,) uint16, two bits a child (child 0 lowest): 0 none, `FREE` (value < 0), `OCCUPIED` or `BRANCH`;
    0 marks a leaf.
    """

    codes: NDArray[np.uint64]
    values: NDArray[np.float32]
    children: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.codes)

    def __getitem__(self, which: NDArray) -> Nodes:
        return Nodes(self.codes[which], self.values[which], self.children[which])


def build_octree(indices: NDArray[np.integer], values: NDArray[np.float32]) -> Nodes:
    """Return all nodes, root first, each before its children, of the tree of cells (N, 3) with values (N,).

    Eight leaves of equal value become one. The cells are distinct; `codes` of the result are the sorting keys.
    Raises MapFileError for a cell index outside [-32768, 32768).
    """
    codes = morton_codes(indices)
    order = np.argsort(codes)
    level = Nodes(codes[order], np.asarray(values, np.float32)[order], np.zeros(len(order), np.uint16))
    kept = []
    for height in range(DEPTH):
        parents, lasting = _one_level_up(level)
        kept.append(_with_sort_keys(level[lasting], height))
        level = parents
    kept.append(_with_sort_keys(level, DEPTH))
    nodes = Nodes(*(np.concatenate([getattr(part, name) for part in kept]) for name in Nodes.__annotations__))
    return nodes[np.argsort(nodes.codes)]


def morton_codes(indices: NDArray[np.integer]) -> NDArray[np.uint64]:
    """Return the 48-bit Morton codes (N,) of cells (N, 3): bits of x, y and z in turn, x lowest."""
    keys = np.asarray(indices, np.int64) + KEY_ZERO
    outside = ((keys < 0) | (keys >= 2 * KEY_ZERO)).any(axis=1)
    if outside.any():
        cell = tuple(int(k) - KEY_ZERO for k in keys[outside][0])
        raise MapFileError(
            f"cell {cell} does not fit: OctoMap files hold cells {-KEY_ZERO} to {KEY_ZERO - 1} on each axis; "
            "use larger cells or a map nearer the origin"
        )
    x, y, z = (_spread_table()[keys[:, axis]] for axis in range(3))
    return x | (y << np.uint64(1)) | (z << np.uint64(2))


@lru_cache
def _spread_table() -> NDArray[np.uint64]:
    """Return every 16-bit number with two empty bits before each bit."""
    numbers = np.arange(2 * KEY_ZERO, dtype=np.uint64)
    spread = np.zeros_like(numbers)
    for bit in range(DEPTH):
        spread |= (numbers >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit)
    return spread


def _one_level_up(level: Nodes) -> tuple[Nodes, NDArray[np.bool_]]:
    """Return the parents of a level's nodes, and which nodes remain: eight equal leaves merge into their parent."""
    if not len(level):
        return level, np.zeros(0, bool)
    codes = level.codes >> np.uint64(3)
    first = np.flatnonzero(np.append(True, codes[1:] != codes[:-1]))
    number = np.diff(np.append(first, len(codes)))
    largest = np.maximum.reduceat(level.values, first)
    uniform = (number == 8) & (largest == np.minimum.reduceat(level.values, first))
    uniform &= np.bitwise_or.reduceat(level.children, first) == 0
    children = np.where(uniform, 0, np.bitwise_or.reduceat(_as_children(level), first)).astype(np.uint16)
    return Nodes(codes[first], largest, children), np.repeat(~uniform, number)


def _as_children(level: Nodes) -> NDArray[np.uint16]:
    kinds = np.where(level.children > 0, BRANCH, np.where(level.values < 0, FREE, OCCUPIED)).astype(np.uint16)
    return kinds << (2 * (level.codes & np.uint64(7))).astype(np.uint16)


def _with_sort_keys(level: Nodes, height: int) -> Nodes:
    """Replace codes by keys that order nodes of all levels: by their lowest cell, then parents before children."""
    keys = level.codes << np.uint64(3 * height + 5) | np.uint64(DEPTH - height)
    return Nodes(keys, level.values, level.children)


def _write(path: str | Path, title: str, voxel_map: VoxelMap, tree: Tree) -> None:
    if not tree.size:
        raise MapFileError(f"{path}: the map holds no cell that this format can store, there is nothing to write")
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


@dataclass(frozen=True, eq=False)
class _Leaves:
    corners: NDArray[np.int32]
    heights: NDArray[np.uint8]
    log_odds: NDArray[np.float32]


def _read(path: Path) -> bytes:
    try:
        return read_bounded(path, MAX_BYTES)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name an OctoMap file") from None


def _split(content: bytes) -> tuple[str, dict[str, str], bytes]:
    """Return the title, the fields of the header by name, and the bytes of the tree."""
    title, _, rest = content[:MAX_HEADER_LENGTH].partition(b"\n")
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


def _tree(name: str) -> str:
    if name not in TREES:
        raise ValueError(f"its tree type is '{name}', only {', '.join(TREES)} can be read")
    return name


def _size(header: dict[str, str]) -> int:
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


def _tree_leaves(body: bytes, size: int | None, kind: np.dtype) -> _Leaves:
    if len(body) % kind.itemsize:
        raise ValueError("it ends inside a node")
    nodes = np.frombuffer(body, kind)
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
    if found > MAX_NODES:
        raise ValueError(f"its {found} nodes are more than {MAX_NODES}")
    if size not in (None, found):
        raise ValueError(f"its header declares {size} nodes, its {length} bytes of data hold {found}")
    return found


def _room_for(size: int) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    return np.zeros((size, 3), np.int32), np.zeros(size, np.uint8)


def _with_limits(config: Config, log_odds: NDArray[np.float32]) -> Config:
    """Widen the clamping limits if the file's values exceed them."""
    if not len(log_odds):
        return config
    lowest = max(min(config.map.log_odds_min, float(log_odds.min())), -MAX_LOG_ODDS)
    highest = min(max(config.map.log_odds_max, float(log_odds.max())), MAX_LOG_ODDS)
    return load_config(config, **{"map.log_odds_min": lowest, "map.log_odds_max": highest})


def _map_of(leaves: _Leaves, config: Config) -> VoxelMap:
    room, most = _blocks_of(leaves), min(MAX_BLOCKS, max(BLOCKS_OF_ANY, BLOCKS_A_LEAF * len(leaves.heights)))
    if room > most:
        raise ValueError(f"its nodes expand to up to {room * 512:.3g} cells, more than {most * 512:.3g}")
    coords, values = np.zeros((room, 3), np.int32), np.zeros((room, 512), np.int16)
    limits = config.map
    units = to_units(np.clip(leaves.log_odds, limits.log_odds_min, limits.log_odds_max)).astype(np.int16)
    units[units == 0] = 1
    _octree.fill_blocks(leaves.corners, leaves.heights, units, coords, values)
    voxel_map = VoxelMap(config)
    voxel_map.add(Evidence(coords, values, np.zeros((0, 3), np.int32), np.zeros(0, np.int16)))
    return voxel_map


def _blocks_of(leaves: _Leaves) -> int:
    """Count blocks: a leaf at least as high as a block fills its own; lower ones share with their neighbours."""
    height = _octree.BLOCK_HEIGHT
    large = leaves.heights >= height
    places = (leaves.corners[~large] >> height).astype(np.int64)
    changes = int((np.diff(places, axis=0) != 0).any(axis=1).sum()) + bool(len(places))
    return changes + int((8 ** (leaves.heights[large].astype(np.int64) - height)).sum())
