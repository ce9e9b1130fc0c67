# SPDX-License-Identifier: Apache-2.0
"""`export` by file ending, all or nothing; points for other programs."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.formats import EXPORTS, FLAT, export
from stereovox.formats.points import PCD_POINT, PLY_POINT
from stereovox.maps import VoxelMap

CONFIG = load_config(voxel_size=0.25, **{"map.prior": 0.5, "scan.floor": -9.0, "scan.heights": (0.1, 18.0)})


@pytest.fixture
def voxel_map():
    indices = np.argwhere(np.ones((5, 4, 6))) - [2, 2, 1]
    return VoxelMap.from_cells(CONFIG, indices, np.random.default_rng(0).uniform(-2, 3.5, len(indices)))


def test_an_unknown_ending_lists_the_known_ones(tmp_path, voxel_map):
    for name in ("map.xyz", "map", "map.svox"):
        with pytest.raises(StereovoxError) as error:
            export(voxel_map, tmp_path / name)
        assert all(ending in str(error.value) for ending in EXPORTS)
        assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", [ending for ending in EXPORTS if ending != ".rrd"])  # see test_rerun.py
def test_places_that_cannot_be_written(tmp_path, voxel_map, ending):
    (tmp_path / "file").write_text("")
    (tmp_path / f"folder{ending}").mkdir()
    for place in ("missing/map", "file/map", "folder"):
        path = tmp_path / f"{place}{ending}"
        with pytest.raises(MapFileError) as error:
            export(voxel_map, path)
        files = [path, path.with_suffix(".yaml")] if ending in FLAT else [path]
        assert str(error.value).startswith(tuple(map(str, files)))
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("ending", [ending for ending in EXPORTS if ending != ".rrd"])  # see test_rerun.py
def test_only_a_whole_export_replaces_an_older_file(tmp_path, voxel_map, ending, monkeypatch):
    path = tmp_path / f"map{ending}"
    path.write_text("old")

    def full_disk(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full_disk)
        with pytest.raises(MapFileError, match="No space left"):
            export(voxel_map, path)
    assert path.read_text() == "old"
    export(voxel_map, str(path))
    first = path.read_bytes()
    export(voxel_map, path)
    assert path.read_bytes() == first != b"old"
    beside = {".pgm": ["map.yaml"], ".png": ["map.yaml"], ".yaml": ["map.pgm"]}.get(ending, [])
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted([path.name, *beside])


def test_the_ending_may_be_in_capitals_and_links_are_followed(tmp_path, voxel_map):
    (tmp_path / "kept").mkdir()
    (tmp_path / "link.PLY").symlink_to(tmp_path / "kept" / "real.ply")
    export(voxel_map, tmp_path / "link.PLY")
    assert (tmp_path / "link.PLY").is_symlink()
    assert (tmp_path / "kept" / "real.ply").read_bytes().startswith(b"ply\n")


def test_other_packages_add_their_own(tmp_path, voxel_map, monkeypatch):
    class Entry:
        name = ".cells"

        @staticmethod
        def load():
            return lambda one, path: path.write_text(str(len(one.cells()[0])))

    monkeypatch.setattr("stereovox.registry.entry_points", lambda group: [Entry] if group == "stereovox.export" else [])
    export(voxel_map, tmp_path / "map.cells")
    assert (tmp_path / "map.cells").read_text() == "120"


def test_ply_holds_the_occupied_cells(tmp_path, voxel_map):
    trimesh = pytest.importorskip("trimesh")
    export(voxel_map, tmp_path / "map.ply")
    cloud = trimesh.load(tmp_path / "map.ply")
    centers = voxel_map.occupied()
    assert 0 < len(centers) < 120
    np.testing.assert_allclose(cloud.vertices, centers)
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(np.ravel(raw["probability"]), voxel_map.probability(centers))
    low, high = centers[:, 2] == centers[:, 2].min(), centers[:, 2] == centers[:, 2].max()
    for level in (low, high):
        assert len(np.unique(cloud.colors[level], axis=0)) == 1
    assert cloud.colors[low][0, 2] > cloud.colors[low][0, 0]  # from blue
    assert cloud.colors[high][0, 0] > cloud.colors[high][0, 2]  # to red


@pytest.mark.parametrize("ending", [".ply", ".pcd"])
def test_points_are_coloured_by_height_whichever_way_is_up(tmp_path, ending):
    voxel_map = VoxelMap.from_cells(load_config(CONFIG, up="-y"), [[0, 0, 0], [0, -1, 0], [0, 0, 1]], [3.0] * 3)
    export(voxel_map, tmp_path / f"map{ending}")
    data = (tmp_path / f"map{ending}").read_bytes()
    kind = PLY_POINT if ending == ".ply" else PCD_POINT
    points = np.frombuffer(data, kind, offset=len(data) - 3 * kind.itemsize)
    top = points["y"] < 0
    assert top.tolist().count(True) == 1
    colours = points["red" if ending == ".ply" else "rgb"]
    assert colours[top] > colours[~top][0] == colours[~top][1]


def test_npz_holds_every_known_cell(tmp_path, voxel_map):
    export(voxel_map, tmp_path / "map.npz")
    with np.load(tmp_path / "map.npz") as arrays:
        assert (arrays["indices"].dtype, arrays["log_odds"].dtype) == (np.int32, np.float32)
        again = VoxelMap.from_cells(CONFIG, arrays["indices"], arrays["log_odds"])
        assert float(arrays["voxel_size"]) == 0.25
        assert (float(arrays["free_below"]), float(arrays["occupied_above"])) == pytest.approx((9 / 26, 18 / 23))
    for ours, theirs in zip(voxel_map.cells(), again.cells(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_an_empty_map_gives_empty_points(tmp_path):
    export(VoxelMap(CONFIG), tmp_path / "empty.ply")
    export(VoxelMap(CONFIG), tmp_path / "empty.npz")
    header = (tmp_path / "empty.ply").read_bytes().decode("ascii").splitlines()
    assert "element vertex 0" in header
    assert header[-1] == "end_header"
    with np.load(tmp_path / "empty.npz") as arrays:
        assert arrays["indices"].shape == (0, 3)
