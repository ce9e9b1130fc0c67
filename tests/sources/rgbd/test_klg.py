# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.klg import KlgLog

POSES = "".join(f"{0.1 * k:.6f} {0.2 * k} 0 0 0 0 0 1\n" for k in range(3))


def image(k):
    return (1000 + 100 * k + np.arange(320 * 240) % 50).astype("<u2").reshape(240, 320)


def klg(path, pack=zlib.compress, poses=POSES):
    content = struct.pack("<i", 3)
    for k in range(3):
        depth, picture = pack(image(k).tobytes()), b"jpeg" * k
        content += struct.pack("<qii", 100_000 * k, len(depth), len(picture)) + depth + picture
    path.write_bytes(content)
    if poses:
        path.with_suffix(".klg.freiburg").write_text(poses)
    path.with_name("camera-intrinsics.txt").write_text("264 264 160 120")
    return path


@pytest.mark.parametrize("pack", [zlib.compress, bytes])
def test_frames_hold_what_the_file_holds(tmp_path, pack):
    source = open_source(klg(tmp_path / "desk.klg", pack))
    assert isinstance(source, KlgLog)
    assert (len(source), source.camera.fx) == (3, 264)
    for k, frame in enumerate(source):
        np.testing.assert_array_equal(frame.depth, image(k))
        assert frame.stamp_ns == k * 100_000_000
        assert frame.depth_scale == 0.001
        np.testing.assert_allclose(frame.T_world_sensor[:3, 3], [0.2 * k, 0, 0], atol=1e-9)


def test_poses_may_be_named(tmp_path):
    klg(tmp_path / "desk.klg", poses="")
    with pytest.raises(SourceError, match=r"holds depth but no poses.*\?poses=FILE"):
        open_source(tmp_path / "desk.klg")
    (tmp_path / "way.txt").write_text(POSES)
    assert open_source(f"{tmp_path / 'desk.klg'}?poses=way.txt").frame(2).T_world_sensor[0, 3] == pytest.approx(0.4)


def test_a_file_that_is_cut_off_has_the_frames_that_are_whole(tmp_path):
    path = klg(tmp_path / "desk.klg")
    path.write_bytes(path.read_bytes()[:-20])
    source = open_source(path)
    assert len(source) == 2
    assert any("ends after 2 of 3 frames" in note for note in source.notes)


def test_a_damaged_image_spoils_its_own_frame_only(tmp_path):
    path = klg(tmp_path / "desk.klg")
    content = bytearray(path.read_bytes())
    content[path.stat().st_size // 2] ^= 0xFF
    path.write_bytes(bytes(content))
    assert [frame.fault for frame in open_source(path)].count("unreadable") == 1


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "not a .klg log"),
        (b"\3\0\0\0", "holds no whole frame"),
        (struct.pack("<iqii", 1, 0, 4, 0) + b"abcd", "the first depth image"),
        (struct.pack("<iqii", 1, 0, 12, 0) + zlib.compress(b"abcd"), "images of 2 pixels"),
        (struct.pack("<iqii", 1, 0, -9, 0), "holds no whole frame"),
    ],
)
def test_a_file_of_no_use_is_one_line(tmp_path, content, said):
    path = klg(tmp_path / "desk.klg")
    path.write_bytes(content)
    with pytest.raises(SourceError, match=said):
        open_source(path)
