# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_depth import camera_text, check, posed, render, units, write

from stereovox.errors import SourceError
from stereovox.geometry.se3 import interpolate
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.sun3d import Sun3d

STEP_US = 33_369


def sun3d(folder, late_us=0):
    """Depth images whose bits are rotated, `late_us` after the colour images; an older file of extrinsics beside."""
    for k, T in enumerate(posed()):
        raw = units(render(T), 1000)
        stamp = k * STEP_US + late_us
        write(folder / f"depth/{k + 1:07d}-{stamp:012d}.png", (raw << 3 | raw >> 13).astype(np.uint16))
        write(folder / f"image/{k + 1:07d}-{k * STEP_US:012d}.png", np.zeros((4, 4, 3), np.uint8))
    (folder / "intrinsics.txt").write_text(camera_text())
    (folder / "extrinsics").mkdir()
    for name, factor in (("20110101000000.txt", 7.0), ("20140404000000.txt", 1.0)):
        np.savetxt(folder / "extrinsics" / name, np.concatenate([T[:3] * factor for T in posed()]))
    return folder


def test_bits_times_and_the_newest_poses(tmp_path):
    source = open_source(sun3d(tmp_path / "lab"))
    assert isinstance(source, Sun3d)
    check(source, posed(), 1000)
    assert [frame.stamp_ns for frame in source] == [k * STEP_US * 1000 for k in range(4)]
    assert source.unit.sure


def test_poses_are_those_of_the_colour_images(tmp_path):
    source = open_source(sun3d(tmp_path, STEP_US // 3))
    wanted = interpolate(posed()[0], posed()[1], 1 / 3)
    np.testing.assert_allclose(source.frame(0).T_world_sensor, wanted, atol=1e-5)
    assert source.frame(3).fault == "no_pose"


def test_without_the_colour_images_one_pose_each(tmp_path):
    folder = sun3d(tmp_path, 10_000)
    for image in (folder / "image").iterdir():
        image.unlink()
    check(open_source(folder), posed(), 1000)
    (folder / "extrinsics/20140404000000.txt").write_text("1 0 0 0\n0 1 0 0\n0 0 1 0\n")
    with pytest.raises(SourceError, match="holds 1 poses for 4 images"):
        open_source(folder)
