# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import made_rooms as room
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_images, open_source
from stereovox.sources.rgbd.layouts.polycam import Polycam

OPENGL = np.diag([1.0, -1, -1, 1])
CX, CY = (10 * (centre + 0.5) - 0.5 for centre in (room.CX, room.CY))


def polycam(folder, kind="corrected_cameras"):
    for k in range(room.COUNT):
        name = f"{1_700_000_000_000_000 + 100_000 * k}"
        room.write(folder / f"keyframes/depth/{name}.png", room.depth_mm(k))
        room.write(folder / f"keyframes/confidence/{name}.png", np.full((48, 64), 255, np.uint8))
        matrix = (room.pose(k) @ OPENGL)[:3]
        numbers = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
        numbers |= {"fx": 10 * room.FX, "fy": 10 * room.FY, "cx": CX, "cy": CY, "width": 640, "height": 480}
        path = folder / f"keyframes/{kind}/{name}.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(numbers))
    return folder


@pytest.mark.parametrize(("kind", "notes"), [("corrected_cameras", 0), ("cameras", 1)])
@pytest.mark.parametrize("inner", ["", "keyframes"])
def test_frames_are_those_of_the_room(tmp_path, kind, notes, inner):
    source = open_source(polycam(tmp_path, kind) / inner)
    assert isinstance(source, Polycam)
    assert len(source.notes) == notes
    for k, frame in enumerate(source):
        room.check(frame, k)
        assert frame.stamp_ns == 1_700_000_000_000_000_000 + k * 100_000_000


def test_pixels_of_low_confidence_have_no_value(tmp_path):
    polycam(tmp_path)
    confidence = np.full((48, 64), 127, np.uint8)
    confidence[3, 4] = 0
    path = sorted((tmp_path / "keyframes/confidence").iterdir())[1]
    room.write(path, confidence)
    assert np.argwhere(open_source(tmp_path).frame(1).depth == 0).tolist() == [[3, 4]]


def test_an_image_without_a_camera_has_no_pose(tmp_path):
    paths = sorted((polycam(tmp_path) / "keyframes/corrected_cameras").iterdir())
    paths[0].unlink()
    paths[2].write_text('{"fx": 1}')
    assert [frame.fault for frame in open_source(tmp_path)] == ["bad_pose_file", None, "bad_pose_file", None, None]


def test_no_camera_at_all_is_one_line(tmp_path):
    for path in (polycam(tmp_path) / "keyframes/corrected_cameras").iterdir():
        path.write_text("{")
    with pytest.raises(SourceError, match="corrected_cameras: holds no usable pose"):
        open_source(tmp_path)
    with pytest.raises(SourceError, match=r"add \?camera=FILE"):
        open_images(tmp_path)
