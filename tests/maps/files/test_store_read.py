# SPDX-License-Identifier: Apache-2.0
"""Folders that strangers call a map: only what `save` writes is read, and only as much as is really there."""

import json
import os
import tracemalloc

import numpy as np
import pytest
import zarr
from made_manifest import change_manifest
from numcodecs import Zstd

from stereovox.config import load_config
from stereovox.errors import MapFileError
from stereovox.files.safe_io import zstd_size
from stereovox.maps import VoxelMap, load_map

CONFIG = load_config(voxel_size=0.1)


@pytest.fixture
def folder(tmp_path):
    VoxelMap.from_cells(CONFIG, [(0, 0, 0), (9, -3, 100)], [2.0, -1.0]).save(tmp_path / "m")
    return tmp_path / "m"


def arrays(folder):
    return next(folder.glob("cells-*"))


def refusal(folder):
    tracemalloc.start()
    try:
        with pytest.raises(MapFileError) as caught:
            load_map(folder)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 30_000_000
    assert str(caught.value).isprintable()
    return str(caught.value)


def change(path, **keys):
    path.write_text(json.dumps({**json.loads(path.read_text()), **keys}))


def grid(*shape, name="regular"):
    return {"name": name, "configuration": {"chunk_shape": list(shape)}}


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"shape": [2, 513]}, "array of [2, 513] int16 where [2, 512] int16 belongs"),
        ({"shape": [10**15, 512]}, "belongs"),
        ({"shape": "2"}, "belongs"),
        ({"data_type": "int8"}, "belongs"),
        ({"data_type": "object"}, "belongs"),
        ({"chunk_grid": grid(2, 1)}, "chunks of 2 x 1"),
        ({"chunk_grid": grid(0, 512)}, "chunks of 0 x 512"),
        ({"chunk_grid": grid(10**12, 512)}, "chunks of"),
        ({"chunk_grid": grid(2.5, 512)}, "chunks of"),
        ({"chunk_grid": grid(2, 512, name="rectangular")}, "chunk_grid"),
        ({"chunk_key_encoding": {"name": "v2", "configuration": {"separator": "/"}}}, "chunk_key_encoding"),
        ({"codecs": [{"name": "bytes"}, {"name": "numcodecs.pickle", "configuration": {}}]}, "codecs"),
        ({"codecs": [{"name": "bytes", "configuration": {"endian": "big"}}] * 2}, "codecs"),
        ({"codecs": [{"name": "sharding_indexed"}]}, "damaged map"),
        ({"codecs": None}, "damaged map"),
        ({"storage_transformers": [{"name": "x"}]}, "storage_transformers"),
        ({"node_type": "group"}, "node_type"),
        ({"zarr_format": 2}, "zarr_format"),
        ({"fill_value": "NaN"}, "fill_value"),
    ],
)
def test_an_array_that_stereovox_would_not_write(folder, keys, said):
    change(arrays(folder) / "cells/zarr.json", **keys)
    assert said in refusal(folder)


def test_a_pickle_in_an_older_format_is_not_even_looked_at(folder):
    (arrays(folder) / "cells/zarr.json").unlink()
    (arrays(folder) / "cells/.zarray").write_text('{"zarr_format": 2, "filters": [{"id": "pickle"}]}')
    assert "zarr.json" in refusal(folder)


@pytest.mark.parametrize("blocks", [3, 10**6, 10**15, -1, 2.0, "2", None])
def test_a_number_of_blocks_that_lies(folder, blocks):
    change_manifest(folder / "manifest.json", blocks=blocks)
    refusal(folder)


@pytest.mark.parametrize("size", [10**9, 100, None])
def test_a_chunk_that_swells(folder, size):
    chunk = arrays(folder) / "cells/c/0/0"
    packed = Zstd().encode(bytes(size or 2048))
    if size is None:  # a frame that does not tell its size
        packed = packed[:4] + bytes([packed[4] & 0b00011111]) + b"\x58" + packed[6:]
    chunk.write_bytes(packed)
    assert "does not unpack to 2048 bytes" in refusal(folder)
    for length in range(6):
        chunk.write_bytes(packed[:length])
        assert "does not unpack to 2048 bytes" in refusal(folder)


@pytest.mark.parametrize("size", [0, 1, 255, 256, 65_791, 65_792, 4_000_000])
def test_what_a_packed_piece_announces(size):
    assert zstd_size(Zstd().encode(bytes(size))[:18].ljust(18, b"\0")) == size


def test_links_lead_nowhere(folder, tmp_path):
    chunk = arrays(folder) / "cells/c/0/0"
    chunk.rename(tmp_path / "elsewhere")
    chunk.symlink_to(tmp_path / "elsewhere")
    assert "is a link or not a file" in refusal(folder)
    chunk.unlink()
    os.mkfifo(chunk)
    assert "is a link or not a file" in refusal(folder)
    chunk.unlink()
    (tmp_path / "elsewhere").rename(chunk)
    load_map(folder)
    inner = arrays(folder)
    inner.rename(tmp_path / "cells-elsewhere")
    inner.symlink_to(tmp_path / "cells-elsewhere")
    assert "is a link" in refusal(folder)


@pytest.mark.parametrize("data", ["../other.svox/cells-1", "/etc", "..", ".", "a\\..\\b"])
def test_data_elsewhere(folder, data):
    change_manifest(folder / "manifest.json", data=data)
    refusal(folder)


@pytest.mark.parametrize(
    ("coords", "said"),
    [
        ([[1, 2, 3], [1, 2, 3]], "named twice"),
        ([[5, 0, 0], [1, 2, 3], [5, 0, 0]], "named twice"),
        ([[0, 0, 0], [2**31 - 1, 0, 0]], "out of range"),
        ([[0, 0, 0], [0, -(2**31), 0]], "out of range"),
    ],
)
def test_blocks_that_cannot_be(folder, coords, said):
    group = zarr.open_group(arrays(folder), mode="r+")
    for name, array in (("coords", np.array(coords, np.int32)), ("cells", np.ones((len(coords), 512), np.int16))):
        del group[name]
        group.create_array(name, shape=array.shape, dtype=array.dtype, chunks=array.shape)[:] = array
    change_manifest(folder / "manifest.json", blocks=len(coords))
    assert said in refusal(folder)


@pytest.mark.parametrize("key", ["frames", "frames_refused"])
@pytest.mark.parametrize("count", [-1, 1.5, 10**400, None, True])
def test_counts_that_are_none(folder, key, count):
    change_manifest(folder / "manifest.json", **{key: count})
    assert f"{key} " in refusal(folder)


def test_a_recording_that_would_write_to_the_terminal(folder):
    change_manifest(folder / "manifest.json", recording="a\n\x1b[2Jb")
    assert load_map(folder).recording == "a\\n\\x1b[2Jb"


def test_a_manifest_without_end_or_by_a_link(folder, tmp_path):
    manifest = folder / "manifest.json"
    whole = manifest.read_text()
    manifest.write_text(whole + " " * (1 << 22))
    assert "holds more than" in refusal(folder)
    manifest.write_text(whole)
    manifest.rename(tmp_path / "elsewhere.json")
    manifest.symlink_to(tmp_path / "elsewhere.json")
    assert "is a link" in refusal(folder)
