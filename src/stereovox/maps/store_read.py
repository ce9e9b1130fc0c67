# SPDX-License-Identifier: Apache-2.0
"""The arrays of a saved map, read as `store` writes them and in no other way.

Zarr would follow whatever a stranger's folder says: any packing, any shape, arrays of arrays, links to elsewhere. Here
all of it is checked before Zarr sees the folder, and nothing is allocated for what is not there.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps.blocks import CELLS, SIDE
from stereovox.maps.queries import INDEX_LIMIT
from stereovox.untrusted import json_value, read_bounded

ARRAYS = ("coords", "cells", "times")
"""Names of the arrays of a map, the last only where times are kept."""
LARGEST_CHUNK = 1 << 26
"""Bytes of an unpacked chunk; `store` writes 4 MiB."""
SMALL, PACKED_BEST = 1 << 24, 100
"""Coordinates may unpack to so many bytes, or to so many for each of theirs on disk."""
BYTES, LITTLE = {"name": "bytes"}, {"name": "bytes", "configuration": {"endian": "little"}}
ZSTD = b"\x28\xb5\x2f\xfd"


def read_blocks(folder: Path, blocks: int, *dtypes: np.dtype[Any]) -> tuple[NDArray[Any], ...]:
    """Return coordinates (n, 3) int32 and what is kept of each cell (n, 512) of all blocks; no block is named twice.

    dtypes: those of the cells, and of their times where there are any. They are read last: their room is that of
    coordinates which are really there.
    Raises ValueError, one line, where the folder is not just what `store` writes, and OSError.
    """
    sizes = dict(_files(folder))
    if not 0 <= blocks * 3 * 4 <= max(SMALL, PACKED_BEST * sum(sizes.values())):
        raise ValueError(f"{blocks} blocks where there are {sum(sizes.values())} bytes")
    coords = _read_array(folder, "coords", (blocks, 3), np.dtype(np.int32), sizes)
    _check_coords(coords)
    kept = zip(ARRAYS[1:], dtypes, strict=False)
    return coords, *(_read_array(folder, name, (blocks, CELLS), dtype, sizes) for name, dtype in kept)


def _files(folder: Path) -> Iterator[tuple[str, int]]:
    """Yield path below `folder` and bytes of all files; raises ValueError for links and what is no file."""
    if folder.is_symlink():
        raise ValueError(f"{folder.name} is a link")
    for above, folders, names in os.walk(folder):
        for name in (*folders, *names):
            status = os.lstat(os.path.join(above, name))
            if name in names and stat.S_ISREG(status.st_mode):
                yield os.path.relpath(os.path.join(above, name), folder), status.st_size
            elif not stat.S_ISDIR(status.st_mode):
                raise ValueError(f"{name} is a link or no file")


def _read_array(
    folder: Path, name: str, shape: tuple[int, int], dtype: np.dtype[Any], sizes: dict[str, int]
) -> NDArray[Any]:
    import zarr

    rows = _rows_a_chunk(json_value(read_bounded(folder / name / "zarr.json")), name, shape, dtype)
    for number in range(-(-shape[0] // rows)):
        place = os.path.join(name, "c", str(number), "0")
        if place in sizes:
            _check_chunk(folder / place, sizes[place], rows * shape[1] * dtype.itemsize)
    array = zarr.open_array(folder / name, mode="r", zarr_format=3)
    return np.asarray(array[:])


def _rows_a_chunk(told: Any, name: str, shape: tuple[int, int], dtype: np.dtype[Any]) -> int:
    """Return the rows of a chunk; raises ValueError for an array that `store` would not write."""
    rows, width = told["chunk_grid"]["configuration"]["chunk_shape"]
    if told["shape"] != list(shape) or told["data_type"] != dtype.name:
        raise ValueError(f"array of {told['shape']} {told['data_type']} where {list(shape)} {dtype} belongs")
    if type(rows) is not int or not 0 < rows * width * dtype.itemsize <= LARGEST_CHUNK or width != shape[1]:
        raise ValueError(f"{name}: chunks of {rows} x {width}")
    order = BYTES if dtype.itemsize == 1 else LITTLE
    _, packing = told["codecs"]
    wanted = {
        "node_type": "array",
        "zarr_format": 3,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [rows, width]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [order, {"name": "zstd", "configuration": packing["configuration"]}],
        "storage_transformers": [],
    }
    for key, value in wanted.items():
        if told.get(key, []) != value:
            raise ValueError(f"{name}: {key} {told.get(key)} is not what stereovox writes")
    if type(told["fill_value"]) is not int:
        raise ValueError(f"{name}: fill_value {told['fill_value']}")
    return rows


def _check_chunk(path: Path, size: int, unpacked: int) -> None:
    """Raise ValueError for a chunk that does not say that it unpacks to just so many bytes."""
    with path.open("rb") as file:
        head = file.read(18)
    if len(head) < 6 or head[:4] != ZSTD or _announced(head) != unpacked or size > 2 * unpacked + 64:
        raise ValueError(f"chunk {path.parent.name} of {path.parents[2].name} does not unpack to {unpacked} bytes")


def _announced(head: bytes) -> int | None:
    """Return the size that a zstd frame says it unpacks to (RFC 8878, 3.1.1); None where it says nothing."""
    flags = head[4]
    alone, dictionary, length = flags >> 5 & 1, (0, 1, 2, 4)[flags & 3], (0, 2, 4, 8)[flags >> 6]
    length = length or alone
    start = 5 + (1 - alone) + dictionary
    told = int.from_bytes(head[start : start + length], "little")
    return (told + 256 if length == 2 else told) if length and len(head) >= start + length else None


def _check_coords(coords: NDArray[np.int32]) -> None:
    """Raise ValueError for a block that is named twice or lies farther away than cells can."""
    if (np.abs(coords.astype(np.int64)) >= INDEX_LIMIT // SIDE).any():
        raise ValueError("a block that lies too far away")
    if _ascend(coords):
        return
    if not _ascend(coords[np.lexsort(coords.T[::-1])]):
        raise ValueError("a block that is named twice")


def _ascend(coords: NDArray[np.int32]) -> bool:
    """Tell whether each block stands behind the one before: by x, then y, then z."""
    steps = np.sign(np.diff(coords.astype(np.int64), axis=0)) @ [4, 2, 1]
    return bool((steps > 0).all())
