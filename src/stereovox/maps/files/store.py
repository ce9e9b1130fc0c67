# SPDX-License-Identifier: Apache-2.0
"""A map on disk: a folder with a manifest (JSON) and the cells as Zarr v3 arrays.

Zarr writes are not transactional, so each save goes to a new folder and becomes the map when the manifest that names it
is renamed into place; only then is the older save removed. Each step waits until the data is on disk: a save that is
killed, or ended by a power cut, leaves the older map intact. The next save removes its remains.

Arrays are read only in the exact form written here. Zarr would follow whatever a stranger's folder states: any packing,
any shape, arrays of arrays, links to elsewhere. So everything is checked before Zarr sees the folder, and nothing is
allocated for missing data.
"""

from __future__ import annotations

import asyncio
import os
import re
import shutil
import stat
import uuid
import zlib
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import DepthCorrection, PinholeCamera
from stereovox.config import Config, load_config
from stereovox.errors import MapFileError
from stereovox.files.places import Place, is_url
from stereovox.files.safe_io import (
    count_in,
    json_value,
    read_bounded,
    sealed,
    shown,
    sync_folder,
    sync_tree,
    unsealed,
    zstd_size,
)
from stereovox.frame import Viewpoint
from stereovox.maps.cells.cell_format import FORMATS
from stereovox.maps.files.lock import LOCK, only_writer_in
from stereovox.maps.query.queries import INDEX_LIMIT
from stereovox.maps.record.frame_store import FRAME_FILES, files_of_frames, move_frames, read_frames, write_frames
from stereovox.maps.record.history import History
from stereovox.maps.record.kept_frames import KeptFrames
from stereovox.maps.storage.blocks import CELLS, SIDE
from stereovox.maps.storage.storage import Storage

ARRAYS = ("coords", "cells", "times")
"""Names of the arrays of a map, the last only if times are kept."""
MAX_CHUNK = 1 << 26
"""Largest size of an unpacked chunk in bytes; `store` writes 4 MiB."""
SMALL, PACKED_BEST = 1 << 24, 100
"""Coordinates may unpack to this many bytes, or to this many times their bytes on disk."""
BYTES, LITTLE = {"name": "bytes"}, {"name": "bytes", "configuration": {"endian": "little"}}
FORMAT = "stereovox-map"
VERSION = 4
MANIFEST = "manifest.json"
BOXED = b'"format": "stereovox-map", "version": 5,'
"""Start of the manifest of a map in boxes."""
MAX_MANIFEST = 1 << 22
"""Largest size of a manifest in bytes."""
BLOCKS_PER_CHUNK = 4096
UNFINISHED = re.compile(rf"cells-[0-9a-f]{{12}}|{FRAME_FILES}|\.manifest\.json\.new|\.lock")
"""Names of files that a killed save leaves."""
Slab = tuple[NDArray, ...]
"""Block coordinates (n, 3), cells (n, 512), and times (n, 512) if they are kept."""


class SavedMap(NamedTuple):
    """The content of a saved map; `times` is None if none were kept, `kept` if frames were not."""

    config: Config
    history: History
    viewpoint: Viewpoint | None
    window_state: dict[str, Any] | None
    coords: NDArray[np.int32]
    cells: NDArray[np.integer]
    times: NDArray[np.uint32] | None
    times_start_ns: int | None
    kept: KeptFrames | None


def save_map(storage: Storage, path: str | Path) -> None:
    """Write a map to the folder `path`; all of it is on disk when this returns.

    Raises MapFileError if it cannot be written, is not a map, or is being written by another run; an older map is then
    unchanged.
    """
    folder = Path(path)
    check_target(folder)
    data = f"cells-{uuid.uuid4().hex[:12]}"
    with only_writer_in(folder):
        sweep(folder)
        try:
            blocks, checksum = _write_arrays(folder / data, storage)
            sync_tree(folder / data)
            frames = None if storage.kept is None else write_frames(folder, storage.kept)
            _write_manifest(folder, {**_manifest(storage, data, blocks, checksum), "kept_frames": frames})
        except BaseException as error:
            _let_writes_end()
            if data not in _named(folder):  # else it is already the map, whatever the disk says
                sweep(folder)
            if not isinstance(error, OSError):
                raise
            raise MapFileError(
                f"{folder}: cannot save the map ({error.strerror or error}); choose a writable folder that has room"
            ) from None
        if storage.kept is not None:
            move_frames(folder, storage.kept)
        sweep(folder)


