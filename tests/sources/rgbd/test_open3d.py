# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import numpy as np
import pytest
from made_depth import SMALL, VGA, K, check, posed, render, units, write

from stereovox.opening import open_source
from stereovox.sources.rgbd.layouts.open3d import Open3DFolder

PRIMESENSE = (525.0, 525.0, 319.5, 239.5)


def log_text(poses):
    blocks = (f"{k} {k} {k + 1}\n" + "\n".join(" ".join(map(str, row)) for row in T) for k, T in enumerate(poses))
    return "\n".join(blocks) + "\n"


def folder_of(folder, K=K, size=SMALL):
    for k, T in enumerate(posed()):
        write(folder / f"depth/{k:05d}.png", units(render(T, K, size), 1000))
        write(folder / f"image/{k:05d}.png", np.zeros((4, 4, 3), np.uint8))
    return folder


@pytest.mark.parametrize("place", ["trajectory.log", "scene/trajectory.log", "test_scene/trajectory.log"])
def test_a_log_with_open3ds_camera(tmp_path, place):
    folder = folder_of(tmp_path)
    (folder / place).parent.mkdir(exist_ok=True)
    (folder / place).write_text(log_text(posed()))
    matrix = np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]])
    camera = {"width": 64, "height": 48, "intrinsic_matrix": matrix.T.ravel().tolist()}
    (folder / "camera_intrinsic.json").write_text(json.dumps(camera))
    source = open_source(folder)
    assert isinstance(source, Open3DFolder)
    check(source, posed(), 1000)
    assert (source.unit.sure, source.notes) == (True, ())


def test_without_a_camera_it_is_the_primesense(tmp_path):
    folder = folder_of(tmp_path, PRIMESENSE, VGA)
    (folder / "trajectory.log").write_text(log_text(posed()))
    source = open_source(folder)
    check(source, posed(), 1000, PRIMESENSE)
    assert "525 525 319.5 239.5" in source.notes[0]


def test_a_trajectory_in_json_is_inverted(tmp_path):
    folder = folder_of(tmp_path)
    cameras = [{"extrinsic": np.linalg.inv(T).T.ravel().tolist()} for T in posed()]
    table = {"class_name": "PinholeCameraTrajectory", "parameters": cameras}
    (folder / "trajectory.json").write_text(json.dumps(table))
    (folder / "intrinsics.txt").write_text(" ".join(map(str, K)))
    check(open_source(folder), posed(), 1000)
