# SPDX-License-Identifier: Apache-2.0
"""Cells that left a window, in tiles on disk: one Zarr v3 array without practical bounds, one tile a chunk.

A background thread writes, so that mapping does not wait for the disk; pending writes are bounded.
"""

from __future__ import annotations

import re
import shutil
import tempfile
import weakref
import zlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, one_line
from stereovox.maps.cells.cell_format import CellFormat
from stereovox.maps.files.lock import LOCK, only_store_in
from stereovox.maps.storage.blocks import CELLS, SIDE

BLOCKS = 4
"""Blocks along each side of a tile."""
TILE = BLOCKS * SIDE
"""Cells along each side of a tile."""
OFFSET = 1 << 30
"""Index of cell 0 in the array: Zarr has no negative indices."""
WAITING = 128
"""Most tiles that wait to be written; with one more, mapping waits."""

DAMAGED = "the map of this run is damaged, make it again on a disk that works"

INNER = "times"
"""Folder for another store of the same tiles; removing this one's folder removes it too."""
OURS = re.compile(rf"{re.escape(LOCK)}|zarr\.json|c|{INNER}|.*\.partial")
"""Names in a store's folder."""

Tile = tuple[int, int, int]


class TileStore:
    """Tiles of 32x32x32 cells by their coordinates (cell index // 32).

    folder: it must be empty, missing, or hold the remains of a killed run; `close` removes it. By default a temporary
    one that is removed with this object. Raises MapFileError if the folder is unusable, or in use by another run.
    """

    def __init__(self, cell_format: CellFormat, folder: Path | None = None):
        self._format = cell_format
        self.folder = Path(tempfile.mkdtemp(prefix="stereovox-tiles-")) if folder is None else folder
        self._writing = ExitStack()
        self._array = self._create()
        self._tiles: dict[Tile, int] = {}  # with the checksum of each one's content
        self._waiting: dict[Tile, tuple[NDArray, Future[None]]] = {}
        self._failed: OSError | None = None
        self._writer = ThreadPoolExecutor(1, thread_name_prefix="stereovox-tiles")
        if folder is None:
            weakref.finalize(self, shutil.rmtree, self.folder, ignore_errors=True)

    def __contains__(self, tile: Tile) -> bool:
        return tile in self._tiles

    def tiles(self) -> list[Tile]:
        """Return the coordinates of all tiles, ascending."""
        return sorted(self._tiles)

    def put(self, tile: Tile, coords: NDArray[np.int32], cells: NDArray[np.integer]) -> None:
        """Store the blocks of one tile: block coordinates (n, 3), cells (n, 512). They replace earlier content.

        A tile that cannot be written stays in memory, so that no cell is lost; `check` reports it.
        """
        while len(self._waiting) >= WAITING and self._failed is None:
            self._settle(next(iter(self._waiting)))
        dense = np.full((BLOCKS,) * 3 + (CELLS,), self._format.unknown, self._format.dtype)
        dense[tuple((coords - np.multiply(tile, BLOCKS)).T)] = cells
        self._tiles[tile] = zlib.crc32(dense.data)
        self._waiting[tile] = dense, self._writer.submit(self._write, tile, dense)
        self._forget_written()

    def check(self) -> None:
        """Raise MapFileError if a tile could not be written."""
        self._forget_written()
        if self._failed is not None:
            why = self._failed.strerror or self._failed
            raise MapFileError(f"{self.folder}: a tile cannot be written ({why}); choose a disk that has room")

    def get(self, tile: Tile) -> tuple[NDArray[np.int32], NDArray[np.integer]]:
        """Return the blocks of one tile that have any known cell: coordinates (n, 3), cells (n, 512)."""
        dense = self._dense(tile)
        known = (dense != self._format.unknown).any(axis=3)
        return np.argwhere(known).astype(np.int32) + np.multiply(tile, BLOCKS).astype(np.int32), dense[known]

    def blocks_at(self, tile: Tile, coords: NDArray[np.int32]) -> NDArray[np.integer]:
        """Return the cells (n, 512) of blocks (n, 3) in `tile`."""
        return self._dense(tile)[tuple((coords - np.multiply(tile, BLOCKS)).T)]

    def stored_at(self, tile: Tile, cells: NDArray[np.int64]) -> NDArray[np.integer]:
        """Return the stored numbers (n,) of cells (n, 3) in `tile`."""
        block, cell = np.divmod(cells - np.multiply(tile, TILE), SIDE)
        column = (cell[:, 0] * SIDE + cell[:, 1]) * SIDE + cell[:, 2]
        return self._dense(tile)[(*block.T, column)]

    def close(self) -> None:
        """Remove the folder and drop pending writes."""
        self._writer.shutdown(wait=True, cancel_futures=True)
        self._remove()

    def _create(self) -> Any:
        """Return the empty array on disk; the folder is ours until `_remove`."""
        self._check_unused()
        self._writing.enter_context(only_store_in(self.folder))
        try:
            self._clear()
            return self._new_array()
        except BaseException as error:
            self._remove()
            if not isinstance(error, OSError):
                raise
            raise MapFileError(f"{self.folder}: cannot keep tiles here ({error.strerror or error})") from None

    def _new_array(self) -> Any:
        import zarr

        return zarr.create_array(
            self.folder, shape=(2 * OFFSET,) * 3, chunks=(TILE,) * 3,
            dtype=self._format.dtype, fill_value=self._format.unknown, zarr_format=3,
        )  # fmt: skip

    def _check_unused(self) -> None:
        """Refuse a folder with anything but the remains of another store, or one in use."""
        try:
            names = {entry.name for entry in self.folder.iterdir()} if self.folder.exists() else set()
        except OSError as error:
            raise MapFileError(f"{self.folder}: cannot keep tiles here ({error.strerror or error})") from None
        if names and not (names & {LOCK, "zarr.json"} and all(map(OURS.fullmatch, names))):
            raise MapFileError(f"{self.folder}: holds something that is not a tile; move it away")

    def _clear(self) -> None:
        """Remove all but the lock: tiles of this store or of a killed run."""
        for entry in self.folder.iterdir():
            if entry.name != LOCK:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()

    def _remove(self) -> None:
        with suppress(OSError):
            self._clear()
        self._writing.close()
        with suppress(OSError):
            self.folder.rmdir()

    def _dense(self, tile: Tile) -> NDArray:
        waiting = self._waiting.get(tile)
        return waiting[0] if waiting else self._read(tile)

    def _write(self, tile: Tile, dense: NDArray) -> None:
        self._array[_place(tile)] = _to_cells(dense)

    def _read(self, tile: Tile) -> NDArray:
        """Return a written tile. Raises MapFileError if the disk has lost it."""
        try:
            dense = _to_blocks(np.asarray(self._array[_place(tile)]))
        except (OSError, ValueError, RuntimeError) as error:
            why = getattr(error, "strerror", None) or one_line(str(error))
            raise MapFileError(f"{self.folder}: tile {tile} cannot be read ({why}); {DAMAGED}") from None
        if tile in self._tiles and zlib.crc32(dense.data) != self._tiles[tile]:
            raise MapFileError(f"{self.folder}: tile {tile} is not what was written there; {DAMAGED}")
        return dense

    def _settle(self, tile: Tile) -> None:
        try:
            self._waiting[tile][1].result()
            del self._waiting[tile]
        except OSError as error:
            self._failed = error

    def _forget_written(self) -> None:
        for tile in [tile for tile, (_, written) in self._waiting.items() if written.done()]:
            self._settle(tile)


