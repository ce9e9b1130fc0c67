# SPDX-License-Identifier: Apache-2.0
"""Maps and camera paths that a comparison reads from files."""

import re

import numpy as np
import pytest
from made_kitti import raw

import stereovox as sv
from stereovox.errors import MapFileError, SourceError
from stereovox.evaluate.inputs import read_camera_path, read_map
from stereovox.evaluate.scores import score
from stereovox.formats import export

CELLS = [[x, y, -3] for x in range(-5, 5) for y in range(9)]
VALUES, OURS = np.random.default_rng(3).choice([3.0, -3.0], (2, len(CELLS)), p=[0.3, 0.7])


@pytest.mark.parametrize("size", [0.2, 0.08, 1 / 3])
def test_all_kinds_of_maps_score_alike(tmp_path, size):
    one = sv.VoxelMap.from_cells(sv.load_config(voxel_size=size, **{"map.prior": 0.5}), CELLS, VALUES)
    one.save(tmp_path / "a.svox")
    export(one, tmp_path / "a.bt")
    export(one, tmp_path / "a.ot")
    ours = sv.VoxelMap.from_cells(one.config, CELLS[20:], OURS[20:])
    wanted = score(ours, one).as_dict()
    assert 0 < wanted["precision"] < 1
    for name in ("a.svox", "a.bt", "a.ot"):
        assert score(ours, read_map(tmp_path / name)).as_dict() == wanted, name


@pytest.mark.parametrize("name", ["nothing.svox", "nothing.bt", "nothing.ot"])
def test_a_map_that_is_not_there_is_named(tmp_path, name):
    with pytest.raises(MapFileError, match=name):
        read_map(tmp_path / name)


def test_a_recording_is_no_map(tmp_path):
    drive = raw(tmp_path, 1)
    with pytest.raises(MapFileError, match=f"is a recording, no map; .*stereovox truth {re.escape(str(drive))} --out"):
        read_map(drive)
    (tmp_path / "empty").mkdir()
    with pytest.raises(MapFileError, match="no stereovox map here"):
        read_map(tmp_path / "empty")


POSITIONS = np.array([[1.0, 2, 3], [4, 5, 6], [7, 8, 9.5]])


@pytest.mark.parametrize("layout", ["xyz", "tum", "tracker", "kitti", "matrix"])
def test_camera_positions_are_read_from_every_layout(tmp_path, layout):
    matrices = np.tile(np.eye(4), (3, 1, 1))
    matrices[:, :3, 3] = POSITIONS
    stamps, quaternions = np.arange(3)[:, None], np.tile([0, 0, 0, 1], (3, 1))
    tables = {
        "xyz": POSITIONS,
        "tum": np.hstack([stamps, POSITIONS, quaternions]),
        "tracker": np.hstack([stamps, POSITIONS, quaternions, 3 + 0 * stamps]),
        "kitti": matrices[:, :3].reshape(3, 12),
        "matrix": matrices.reshape(3, 16),
    }
    np.savetxt(tmp_path / "path.txt", tables[layout], header="a comment")
    assert np.array_equal(read_camera_path(tmp_path / "path.txt"), POSITIONS)


@pytest.mark.parametrize("text", ["", "1 2\n", "1 2 nan\n", "1 2 3\n1 2\n", "a b c\n"])
def test_a_path_that_cannot_be_read_is_named(tmp_path, text, recwarn):
    (tmp_path / "path.txt").write_text(text)
    with pytest.raises(SourceError, match=r"path\.txt"):
        read_camera_path(tmp_path / "path.txt")
    assert not recwarn
    with pytest.raises(SourceError, match="absent"):
        read_camera_path(tmp_path / "absent.txt")
