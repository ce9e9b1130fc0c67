# SPDX-License-Identifier: Apache-2.0
"""A depth camera and a tracker on one body, waved by hand in the simulated room; all of it known exactly."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stereovox.geometry.se3 import Transform, inverse, look_at
from stereovox.simulate.d435 import D435, depth_camera
from stereovox.simulate.scene import Scene
from stereovox.simulate.scenes.room import room
from stereovox.sources.poses.poses import Poses, seconds_from_ns
from stereovox.sources.rigs.pair_file import PairSettings, pair_text

START_NS = 1_700_000_000_000_000_000
"""Time of the first image."""
WIDTH = 106
OFFSET_S = 1234.5678
"""Image stamp - tracker stamp."""
T_TRACKER_CAMERA = np.eye(4)
T_TRACKER_CAMERA[:3, :3] = Rotation.from_euler("xyz", [4.0, -7.0, 3.0], degrees=True).as_matrix()
T_TRACKER_CAMERA[:3, 3] = 0.06, -0.11, 0.04
LEVEL = look_at([0, 0, 0], [1, 0, 0])
"""Optical axes that look along x of a world with z up."""


@cache
def built_room() -> Scene:
    return room()


def waved(seconds: float, axes: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Transform:
    """T_world_camera at a time: position sways, pitch, yaw and roll swing out of step; `axes` scales the three."""
    t = seconds
    eye = [2.6 + 0.35 * np.sin(0.9 * t), -0.6 + 0.3 * np.sin(1.3 * t + 1), 1.3 + 0.2 * np.sin(1.1 * t + 2)]
    pitch, yaw, roll = (
        axes[0] * 17 * np.sin(1.7 * t + 0.4) * np.cos(0.31 * t),
        axes[1] * (25 * np.sin(0.8 * t) + 9 * np.sin(2.3 * t + 1)),
        axes[2] * 20 * np.sin(1.27 * t + 2),
    )
    T = np.eye(4)
    turned = Rotation.from_euler("yxz", [yaw, pitch, roll], degrees=True).as_matrix()
    T[:3, :3] = Rotation.from_euler("z", 200, degrees=True).as_matrix() @ LEVEL[:3, :3] @ turned
    T[:3, 3] = eye
    return T


def depth_images(cameras: list[Transform], subpixel: float = 0.02) -> list[NDArray[np.uint16]]:
    """What a D435 of few pixels sees, in millimetres; 0.02 of its wide pixels are about 0.08 of the real ones."""
    camera = depth_camera(WIDTH)
    device = D435(camera, subpixel=subpixel)
    x, y = camera.ray_slopes()
    rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1).reshape(-1, 3)
    images = []
    for i, T in enumerate(cameras):
        true = built_room().cast(T[:3, 3], (rays @ T[:3, :3].T.astype(np.float32)).astype(np.float32))
        images.append(device.measure(true.reshape(camera.height, camera.width), [7, i])[0])
    return images


def tracker_poses(cameras: list[Transform], stamps_ns: list[int], jitter: float = 0.0) -> Poses:
    """Exact poses (jitter 1: as a T265's) of the tracker, body in optical axes, in the world of the cameras."""
    random = np.random.default_rng(3)
    poses = []
    for T in cameras:
        tremble = np.eye(4)
        tremble[:3, :3] = Rotation.from_rotvec(jitter * np.radians(0.03) * random.standard_normal(3)).as_matrix()
        tremble[:3, 3] = jitter * 0.0007 * random.standard_normal(3)
        poses.append(T @ inverse(T_TRACKER_CAMERA) @ tremble)
    return Poses(stamps_ns, np.array(poses), where="made")


def times(count: int, hz: float, first_s: float = 0.0) -> tuple[list[float], list[int]]:
    """Seconds of the motion, and stamps of the image clock."""
    seconds = [first_s + i / hz for i in range(count)]
    return seconds, [START_NS + round(s * 1e9) for s in seconds]


def write_depth(folder: Path, images: list[NDArray[np.uint16]], stamps_ns: list[int]) -> Path:
    """A folder of stamped images with the camera's matrix and no poses."""
    (folder / "depth").mkdir(parents=True, exist_ok=True)
    for image, stamp in zip(images, stamps_ns, strict=True):
        assert cv2.imwrite(str(folder / "depth" / f"{seconds_from_ns(stamp)}.png"), image)
    camera = depth_camera(WIDTH)
    (folder / "camera-intrinsics.txt").write_text(f"{camera.fx} 0 {camera.cx}\n0 {camera.fy} {camera.cy}\n0 0 1\n")
    return folder


def tracker_lines(
    poses: Poses, offset_s: float = OFFSET_S, confidence: list[int] | None = None, opengl: bool = True
) -> str:
    """The poses as a T265 tells them: its own clock, OpenGL axes, y up. The poses' world must have z up."""
    lines = []
    for k, (stamp, T) in enumerate(zip(poses.stamps_ns.tolist(), poses.T_world_body, strict=True)):
        R, t = T[:3, :3], T[:3, 3]
        if opengl:
            # by hand: the world's x, y, z of OpenGL are right, up, back = -y, z, -x of "x forward, y left, z up";
            # the body's are those of the optical frame with y and z turned over
            t = np.array([-t[1], t[2], -t[0]])
            R = np.array([-R[1], R[2], -R[0]]) * [1, -1, -1]
        numbers = [*t, *Rotation.from_matrix(R).as_quat()]
        trust = "" if confidence is None else f" {confidence[k]}"
        lines.append(
            f"{seconds_from_ns(stamp - round(offset_s * 1e9))} " + " ".join(f"{n:.9f}" for n in numbers) + trust
        )
    return "\n".join(lines) + "\n"


def settings(**changes: object) -> str:
    """The text of a `pair.toml` that is right for these recordings."""
    right = {"T_tracker_camera": T_TRACKER_CAMERA, "clock_offset_s": OFFSET_S, "depth_scale": 0.001, "baseline": 0.05}
    return pair_text(PairSettings(**{**right, **changes}))  # type: ignore[arg-type]