def blocks_of(tile: Tile) -> NDArray[np.int32]:
    """Return the coordinates (64, 3) of a tile's blocks."""
    return (_WITHIN + np.multiply(tile, BLOCKS)).astype(np.int32)


def slabs_of(tiles: list[Tile]) -> Iterator[list[Tile]]:
    """Yield ascending tiles in groups of the same x."""
    for x in dict.fromkeys(tile[0] for tile in tiles):
        yield [tile for tile in tiles if tile[0] == x]


_WITHIN = np.stack(np.meshgrid(*[np.arange(BLOCKS)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


def _place(tile: Tile) -> tuple[slice, ...]:
    return tuple(slice(OFFSET + TILE * t, OFFSET + TILE * (t + 1)) for t in tile)


def _to_cells(blocks: NDArray) -> NDArray:
    """Return blocks (4, 4, 4, 512) as cells (32, 32, 32)."""
    return blocks.reshape((BLOCKS,) * 3 + (SIDE,) * 3).transpose(0, 3, 1, 4, 2, 5).reshape((TILE,) * 3)


def _to_blocks(cells: NDArray) -> NDArray:
    """Return cells (32, 32, 32) as blocks (4, 4, 4, 512)."""
    split = cells.reshape(BLOCKS, SIDE, BLOCKS, SIDE, BLOCKS, SIDE).transpose(0, 2, 4, 1, 3, 5)
    return np.ascontiguousarray(split).reshape((BLOCKS,) * 3 + (CELLS,))
