# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import pytest
from made_depth import SMALL, VGA, K, check, matrix_line, posed, render, units, write

from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.replica import RENDERED, Replica


def replica(folder, K=K, size=SMALL, per_metre=6553.5, poses="traj.txt", images="results/depth{:06d}.png"):
    for k, T in enumerate(posed()):
        write(folder / images.format(k), units(render(T, K, size), per_metre))
    (folder / poses).write_text("".join(map(matrix_line, posed())))
    return folder


@pytest.mark.parametrize("above", [True, False])
def test_nice_slams_rendering(tmp_path, above):
    folder = replica(tmp_path / "room0")
    camera = {"w": 64, "h": 48, "fx": K[0], "fy": K[1], "cx": K[2], "cy": K[3], "scale": 6553.5}
    ((tmp_path if above else folder) / "cam_params.json").write_text(json.dumps({"camera": camera}))
    source = open_source(folder)
    assert isinstance(source, Replica)
    check(source, posed(), 6553.5)
    assert source.unit.sure


def test_without_a_camera_file_the_size_says_which_rendering_it_is(tmp_path):
    (size, K), *_ = RENDERED.items()
    check(open_source(replica(tmp_path / "a", K, size)), posed(), 6553.5, K)
    folder = replica(tmp_path / "b", RENDERED[VGA], VGA, 1000, "traj_w_c.txt", "depth/depth_{}.png")
    source = open_source(folder)
    check(source, posed(), 1000, RENDERED[VGA])
    assert "320 320 319.5 239.5" in source.notes[0]
    with pytest.raises(SourceError, match=r"64x48 images have no standard calibration"):
        open_source(replica(tmp_path / "c"))


def test_the_images_show_another_unit_than_the_usual(tmp_path):
    folder = replica(tmp_path / "a", RENDERED[VGA], VGA, 1000)
    source = open_source(folder)
    check(source, posed(), 1000, RENDERED[VGA])
    assert any("millimetres" in note and "?depth_scale=5000" in note for note in source.notes)