def remove_map(folder: Path) -> None:
    """Remove a saved map from its folder, which remains. Raises MapFileError if another run writes it."""
    with only_writer_in(folder):
        with suppress(OSError):
            (folder / MANIFEST).unlink(missing_ok=True)
        sweep(folder)


def check_target(folder: Path) -> None:
    """Raise MapFileError if a map cannot be saved to `folder`: it holds something else or is not writable."""
    if "\0" in str(folder):
        raise MapFileError(f"{str(folder)!r}: no file name holds the character 0; choose another name")
    if is_url(url := str(folder).replace(":/", "://", 1)):  # a path has one slash instead of two
        raise MapFileError(f"{url}: only a map in boxes can lie in an object store (fleet, save_boxed); name a folder")
    try:
        there = folder.exists()
    except OSError as error:  # the name is too long, or the folder may not be entered
        raise MapFileError(f"{folder}: cannot be written ({error.strerror}); choose another name") from None
    if there and not is_map(folder) and not _is_free(folder):
        raise MapFileError(f"{folder}: exists and is not a stereovox map; choose another name or remove it")
    if is_boxed(folder):
        raise MapFileError(f"{folder}: is a map in boxes; choose another name or remove it")
    nearest = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        where = "" if nearest == folder else f"{nearest} "
        raise MapFileError(f"{folder}: {where}cannot be written to; choose a writable folder")


def read_map(path: str | Path) -> SavedMap:
    """Read a whole map written by `save_map`. Raises MapFileError: one line with the file and what is wrong."""
    folder = Path(path)
    manifest = read_manifest(folder)
    while True:
        try:
            return _read(folder, manifest)
        except MapFileError:
            tried, manifest = manifest, read_manifest(folder)
            if manifest.get("data") == tried.get("data"):  # else a newer save replaced it meanwhile
                raise


def _read(folder: Path, manifest: dict[str, Any]) -> SavedMap:
    try:
        if not isinstance(manifest["config"], dict):
            raise TypeError("config is no table of settings")
        config, history = load_config(manifest["config"]), History.loaded(manifest)
        viewpoint, window = viewpoint_from(manifest["viewpoint"]), manifest["window"]
        start_ns = _start_ns(manifest["times_start_ns"])
        data, blocks = folder / str(manifest["data"]), count_in(manifest, "blocks")
        dtypes = [FORMATS[config.map.cell].dtype, np.dtype(np.uint32)][: 2 if config.map.keep_times else 1]
        coords, cells, *times = arrays = read_blocks(data, blocks, *dtypes)
        if _checksums(arrays) != manifest["checksum"]:
            raise ValueError("the cells do not match their checksum")
        kept = read_frames(folder, manifest["kept_frames"], config.map.frames_budget)
    except (KeyError, TypeError, ValueError, OSError, RuntimeError, OverflowError, AttributeError) as error:
        raise MapFileError(f"{folder}: damaged map ({type(error).__name__}: {error}); make it again") from None
    return SavedMap(config, history, viewpoint, window, coords, cells, times[0] if times else None, start_ns, kept)


def read_blocks(folder: Path, blocks: int, *dtypes: np.dtype[Any]) -> tuple[NDArray[Any], ...]:
    """Return coordinates (n, 3) int32 and the cell arrays (n, 512) of all blocks; no block is named twice.

    dtypes: of the cells, and of their times if any. They are read last: memory is allocated only for coordinates that
    really exist.
    Raises ValueError, one line, if the folder is not exactly what `store` writes, and OSError.
    """
    sizes = dict(_files(folder))
    if not 0 <= blocks * 3 * 4 <= max(SMALL, PACKED_BEST * sum(sizes.values())):
        raise ValueError(f"{blocks} blocks in {sum(sizes.values())} bytes")
    coords = _read_array(folder, "coords", (blocks, 3), np.dtype(np.int32), sizes)
    _check_coords(coords)
    kept = zip(ARRAYS[1:], dtypes, strict=False)
    return coords, *(_read_array(folder, name, (blocks, CELLS), dtype, sizes) for name, dtype in kept)


