# SPDX-License-Identifier: Apache-2.0
"""The map folder: what may stand in it, what a save that fails leaves, and how large its pieces are."""

import json

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import MapFileError
from stereovox.files.safe_io import sealed, unsealed
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.files import store
from stereovox.maps.storage.storage import Storage

CONFIG = load_config(voxel_size=0.1)
CAMERA = PinholeCamera.from_field_of_view(64, 48, 90, 0.05)


def small_map(cells=((0, 0, 0), (9, -3, 100))):
    return VoxelMap.from_cells(CONFIG, cells, np.full(len(cells), 2.0))


def test_numbers_of_numpy_are_saved_as_numbers(tmp_path):
    one = small_map()
    camera = PinholeCamera(64, 48, np.float32(50.5), np.float32(50.25), np.float64(31.5), 23.5, 0.05)
    one.viewpoint = Viewpoint(camera, np.eye(4), np.int64(1_700_000_000_123_456_789))
    one.save(tmp_path / "m")
    _, _, stamp_ns = load_map(tmp_path / "m").viewpoint
    assert stamp_ns == 1_700_000_000_123_456_789
    assert load_map(tmp_path / "m").viewpoint.camera.fx == 50.5


@pytest.mark.parametrize("error", [TypeError("object cannot be saved"), KeyboardInterrupt(), OSError(28, "full")])
def test_a_first_save_that_fails_leaves_nothing(tmp_path, monkeypatch, error):
    def fail(*_):
        raise error

    with monkeypatch.context() as broken:
        broken.setattr(store, "_manifest", fail)
        with pytest.raises(MapFileError if isinstance(error, OSError) else type(error)):
            small_map().save(tmp_path / "m")
        assert not (tmp_path / "m").exists()
    small_map().save(tmp_path / "m")
    whole = sorted(path.name for path in (tmp_path / "m").iterdir())
    monkeypatch.setattr(store, "_manifest", fail)
    with pytest.raises(MapFileError if isinstance(error, OSError) else type(error)):
        small_map().save(tmp_path / "m")
    assert sorted(path.name for path in (tmp_path / "m").iterdir()) == whole
    assert len(load_map(tmp_path / "m").cells()[0]) == 2


def test_what_a_killed_first_save_left_is_in_nobodys_way(tmp_path):
    (tmp_path / "m" / "cells-0123456789ab" / "coords").mkdir(parents=True)
    (tmp_path / "m" / ".manifest.json.new").write_text("{")
    small_map().save(tmp_path / "m")
    assert sorted(path.name[:6] for path in (tmp_path / "m").iterdir()) == ["cells-", "manife"]
    (tmp_path / "mine" / "cells-of-my-own").mkdir(parents=True)
    with pytest.raises(MapFileError, match="not a stereovox map"):
        small_map().save(tmp_path / "mine")


def test_a_name_that_cannot_be_is_one_line():
    with pytest.raises(MapFileError, match=r"'a\\x00b': no file name holds"):
        small_map().save("a\0b")


def test_slabs_of_any_size_are_saved_in_whole_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(store, "BLOCKS_PER_CHUNK", 16)
    cells = np.random.default_rng(0).permutation(8 * np.argwhere(np.ones((4, 5, 6), bool)))
    whole = small_map(cells)
    coords, values = whole.storage.blocks()

    class Slabs(Storage):
        def slabs(self):
            for start, end in ((0, 1), (1, 4), (4, 4), (4, 70), (70, 73), (73, 120)):
                yield coords[start:end], values[start:end]

    saved = VoxelMap(CONFIG, storage=Slabs(CONFIG))
    saved.save(tmp_path / "m")
    for got, wanted in zip(load_map(tmp_path / "m").storage.blocks(), (coords, values), strict=True):
        np.testing.assert_array_equal(got, wanted)
    assert len(list((tmp_path / "m").rglob("cells/c/*/0"))) == 8  # 120 blocks by 16
    written = json.loads(next((tmp_path / "m").rglob("cells/zarr.json")).read_text())
    assert written["chunk_grid"]["configuration"]["chunk_shape"] == [16, 512]


def changed(**keys):
    return lambda manifest: sealed({**unsealed(manifest), **keys})


@pytest.mark.parametrize(
    "damage",
    [
        lambda data: data.replace(b'"frames": 0', b'"frames": 1e400'),
        lambda data: b"[" * 200_000,
        changed(config="default"),
        changed(config=None),
        changed(config=[["voxel_size", 0.1]]),
        changed(viewpoint={"camera": {}, "T_world_camera": [], "stamp_ns": float("inf")}),
        changed(viewpoint=7),
        changed(checksum=None),
        changed(data=""),
        changed(data="a\0b"),
    ],
)
def test_a_damaged_manifest_is_one_line(tmp_path, damage):
    small_map().save(tmp_path / "m")
    manifest = tmp_path / "m" / "manifest.json"
    before = manifest.read_bytes()
    manifest.write_bytes(damage(before))
    assert manifest.read_bytes() != before
    with pytest.raises(MapFileError, match=r"make .* again") as caught:
        load_map(tmp_path / "m")
    assert "\n" not in str(caught.value)


def test_what_may_not_be_read_or_written_is_named_once_with_its_cure(tmp_path, monkeypatch):
    small_map().save(tmp_path / "m")
    monkeypatch.setattr(store.os, "access", lambda *_: False)
    with pytest.raises(MapFileError) as refused:
        store.check_target(tmp_path / "m")
    assert str(refused.value) == f"{tmp_path / 'm'}: cannot be written to; choose a writable folder"
    monkeypatch.setattr(store, "read_bounded", forbidden)
    with pytest.raises(MapFileError) as refused:
        load_map(tmp_path / "m")
    manifest = tmp_path / "m" / "manifest.json"
    assert str(refused.value) == f"{manifest}: cannot be read (Permission denied); check that you may read it"


def forbidden(path, most):
    raise PermissionError(13, "Permission denied", str(path))
