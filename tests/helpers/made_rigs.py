# SPDX-License-Identifier: Apache-2.0
"""Small recordings of stereo rigs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from made_recordings import write_png

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import CylindricalCamera, Lens
from stereovox.geometry.se3 import rotation_matrix
from stereovox.sources.rigs.rig_file import Rig, RigPair, Virtual, write_rig

FORWARD = np.array([[0.0, 0, 1, 0.2], [-1, 0, 0, 0.05], [0, -1, 0, -0.1], [0, 0, 0, 1]])
"""T_body_left of an eye that looks ahead: body x forward, y left, z up."""
CAMERA = PinholeCamera(32, 24, 30.0, 30.5, 15.5, 11.5, 0.1)


def eyes() -> Eyes:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0.01, -0.02, 0.005]), (0.15, 0.001, -0.002)
    left = Lens("fisheye", 48, 36, 16.0, 16.1, 23.2, 17.9, (-0.02, 0.011, -0.008, 0.0014))
    return Eyes(left, Lens("fisheye", 48, 36, 15.9, 16.2, 24.0, 18.1, (0.01, 0.0, 0.0, 0.0)), T)


def rig() -> Rig:
    virtual = Virtual("spherical", (60, 40), 150.0, 100.0)
    return Rig(
        (
            RigPair("front", camera=CAMERA, T_body_left=FORWARD, mask_rectangles=((0, 20, 32, 24),)),
            RigPair("side", eyes=eyes(), virtual=virtual),
        )
    )


def picture(number: int, size: tuple[int, int]) -> np.ndarray:
    return ((np.arange(size[0] * size[1]) * (number + 3)) % 251).astype(np.uint8).reshape(size[1], size[0])


def poses_text(*stamps_ns: int) -> str:
    """The body moves one metre a second along x and does not turn."""
    return "".join(f"{ns / 1e9:.9f} {ns / 1e9:.9f} 2 3 0 0 0 1\n" for ns in stamps_ns)


def recorded(folder: Path, what: Rig | None = None) -> Path:
    """Two pairs: `front` at 0.1 and 0.2 s, `side` at 0.1 and 0.15 s; poses at 0.05, 0.12 and 0.21 s."""
    folder.mkdir(parents=True, exist_ok=True)
    write_rig(folder / "rig.toml", what or rig())
    for name, size, stamps in (("front", (32, 24), (100, 200)), ("side", (48, 36), (100, 150))):
        for number, stamp_ms in enumerate(stamps):
            for side in (0, 1):
                at = folder / name / ("left", "right")[side] / f"{stamp_ms * 1_000_000}.png"
                write_png(at, picture(2 * number + side, size))
    (folder / "poses.txt").write_text(poses_text(50_000_000, 120_000_000, 210_000_000))
    return folder


def cylinder() -> CylindricalCamera:
    return CylindricalCamera(40, 30, 20.0, 0.05, 19.5, 14.5, 0.12)