def _files(folder: Path) -> Iterator[tuple[str, int]]:
    """Yield path below `folder` and bytes of all files; raises ValueError for anything but files."""
    if folder.is_symlink():
        raise ValueError(f"{folder.name} is a link")
    for above, folders, names in os.walk(folder):
        for name in (*folders, *names):
            status = os.lstat(os.path.join(above, name))
            if name in names and stat.S_ISREG(status.st_mode):
                yield os.path.relpath(os.path.join(above, name), folder), status.st_size
            elif not stat.S_ISDIR(status.st_mode):
                raise ValueError(f"{name} is a link or not a file")


def _read_array(
    folder: Path, name: str, shape: tuple[int, int], dtype: np.dtype[Any], sizes: dict[str, int]
) -> NDArray[Any]:
    import zarr

    rows = _rows_per_chunk(json_value(read_bounded(folder / name / "zarr.json")), name, shape, dtype)
    for number in range(-(-shape[0] // rows)):
        place = os.path.join(name, "c", str(number), "0")
        if place in sizes:
            _check_chunk(folder / place, sizes[place], rows * shape[1] * dtype.itemsize)
    array = zarr.open_array(folder / name, mode="r", zarr_format=3)
    return np.asarray(array[:])


def _rows_per_chunk(header: Any, name: str, shape: tuple[int, int], dtype: np.dtype[Any]) -> int:
    """Return the rows of a chunk; raises ValueError for an array that `store` does not write."""
    rows, width = header["chunk_grid"]["configuration"]["chunk_shape"]
    if header["shape"] != list(shape) or header["data_type"] != dtype.name:
        raise ValueError(f"array of {header['shape']} {header['data_type']} where {list(shape)} {dtype} belongs")
    if type(rows) is not int or not 0 < rows * width * dtype.itemsize <= MAX_CHUNK or width != shape[1]:
        raise ValueError(f"{name}: chunks of {rows} x {width}")
    order = BYTES if dtype.itemsize == 1 else LITTLE
    _, packing = header["codecs"]
    wanted = {
        "node_type": "array",
        "zarr_format": 3,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [rows, width]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "codecs": [order, {"name": "zstd", "configuration": packing["configuration"]}],
        "storage_transformers": [],
    }
    for key, value in wanted.items():
        if header.get(key, []) != value:
            raise ValueError(f"{name}: {key} {header.get(key)} is not what stereovox writes")
    if type(header["fill_value"]) is not int:
        raise ValueError(f"{name}: fill_value {header['fill_value']}")
    return rows


def _check_chunk(path: Path, size: int, unpacked: int) -> None:
    """Raise ValueError for a chunk whose header does not give exactly this unpacked size."""
    with path.open("rb") as file:
        head = file.read(18)
    if zstd_size(head) != unpacked or size > 2 * unpacked + 64:
        raise ValueError(f"chunk {path.parent.name} of {path.parents[2].name} does not unpack to {unpacked} bytes")


def _check_coords(coords: NDArray[np.int32]) -> None:
    """Raise ValueError for a block that is named twice or out of range."""
    if (np.abs(coords.astype(np.int64)) >= INDEX_LIMIT // SIDE).any():
        raise ValueError("a block is out of range")
    if _ascend(coords):
        return
    if not _ascend(coords[np.lexsort(coords.T[::-1])]):
        raise ValueError("a block is named twice")


def _ascend(coords: NDArray[np.int32]) -> bool:
    """Return whether blocks ascend: by x, then y, then z."""
    steps = np.sign(np.diff(coords.astype(np.int64), axis=0)) @ [4, 2, 1]
    return bool((steps > 0).all())


def is_boxed(path: str | Path) -> bool:
    """Return whether a folder holds a map in boxes (`boxed_manifest`), by the start of its manifest."""
    try:
        with (Path(path) / MANIFEST).open("rb") as file:
            return BOXED in file.read(100)
    except OSError:
        return False


def is_map(path: str | Path) -> bool:
    """Return whether a folder holds a saved map, or a URL in an object store a map in boxes.

    Raises MapFileError if the store is unreachable.
    """
    if is_url(path):
        return MANIFEST in Place.of(path).sizes(MANIFEST)
    return (Path(path) / MANIFEST).is_file()


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a saved map: format, version, config, frames, data, blocks."""
    if not is_map(folder):
        raise MapFileError(
            f"{folder}: no stereovox map here (no {MANIFEST}); make one with: stereovox map SOURCE --out {folder}"
        )
    if is_boxed(folder):
        raise MapFileError(
            f"{folder}: is a map in boxes, which this cannot use; take a part of it with: stereovox crop"
        )
    if (folder / MANIFEST).is_symlink():
        raise MapFileError(f"{folder / MANIFEST}: is a link; a map has all its files in one folder")
    try:
        manifest = manifest_from(read_bounded(folder / MANIFEST, MAX_MANIFEST), VERSION, str(folder / MANIFEST))
    except OSError as error:
        reason = error.strerror or error
        raise MapFileError(f"{folder / MANIFEST}: cannot be read ({reason}); check that you may read it") from None
    if "/" in str(manifest.get("data")) or ".." in str(manifest.get("data")):
        raise MapFileError(f"{folder / MANIFEST}: data '{manifest['data']}' points outside the map")
    return manifest


def manifest_from(data: bytes, version: int, where: str) -> dict[str, Any]:
    """Return the manifest in a file. Raises MapFileError, one line, for damage, other files and other versions."""
    try:
        return _of_version(unsealed(data), version, where)
    except ValueError as error:
        why = error
    try:
        _of_version(json_value(data), version, where)  # other files and older manifests have no digest
    except ValueError as error:
        why = error
    raise MapFileError(f"{where}: damaged map ({why}); make it again")


def _of_version(manifest: Any, version: int, where: str) -> dict[str, Any]:
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise MapFileError(f"{where}: not a stereovox map")
    if manifest.get("version") != version:
        found = shown(manifest.get("version"))
        raise MapFileError(
            f"{where}: map format {found}, this program reads {version}; make the map again or update stereovox"
        )
    return manifest


def _is_free(folder: Path) -> bool:
    """Return whether a folder holds only remains of a killed save."""
    return folder.is_dir() and all(UNFINISHED.fullmatch(entry.name) for entry in folder.iterdir())


def sweep(folder: Path) -> None:
    """Remove remains of killed or failed saves: all that the manifest does not name. The lock must be held."""
    named = _named(folder)
    if not named and is_map(folder):
        return  # a damaged map is left alone
    with suppress(OSError):  # files that cannot be removed do no harm
        for entry in folder.iterdir():
            if UNFINISHED.fullmatch(entry.name) and entry.name not in {*named, LOCK}:
                shutil.rmtree(entry, ignore_errors=True) if entry.is_dir() else entry.unlink()


def _let_writes_end() -> None:
    """Wait for Zarr's pending writes: a failed file does not stop the others."""
    from zarr.core.sync import sync

    async def the_others() -> None:
        await asyncio.gather(*(asyncio.all_tasks() - {asyncio.current_task()}), return_exceptions=True)

    sync(the_others())


def _named(folder: Path) -> set[str]:
    """Return the names of the saved cells and frames; none if there is no map, or a damaged one."""
    with suppress(MapFileError, KeyError, TypeError):
        manifest = read_manifest(folder)
        return {str(manifest["data"]), *files_of_frames(manifest.get("kept_frames"))}
    return set()


def _manifest(storage: Storage, data: str, blocks: int, checksum: list[int]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        **storage.history.saved(),
        "blocks": blocks,
        "data": data,
        "checksum": checksum,
        "viewpoint": viewpoint_to(storage.viewpoint),
        "window": storage.window_state,
        "times_start_ns": storage.times_start_ns,
        "config": storage.config.model_dump(),
    }


def _checksums(arrays: Slab) -> list[int]:
    """Return a number for each array. Zarr reads a missing chunk as empty cells; these detect it."""
    return [zlib.crc32(np.ascontiguousarray(array).data) for array in arrays]


def _start_ns(saved: Any) -> int | None:
    return None if saved is None else int(saved)


def viewpoint_to(viewpoint: Viewpoint | None) -> dict[str, Any] | None:
    """Return a viewpoint as plain values for JSON, which `viewpoint_from` reads."""
    if viewpoint is None:
        return None
    camera, T_world_camera, stamp_ns = viewpoint
    return {"camera": asdict(camera), "T_world_camera": T_world_camera.tolist(), "stamp_ns": stamp_ns}


def viewpoint_from(saved: dict[str, Any] | None) -> Viewpoint | None:
    """Return a saved viewpoint. Raises KeyError, TypeError or ValueError for invalid values."""
    if saved is None:
        return None
    numbers = dict(saved["camera"])
    correction = numbers.pop("correction", None)
    if correction:
        correction = DepthCorrection(str(correction["model"]), tuple(map(float, correction["coefficients"])))
    T_world_camera = np.array(saved["T_world_camera"], float).reshape(4, 4)
    return Viewpoint(PinholeCamera(**numbers, correction=correction), T_world_camera, int(saved["stamp_ns"]))


def _write_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    temporary = folder / f".{MANIFEST}.new"
    with temporary.open("wb") as file:
        file.write(sealed(manifest, as_number, indent=2))
        file.flush()
        os.fsync(file.fileno())
    sync_folder(folder)  # all that the new manifest names is on disk before it
    temporary.replace(folder / MANIFEST)
    sync_folder(folder)


def as_number(number: Any) -> Any:
    """Return a NumPy number, which JSON cannot store, as Python's own: `np.int64(5)` as a time, for example."""
    if not isinstance(number, np.generic):
        raise TypeError(f"{type(number).__name__} cannot be saved")
    return number.item()


def _write_arrays(folder: Path, storage: Storage) -> tuple[int, list[int]]:
    """Write all blocks, piece by piece; return their number and the checksum of each array."""
    import zarr

    group = zarr.open_group(folder, mode="w", zarr_format=3)
    arrays, checksums = None, []
    slabs = storage.timed() if storage.config.map.keep_times else storage.slabs()
    for slab in _whole_chunks(slabs):
        if arrays is None:
            fills = (0, storage.cell_format.unknown, 0)
            arrays = [_new_array(group, *what) for what in zip(ARRAYS, slab, fills, strict=False)]
            checksums = [0] * len(arrays)
        for n, part in enumerate(slab):
            if len(part):
                arrays[n].append(part)
            checksums[n] = zlib.crc32(np.ascontiguousarray(part).data, checksums[n])
    return (arrays[0].shape[0] if arrays else 0), checksums


def _whole_chunks(slabs: Iterable[Slab]) -> Iterator[Slab]:
    """Yield the blocks in pieces of whole chunks, the last one shorter, so that no chunk is written twice."""
    held: list[Slab] = []
    rows = 0
    for slab in slabs:
        held.append(slab)
        rows += len(slab[0])
        if rows >= BLOCKS_PER_CHUNK:
            slab, whole = _joined(held), rows // BLOCKS_PER_CHUNK * BLOCKS_PER_CHUNK
            yield tuple(part[:whole] for part in slab)
            held, rows = [tuple(part[whole:] for part in slab)], rows - whole
    if held:
        yield _joined(held)


def _joined(slabs: list[Slab]) -> Slab:
    return slabs[0] if len(slabs) == 1 else tuple(np.concatenate(parts) for parts in zip(*slabs, strict=True))


def _new_array(group: Any, name: str, like: NDArray, fill: int) -> Any:
    rows = max(1, min(BLOCKS_PER_CHUNK, len(like)))
    shape, chunks = (0, like.shape[1]), (rows, like.shape[1])
    return group.create_array(name, shape=shape, dtype=like.dtype, chunks=chunks, fill_value=fill)
