# SPDX-License-Identifier: Apache-2.0
"""Boxes: a map cut into axis-aligned cubes of whole blocks, each one sharded Zarr v3 group.

A box is named after its content and joins a map once a manifest names it, so a kill in between leaves the older map
intact. Zarr's own headers are for other programs: here each box is read only in the exact form written here, with sizes
checked before anything is unpacked, so a stranger's map takes no more memory than its bytes account for.
"""

from __future__ import annotations

import hashlib
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from functools import cached_property
from math import ceil
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.places import Place
from stereovox.files.safe_io import zstd_size
from stereovox.maps.cells.cell_format import CellRules, State
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.storage.blocks import CELLS, SIDE, span_of
from stereovox.maps.storage.storage import Storage

BOXES = "boxes"
"""Folder of all boxes of a map."""
NAME = re.compile(rf"{BOXES}/[0-9]{{1,2}}/-?[0-9]{{1,9}}_-?[0-9]{{1,9}}_-?[0-9]{{1,9}}-[0-9a-f]{{16}}")
"""Name of a box: level, index, and a digest of its content."""
MAX_SIDE = 512
"""Cells along the longest side of a box; a full one takes a quarter of a gigabyte."""
ROWS = 1024
"""Blocks of an inner chunk."""
PACKED_BEST = 100
"""Coordinates that claim to unpack to more than this many times their bytes are rejected."""
MISSING = (1 << 64) - 1
"""Marks an inner chunk missing from a shard."""
ARRAYS = ("coords", "cells", "times")
CURE = "make the map again (a fleet makes missing boxes with --resume)"
"""Cure for an unreadable box."""

Index = tuple[int, int, int]


class BoxBlocks(NamedTuple):
    """The blocks of a box.

    coords: (n, 3) int32 in ascending order; cells: (n, 512) as stored; times: (n, 512) uint32, None if none are
    kept; counted from `times_start_ns`.
    """

    coords: NDArray[np.int32]
    cells: NDArray[np.integer]
    times: NDArray[np.uint32] | None = None
    times_start_ns: int | None = None


class BoxEntry(NamedTuple):
    """A manifest's entry of one box.

    box: index (i, j, k). name: of its Zarr group below the map. blocks, rows: number of blocks, and of those that are
    not bare (all cells as free as possible). free, tentative, occupied: cells. low, high: cells (3,) from the lowest
    known to the first beyond the highest. bytes: of its arrays in the store. checksum: CRC-32 of the bytes of each
    array. times_start_ns: origin of times.
    """

    box: Index
    name: str
    blocks: int
    rows: int
    free: int
    tentative: int
    occupied: int
    low: Index
    high: Index
    bytes: int
    checksum: tuple[int, ...]
    times_start_ns: int | None = None

    def saved(self) -> dict[str, Any]:
        """Return the entry as plain values for JSON, which `loaded` reads."""
        return self._asdict()

    @classmethod
    def loaded(cls, saved: dict[str, Any], layout: BoxLayout) -> BoxEntry:
        """Return a saved entry. Raises KeyError, TypeError or ValueError for invalid values."""
        box, low, high = (_three(saved[name]) for name in ("box", "low", "high"))
        counts = {name: _count(saved[name]) for name in ("blocks", "rows", "free", "tentative", "occupied", "bytes")}
        checksum, start_ns = tuple(map(_count, saved["checksum"])), saved.get("times_start_ns")
        entry = cls(box, str(saved["name"]), low=low, high=high, checksum=checksum, times_start_ns=start_ns, **counts)
        layout.check(entry)
        return entry

    @property
    def known(self) -> int:
        """Number of known cells."""
        return self.free + self.tentative + self.occupied


