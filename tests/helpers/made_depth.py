# SPDX-License-Identifier: Apache-2.0
"""A small room, seen by a camera that moves sideways: true depth and poses, to write them as other programs do."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import cv2
import numpy as np

from stereovox.simulate.scene import Scene, box
from stereovox.sources.rgbd.pose_files import MIRROR_CAMERA, MIRROR_WORLD

SMALL, VGA = (64, 48), (640, 480)
K = (52.0, 51.0, 31.0, 24.0)
"""fx, fy, cx, cy of images of SMALL."""


@cache
def room() -> Scene:
    """4 x 3 x 2.5 m with two boxes, which no mirror maps onto each other."""
    walls = [
        ((-0.1, 0, 0), (0, 3, 2.5)), ((4, 0, 0), (4.1, 3, 2.5)), ((0, -0.1, 0), (4, 0, 2.5)),
        ((0, 3, 0), (4, 3.1, 2.5)), ((0, 0, -0.1), (4, 3, 0)), ((0, 0, 2.5), (4, 3, 2.6)),
    ]  # fmt: skip
    boxes = [((2.5, 0.3, 0), (3.2, 0.9, 1.0)), ((3.4, 1.6, 0), (4, 2.6, 1.9))]
    return Scene([box("room", str(k), low, high) for k, (low, high) in enumerate(walls + boxes)])


def posed(count: int = 4) -> list[np.ndarray]:
    """T_world_camera (4, 4) in a world with z up: looking along x, moving along y and up, turning a little."""
    found = []
    for k in range(count):
        yaw = 0.3 - 0.15 * k
        forward, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        T = np.eye(4)
        T[:3, :3] = np.stack([-left, [0, 0, -1], forward], axis=1)
        T[:3, 3] = 0.6 + 0.2 * k, 1.0 + 0.1 * k, 1.0 + 0.15 * k
        found.append(T)
    return found


def render(T: np.ndarray, K: Sequence[float] = K, size: tuple[int, int] = SMALL) -> np.ndarray:
    """True depth (height, width) float32 in metres along the optical axis."""
    return _render(T.tobytes(), tuple(K), size).copy()


@cache
def _render(numbers: bytes, K: tuple[float, ...], size: tuple[int, int]) -> np.ndarray:
    T = np.frombuffer(numbers).reshape(4, 4)
    fx, fy, cx, cy = K
    v, u = np.mgrid[: size[1], : size[0]]
    rays = np.stack([(u - cx) / fx, (v - cy) / abs(fy), np.ones_like(u, float)], axis=-1).reshape(-1, 3)
    return room().cast(T[:3, 3], rays @ T[:3, :3].T).reshape(size[1], size[0])


def units(depth_m: np.ndarray, per_metre: float) -> np.ndarray:
    return np.rint(depth_m * per_metre).astype(np.uint16)


def write(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def left_handed(T: np.ndarray) -> np.ndarray:
    """The pose as ICL-NUIM writes it: a camera whose y points up, in a left-handed world."""
    return MIRROR_WORLD @ T @ MIRROR_CAMERA


def quaternion(T: np.ndarray) -> np.ndarray:
    """qx qy qz qw of a rotation."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(T[:3, :3]).as_quat()


def tum_line(stamp: object, T: np.ndarray) -> str:
    return " ".join(map(str, [stamp, *T[:3, 3], *quaternion(T)])) + "\n"


def matrix_line(T: np.ndarray, rows: int = 4) -> str:
    return " ".join(map(str, T[:rows].ravel())) + "\n"


def camera_text(K: Sequence[float] = K) -> str:
    fx, fy, cx, cy = K
    return f"{fx} 0 {cx}\n0 {fy} {cy}\n0 0 1\n"


def check(source, poses: Sequence[np.ndarray], per_metre: float, K: Sequence[float] = K, missing: Sequence[int] = ()):
    """A source must give just these poses and the room's depth; frames in `missing` have no pose."""
    size = source.camera.width, source.camera.height
    assert len(source) == len(poses)
    for i, T in enumerate(poses):
        frame = source.frame(i)
        if i in missing:
            assert frame.fault == "no_pose", frame.fault_detail
            continue
        assert frame.fault is None, frame.fault_detail
        np.testing.assert_allclose(frame.T_world_sensor, T, atol=2e-6)
        np.testing.assert_allclose(frame.depth * frame.depth_scale, render(T, K, size), atol=0.6 / per_metre + 1e-5)
    assert (source.camera.fx, source.camera.fy) == (K[0], abs(K[1]))


def sens(
    path: Path, poses: Sequence[np.ndarray], code: int = 1, shift: float = 1000.0, size: tuple[int, int] = SMALL
) -> Path:
    """Write ScanNet's .sens, version 4, with a colour of a few bytes."""
    matrix = np.eye(4, dtype="<f4")
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = K
    one = np.eye(4, dtype="<f4").tobytes()
    name = b"StructureSensor"
    data = struct.pack("<IQ", 4, len(name)) + name + one + one + matrix.tobytes() + one
    data += struct.pack("<2i4IfQ", 2, code, 1296, 968, *size, shift, len(poses))
    for k, T in enumerate(poses):
        raw = units(render(T) if np.isfinite(T).all() else np.ones(SMALL[::-1]), shift).astype("<u2").tobytes()
        packed = zlib.compress(raw) if code == 1 else raw
        data += T.astype("<f4").tobytes() + struct.pack("<4Q", k, k, 3, len(packed)) + b"jpg" + packed
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data + struct.pack("<Q", 0))
    return path


def slambench_raw(path: Path, poses: Sequence[np.ndarray], size: tuple[int, int], K: Sequence[float]) -> Path:
    """Write SLAMBench's .raw."""
    head = struct.pack("<2I", *size)
    colour = bytes(3 * size[0] * size[1])
    frames = (head + units(render(T, K, size), 1000).astype("<u2").tobytes() + head + colour for T in poses)
    path.write_bytes(b"".join(frames))
    return path
