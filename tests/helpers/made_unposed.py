# SPDX-License-Identifier: Apache-2.0
"""A recording of a simulated room in TUM's layout without groundtruth.txt, images of which may be covered."""

from __future__ import annotations

from collections.abc import Collection
from functools import cache
from pathlib import Path

import numpy as np
from made_recordings import write_png

from stereovox.frame import Frame
from stereovox.opening import open_source

ROOM = "sim:room?camera=kinect&image_width=160&frames=240"
SCALE = 5000


@cache
def room(count: int) -> tuple[Frame, ...]:
    """The first frames, with their true poses."""
    return tuple(open_source(ROOM, f":{count}"))  # depth images


def unposed(folder: Path, count: int = 10, covered: Collection[int] = (), poses: bool = False) -> Path:
    """Write depth/ and camera-intrinsics.txt, with `poses` groundtruth.txt too; covered images hold no value."""
    lines = []
    for k, frame in enumerate(room(count)):
        depth = np.nan_to_num(frame.depth * frame.depth_scale * SCALE, posinf=0, neginf=0)
        name = f"{1 + frame.stamp_ns / 1e9:.6f}"
        write_png(folder / f"depth/{name}.png", (0 * depth if k in covered else depth.round()).astype(np.uint16))
        T, w = frame.T_world_sensor, quaternion(frame.T_world_sensor[:3, :3])
        lines.append(" ".join(map(str, (name, *T[:3, 3], *w))))
    camera = room(count)[0].camera
    (folder / "camera-intrinsics.txt").write_text(f"{camera.fx} 0 {camera.cx}\n0 {camera.fy} {camera.cy}\n0 0 1\n")
    if poses:
        (folder / "groundtruth.txt").write_text("\n".join(lines))
    return folder


def quaternion(R: np.ndarray) -> list[float]:
    """qx qy qz qw of a rotation."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(R).as_quat().tolist()
