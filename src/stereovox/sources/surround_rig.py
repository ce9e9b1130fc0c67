# SPDX-License-Identifier: Apache-2.0
"""The simulated drone's four stereo cameras: one ahead, two fisheyes to the sides, one down (Valenti 2018, ch. 3)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.geometry import Transform, look_at, rotation_matrix
from stereovox.lenses import Lens
from stereovox.rigs import Eyes, StereoPair
from stereovox.wide import SphericalCamera

BASELINE = 0.15
TOE_IN_DEG, ROLL_DEG = 0.4, -0.3
"""How the right eye of each pair is turned against the left: nobody glues cameras straight."""
FISHEYE_DEG = (150.0, 140.0)
"""Width and height of the fisheyes' virtual images. In their corners rows lie so steeply; further aside than 75 degrees
a pair sees along its own baseline, and its ranges are four times as noisy as in the middle (Valenti 2018, Eq 4.7)."""
BACKWARD_DEG = 20.0
"""The side cameras are turned so far backward, so that behind the vehicle both see something."""


@dataclass(frozen=True)
class Mount:
    """A camera of Table 3.1, at half its resolution.

    hfov_deg, width, height: of the image. distortion: of both lenses. looks_to, down: unit vectors in the body's frame
    (x forward, y left, z up): optical axis, and what is down in the image. centre: between both eyes, metres.
    """

    model: str
    hfov_deg: float
    width: int
    height: int
    distortion: tuple[float, ...]
    looks_to: tuple[float, float, float]
    down: tuple[float, float, float]
    centre: tuple[float, float, float]


def _aside(sign: float) -> tuple[float, float, float]:
    azimuth = sign * math.radians(90 + BACKWARD_DEG)
    return math.cos(azimuth), math.sin(azimuth), 0.0


_FISHEYE = ("fisheye", 175.0, 640, 360, (-0.01, 0.002, 0.0, 0.0))
MOUNTS = {
    "front": Mount("pinhole", 91.0, 960, 540, (-0.03, 0.006), (1, 0, 0), (0, 0, -1), (0.12, 0, 0)),
    "left": Mount(*_FISHEYE, _aside(1), (0, 0, -1), (0, 0.12, 0)),
    "right": Mount(*_FISHEYE, _aside(-1), (0, 0, -1), (0, -0.12, 0)),
    "down": Mount("pinhole", 105.0, 640, 360, (-0.03, 0.006), (0, 0, -1), (-1, 0, 0), (0, 0, -0.08)),
}
"""The four pairs by name, in the order in which they deliver."""


def surround_pair(name: str, scale: float = 1.0) -> StereoPair:
    """Return the stereo pair of this name; its images are `scale` times as wide as half those of Table 3.1."""
    mount = MOUNTS[name]
    width, height = max(16, round(mount.width * scale)), max(9, round(mount.height * scale))
    lens = Lens.from_field_of_view(mount.model, width, height, mount.hfov_deg)
    bent = Lens(lens.model, width, height, lens.fx, lens.fy, lens.cx, lens.cy, mount.distortion)
    eyes = Eyes(bent, bent, _right_eye())
    return StereoPair(_virtual(mount, width, height), eyes, _mounted(mount), name=name)


def _virtual(mount: Mount, width: int, height: int) -> PinholeCamera | SphericalCamera:
    if mount.model == "pinhole":
        return PinholeCamera.from_field_of_view(width, height, mount.hfov_deg, BASELINE)
    columns, rows = (round(width * angle / mount.hfov_deg) for angle in FISHEYE_DEG)
    return SphericalCamera.from_field_of_view(columns, rows, *FISHEYE_DEG, BASELINE)


def _right_eye() -> Transform:
    """Return T_left_right. Toe-in and roll leave the rectified left frame where the left eye's is."""
    T_left_right = np.eye(4)
    turn, roll = rotation_matrix([0, math.radians(TOE_IN_DEG), 0]), rotation_matrix([0, 0, math.radians(ROLL_DEG)])
    T_left_right[:3, :3], T_left_right[0, 3] = turn @ roll, BASELINE
    return T_left_right


def _mounted(mount: Mount) -> Transform:
    """Return T_body_camera of the rectified left eye."""
    T_body_camera: NDArray[np.float64] = look_at(np.zeros(3), mount.looks_to, -np.array(mount.down))
    T_body_camera[:3, 3] = np.array(mount.centre) - BASELINE / 2 * T_body_camera[:3, 0]
    return T_body_camera
