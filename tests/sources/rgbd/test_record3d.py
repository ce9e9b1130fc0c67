# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import made_rooms as room
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.record3d import Record3D

OPENGL = np.diag([1.0, -1, -1, 1])
OpenEXR = pytest.importorskip("OpenEXR")


def record3d(folder, **change):
    rows = []
    for k in range(room.COUNT):
        (folder / "depth").mkdir(parents=True, exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, {"R": room.depth_m(k).astype(np.float32)}) as file:
            file.write(str(folder / f"depth/{k}.exr"))
        T = room.pose(k) @ OPENGL
        rows.append([*room.quaternion(T), *T[:3, 3]])
    cx, cy = (10 * (centre + 0.5) - 0.5 for centre in (room.CX, room.CY))
    table = {"K": [10 * room.FX, 0, 0, 0, 10 * room.FY, 0, cx, cy, 1], "w": 640, "h": 480, "fps": 10, "poses": rows}
    (folder / "metadata.json").write_text(json.dumps(table | change))
    return folder


@pytest.mark.parametrize("inner", ["", "EXR_RGBD"])
def test_frames_are_those_of_the_room(tmp_path, inner):
    record3d(tmp_path / inner)
    source = open_source(tmp_path)
    assert isinstance(source, Record3D)
    assert source.notes == ()
    for k, frame in enumerate(source):
        room.check(frame, k)
        assert frame.stamp_ns == k * 100_000_000


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"poses": [[0, 0, 0, 1, 0, 0, 0]]}, "holds 1 poses for 5 images"),
        ({"poses": [[0, 0, 0, 0, 0, 0, 0]] * 5}, "is not qx qy qz qw"),
        ({"K": [1, 2, 3]}, "needs K, 9 numbers"),
        ({"w": -640}, "w and h must be positive"),
        ({"h": 640}, "is for 640x640 pictures, depth has 64x48"),
        ({"K": [-500, 0, 0, 0, 500, 0, 320, 240, 1]}, "fx = -50 must be positive"),
    ],
)
def test_a_bad_file_is_one_line_with_its_name(tmp_path, change, said):
    with pytest.raises(SourceError, match=rf"metadata\.json.*{said}"):
        open_source(record3d(tmp_path, **change))
