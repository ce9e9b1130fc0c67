# SPDX-License-Identifier: Apache-2.0
"""Files that strangers call a grid: bombs, headers that lie, pickles."""

import hashlib
import io
import json
import tracemalloc
import zipfile

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import MapFileError
from stereovox.files.safe_io import sealed
from stereovox.maps.grid_map import GridMap, load_grid
from stereovox.maps.occupancy import OccupancyGrid


@pytest.fixture
def parts(tmp_path):
    """The files inside of a sound grid."""
    cells = np.full((70, 65), -1, np.int8)
    cells[3:9, 5:60] = 0
    grid = GridMap.from_occupancy(OccupancyGrid(cells, 0.05, (1.0, 2.0, 0.0)), load_config(dimensions=2))
    grid.save(tmp_path / "sound.npz")
    with zipfile.ZipFile(tmp_path / "sound.npz") as file:
        return {name: file.read(name) for name in file.namelist()}


def packed(path, parts, kind=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", kind) as file:
        for name, data in parts.items():
            file.writestr(name, data)
    return path


def refusal(path):
    tracemalloc.start()
    try:
        with pytest.raises(MapFileError) as caught:
            load_grid(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 100_000_000
    assert str(caught.value).isprintable()
    return str(caught.value)


def array(shape, dtype, data=b""):
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": dtype, "fortran_order": False, "shape": shape})
    return file.getvalue() + data


def test_a_sound_one_is_read(tmp_path, parts):
    assert len(load_grid(packed(tmp_path / "a.npz", parts)).cells()[0]) == 330
    load_grid(packed(tmp_path / "a.npz", parts, zipfile.ZIP_STORED))


def test_a_part_that_swells(tmp_path, parts):
    path = packed(tmp_path / "a.npz", {**parts, "cells.npy": array((70_000_000,), "|u1", bytes(70_000_000))})
    assert path.stat().st_size < 100_000
    assert "unpacks to 70" in refusal(path)


@pytest.mark.parametrize("shape", [(10**12, 3), (2**62, 2**62), (0, 3), (-1, 3), (3,), (True, 3)])
@pytest.mark.parametrize("name", ["coords.npy", "cells.npy"])
def test_shapes_that_lie(tmp_path, parts, name, shape):
    refusal(packed(tmp_path / "a.npz", {**parts, name: array(shape, "<i4", parts[name][-24:])}))


def test_pickles_are_not_opened(tmp_path, parts):
    file = io.BytesIO()
    np.save(file, np.array([print], object), allow_pickle=True)
    assert "claims (1,) object" in refusal(packed(tmp_path / "a.npz", {**parts, "coords.npy": file.getvalue()}))


@pytest.mark.parametrize("kind", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_packings(tmp_path, parts, kind):
    assert "unknown compression" in refusal(packed(tmp_path / "a.npz", parts, kind))


def test_a_part_twice(tmp_path, parts):
    with zipfile.ZipFile(packed(tmp_path / "a.npz", parts), "a") as file, pytest.warns(UserWarning, match="Duplicate"):
        file.writestr("coords.npy", parts["coords.npy"])
    assert "holds no grid" in refusal(tmp_path / "a.npz")


@pytest.mark.parametrize("count", [-1, 1.5, 10**30, None, "1"])
def test_counts_that_are_none(tmp_path, parts, count):
    about = json.loads(parts["about.npy"][128:])
    about.pop("digest")
    text = sealed({**about, "frames": count})
    assert "frames" in refusal(packed(tmp_path / "a.npz", {**parts, "about.npy": array((len(text),), "|u1", text)}))


def test_settings_that_nest_deeply(tmp_path, parts):
    body = b'"a": ' + b'{"a":' * 100_000
    text = b'{"digest": "%s", ' % hashlib.blake2b(body, digest_size=16).hexdigest().encode() + body
    said = refusal(packed(tmp_path / "a.npz", {**parts, "about.npy": array((len(text),), "|u1", text)}))
    assert "nested too deeply" in said