class BoxLayout:
    """The division of a map into boxes: its settings, and the side of a box.

    config: settings of the map, or of one level of its pyramid. side: of a box in cells, a multiple of 8 up to
    MAX_SIDE. level: how often cells were merged in pairs along each axis; 0 for the map itself. Raises StereovoxError
    for another side.
    """

    def __init__(self, config: Config, side: int, level: int = 0):
        if type(side) is not int or side % SIDE or not SIDE <= side <= MAX_SIDE:
            raise StereovoxError(f"a box of {side} cells: give a multiple of {SIDE} up to {MAX_SIDE}")
        self.config, self.side, self.level = config, side, level

    @cached_property
    def rules(self) -> CellRules:
        """Meaning of stored numbers."""
        return CellRules(self.config.map)

    @property
    def metres(self) -> NDArray[np.float64]:
        """Sides (3,) of a box in metres."""
        return self.side * np.array(self.config.cell)

    @property
    def dtypes(self) -> list[np.dtype[Any]]:
        """Types of the arrays of a box: coordinates, cells, and times if they are kept."""
        kept = [np.dtype(np.int32), self.rules.format.dtype, np.dtype(np.uint32)]
        return kept[: 3 if self.config.map.keep_times else 2]

    def blocks_of(self, index: Sequence[int]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the lowest block (3,) of a box, and the first block beyond its highest."""
        low = np.array(index, np.int64) * (self.side // SIDE)
        return low, low + self.side // SIDE

    def indices_of(self, coords: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the index (n, 3) of the box that contains each block (n, 3)."""
        return np.asarray(coords, np.int64) // (self.side // SIDE)

    def check(self, entry: BoxEntry) -> None:
        """Raise ValueError for an entry that is impossible in this map."""
        low, high = (SIDE * corner for corner in self.blocks_of(entry.box))
        most = (self.side // SIDE) ** 3
        expected = f"{BOXES}/{self.level}/{'_'.join(map(str, entry.box))}-"
        if not NAME.fullmatch(entry.name) or not entry.name.startswith(expected):
            raise ValueError(f"'{entry.name[:100]}' is not the name of box {entry.box}")
        if np.abs([low, high]).max() > INDEX_LIMIT or not 0 < entry.blocks <= most or entry.rows > entry.blocks:
            raise ValueError(f"box {entry.box} with {entry.blocks} blocks")
        if not entry.blocks <= entry.known <= entry.blocks * CELLS or entry.bytes >= 1 << 40:
            raise ValueError(f"box {entry.box} with {entry.known} known cells in {entry.bytes} bytes")
        if not all(a <= b < c <= d for a, b, c, d in zip(low, entry.low, entry.high, high, strict=True)):
            raise ValueError(f"box {entry.box} with cells from {entry.low} to {entry.high}")
        if len(entry.checksum) != len(self.dtypes) or type(entry.times_start_ns) not in (int, type(None)):
            raise ValueError(f"box {entry.box} with {len(entry.checksum)} arrays")


def write_box(place: Place, layout: BoxLayout, index: Sequence[int], storage: Storage) -> BoxEntry | None:
    """Write the blocks of `storage` in one box; return its entry for a manifest, None if no cell is known.

    A box is part of no map until a manifest names it. Equal content has an equal name, so a box that is written again
    after a kill takes no extra room. Raises MapFileError if it cannot be written.
    """
    coords, cells = storage.blocks_within(*layout.blocks_of(index))
    order = np.lexsort(coords.T[::-1])
    coords, cells = coords[order], cells[order]
    if not layout.config.map.keep_times:
        return write_blocks(place, layout, index, BoxBlocks(coords, cells))
    times = np.where(cells == layout.rules.format.unknown, np.uint32(0), storage.times_of(coords))
    return write_blocks(place, layout, index, BoxBlocks(coords, cells, times, storage.times_start_ns))


def write_blocks(place: Place, layout: BoxLayout, index: Sequence[int], blocks: BoxBlocks) -> BoxEntry | None:
    """Write one box of these blocks as `write_box` does; blocks without a known cell are left out."""
    known = blocks.cells != layout.rules.format.unknown
    some = known.any(axis=1)
    if not some.any():
        return None
    coords, cells, times, start_ns = blocks
    arrays = [part[some] for part in (coords, cells, times) if part is not None]
    files = _packed(layout, arrays)
    shards = [files[_shard(name)] for name in ARRAYS[: len(arrays)]]
    digest = hashlib.sha256(b"".join(shards)).hexdigest()[:16]
    i, j, k = (int(n) for n in index)
    name = f"{BOXES}/{layout.level}/{i}_{j}_{k}-{digest}"
    place.write_all({f"{name}/{file}": data for file, data in files.items()})
    states = np.bincount(layout.rules.states(arrays[1]).ravel(), minlength=len(State)).tolist()
    bare = int((arrays[1] == layout.rules.lowest).all(axis=1).sum())
    low, high = (_three(corner) for corner in span_of(coords[some], known[some]) or ())
    return BoxEntry(
        (i, j, k), name, len(arrays[0]), len(arrays[0]) - bare,
        states[State.FREE], states[State.TENTATIVE], states[State.OCCUPIED], low, high,
        sum(map(len, shards)), tuple(map(zlib.crc32, shards)), start_ns if times is not None else None,
    )  # fmt: skip


def read_box(place: Place, layout: BoxLayout, entry: BoxEntry) -> BoxBlocks:
    """Read the blocks of one box. Raises MapFileError, one line that names the box, if it is missing or damaged."""
    files = [f"{entry.name}/{_shard(name)}" for name in ARRAYS[: len(layout.dtypes)]]
    shards = [data for file in files if (data := place.find(file, entry.bytes)) is not None]
    if len(shards) < len(files):
        raise MapFileError(
            f"{place}/{entry.name}: is missing; was the map made again meanwhile? load it again, or {CURE}"
        )
    try:
        if tuple(map(zlib.crc32, shards)) != entry.checksum:
            raise ValueError("the cells do not match their checksum")
        if entry.blocks * 12 > max(1 << 16, PACKED_BEST * len(shards[0])):
            raise ValueError(f"{entry.blocks} blocks in {len(shards[0])} bytes")
        coords, cells, *times = (
            _unpacked(shard, entry.blocks, _width(name), dtype)
            for shard, (name, dtype) in zip(shards, zip(ARRAYS, layout.dtypes, strict=False), strict=True)
        )
        _check_coords(layout, entry, coords)
        if len(coords) - int((cells == layout.rules.lowest).all(axis=1).sum()) != entry.rows:
            raise ValueError(f"not {entry.rows} blocks with numbers, as the manifest says")
    except (ValueError, TypeError, KeyError, RuntimeError, OSError, struct.error) as error:
        raise MapFileError(
            f"{place}/{entry.name}: damaged box ({type(error).__name__}: {error}); remove it and {CURE}"
        ) from None
    return BoxBlocks(coords, cells, times[0] if times else None, entry.times_start_ns)


def is_there(layout: BoxLayout, entry: BoxEntry, sizes: Mapping[str, int]) -> bool:
    """Return whether the arrays of a box are complete among the files of a place; sizes: their bytes."""
    shards = [f"{entry.name}/{_shard(name)}" for name in ARRAYS[: len(layout.dtypes)]]
    return all(name in sizes for name in shards) and sum(sizes[name] for name in shards) == entry.bytes


def _shard(name: str) -> str:
    return f"{name}/c/0/0"


def _packed(layout: BoxLayout, arrays: list[NDArray]) -> dict[str, bytes]:
    """Return the files of a Zarr group with these arrays, each in one shard; headers are last."""
    store: dict[str, Any] = {}
    group = _group(store, {"cell": layout.config.cell, "side": layout.side, "level": layout.level})
    for array, (name, dtype) in zip(arrays, zip(ARRAYS, layout.dtypes, strict=False), strict=True):
        _new_array(layout, group, name, len(array), dtype)[:] = array
    return {file: store[file].to_bytes() for file in sorted(store, key=lambda file: (file.endswith(".json"), file))}


def _unpacked(shard: bytes, blocks: int, width: int, dtype: np.dtype[Any]) -> NDArray:
    """Return the array (blocks, width) in a shard; raises ValueError if its chunks would not unpack to exactly that.

    Zarr can read it too, but takes ten times as long.
    """
    from numcodecs.zstd import decompress

    rows = min(ROWS, blocks)
    chunks = ceil(blocks / rows)
    body = len(shard) - (16 * chunks + 4)  # the index, and its CRC-32C
    if body < 0:
        raise ValueError("a shard without an index")
    array = np.empty((chunks * rows, width), dtype.newbyteorder("<"))
    size = array[:rows].nbytes
    for k, (offset, length) in enumerate(struct.iter_unpack("<QQ", shard[body:-4])):
        if offset == length == MISSING or offset + length > body:
            raise ValueError("a chunk is missing")
        packed = shard[offset : offset + length]
        if zstd_size(packed[:18]) != size:
            raise ValueError(f"a chunk that does not unpack to {size} bytes")
        decompress(packed, array[k * rows : (k + 1) * rows])
    return array[:blocks].astype(dtype, copy=False)


def _group(store: dict[str, Any], attributes: dict[str, Any]) -> Any:
    import zarr
    from zarr.storage import MemoryStore

    return zarr.open_group(MemoryStore(store), mode="w", zarr_format=3, attributes=attributes)


def _new_array(layout: BoxLayout, group: Any, name: str, blocks: int, dtype: np.dtype[Any]) -> Any:
    from zarr.codecs import ZstdCodec

    rows, width = min(ROWS, blocks), _width(name)
    return group.create_array(
        name, shape=(blocks, width), dtype=dtype, chunks=(rows, width), shards=(rows * ceil(blocks / rows), width),
        compressors=ZstdCodec(level=3), fill_value=layout.rules.format.unknown if name == "cells" else 0,
        config={"write_empty_chunks": True},
    )  # fmt: skip


def _width(name: str) -> int:
    return 3 if name == "coords" else CELLS


def _check_coords(layout: BoxLayout, entry: BoxEntry, coords: NDArray[np.int32]) -> None:
    """Raise ValueError for blocks outside the box, out of order or named twice."""
    low, high = layout.blocks_of(entry.box)
    if ((coords < low) | (coords >= high)).any():
        raise ValueError("a block is outside the box")
    n = layout.side // SIDE
    if (np.diff((coords - low) @ [n * n, n, 1]) <= 0).any():
        raise ValueError("blocks out of order")


def _three(numbers: Any) -> Index:
    x, y, z = map(int, numbers)
    if max(map(abs, (x, y, z))) > INDEX_LIMIT:
        raise ValueError("a cell is out of range")
    return x, y, z


def _count(value: Any) -> int:
    if type(value) is not int or not 0 <= value < 1 << 62:
        raise ValueError(f"'{str(value)[:50]}' is not a count")
    return value
