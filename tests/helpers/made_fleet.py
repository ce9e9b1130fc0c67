# SPDX-License-Identifier: Apache-2.0
"""Short recordings through the same rooms, and the maps that one mapper makes of them."""

import atexit
import shutil
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import cv2
import numpy as np

import stereovox as sv
from stereovox.sources.poses.trajectory import write_trajectory

SETTINGS = {"profile": "default", "voxel_size": 0.2}


def write_folder(folder, frames):
    """Write a folder of TUM's layout."""
    (folder / "depth").mkdir(parents=True)
    lines, camera = [], frames[0].camera
    for frame in frames:
        name = f"depth/{frame.stamp_ns / 1e9:.9f}.png"
        depth = np.nan_to_num(np.where(np.isfinite(frame.depth), frame.depth, 0) * frame.depth_scale * 5000)
        cv2.imwrite(str(folder / name), depth.astype(np.uint16))
        lines.append(f"{frame.stamp_ns / 1e9:.9f} {name}")
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    poses = np.array([frame.T_world_sensor for frame in frames])
    write_trajectory(folder / "groundtruth.txt", [frame.stamp_ns for frame in frames], poses, "camera")
    names = "width", "height", "fx", "fy", "cx", "cy"
    (folder / "camera.toml").write_text("".join(f"{name} = {getattr(camera, name)}\n" for name in names))


@cache
def recording(number, step=70):
    """Return the folder of a short recording, one of several ways through the same rooms."""
    folder = Path(mkdtemp(prefix="stereovox-test-")) / f"drive{number}"
    atexit.register(shutil.rmtree, folder.parent)
    frames = list(sv.open_source(f"sim:apartment?image_width=64&seed={number}", f"{20 * number}::{step}"))[:6]
    write_folder(folder, frames)
    return str(folder)


@cache
def alone(recording, **settings):
    """Return the map of a recording by one mapper, which keeps its frames."""
    mapper = sv.Mapper("default", voxel_size=0.2, **{"map.keep_frames": True, **settings})
    for frame in sv.open_source(recording):
        mapper.add(frame)
    return mapper.map


def assert_same(ours, theirs):
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b)
