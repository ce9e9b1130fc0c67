# SPDX-License-Identifier: Apache-2.0
"""Exact depth images of a small empty room, from a camera that moves through it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from stereovox.frame import Frame
from stereovox.geometry.se3 import look_at

SIZE = (64, 48)
FX, FY, CX, CY = 50.0, 52.0, 30.5, 24.5
LOW, HIGH = np.array([-2.0, -2.5, 0.0]), np.array([3.0, 2.0, 2.5])
COUNT = 5
T_BASE_CAMERA = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.02], [0, -1, 0, 0.3], [0, 0, 0, 1]])
"""Mounting of the camera on a robot whose x points forward and z up."""


def pose(k: int) -> np.ndarray:
    """T_world_camera (4, 4), z up; the camera moves 0.4 m from image to image."""
    return look_at([0.4 * k - 1.0, 0.3, 1.2], [2.0 + 0.1 * k, -1.5, 0.9])


def depth_m(k: int, columns: np.ndarray | None = None, rows: np.ndarray | None = None) -> np.ndarray:
    """(48, 64) float64 metres; columns and rows: where the camera sees each pixel, if not at itself."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    u, v = (u, v) if columns is None or rows is None else (columns, rows)
    T = pose(k)
    rays = np.stack([(u - CX) / FX, (v - CY) / FY, np.ones_like(u)], -1) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        return (np.where(rays > 0, HIGH - T[:3, 3], LOW - T[:3, 3]) / rays).min(-1)


def depth_mm(k: int) -> np.ndarray:
    """(48, 64) uint16 millimetres."""
    return np.rint(1000 * depth_m(k)).astype(np.uint16)


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image)
    return path


def quaternion(T: np.ndarray) -> list[float]:
    """x, y, z, w of a rotation of less than half a turn."""
    w = np.sqrt(max(1 + np.trace(T[:3, :3]), 1e-12)) / 2
    R = T[:3, :3]
    return [(R[2, 1] - R[1, 2]) / 4 / w, (R[0, 2] - R[2, 0]) / 4 / w, (R[1, 0] - R[0, 1]) / 4 / w, w]


def seven(T: np.ndarray) -> str:
    return " ".join(f"{number:.9f}" for number in (*T[:3, 3], *quaternion(T)))


def check(frame: Frame, k: int, tolerance_m: float = 0.0011, factor: float = 1.0) -> None:
    """Assert that a frame is image `k` of the room, seen by its camera."""
    assert frame.fault is None, frame.fault_detail
    np.testing.assert_allclose(frame.depth * frame.depth_scale, depth_m(k), atol=tolerance_m)
    np.testing.assert_allclose(frame.T_world_sensor[:3, :3], pose(k)[:3, :3], atol=1e-5)
    np.testing.assert_allclose(frame.T_world_sensor[:3, 3], factor * pose(k)[:3, 3], atol=1e-3)
    camera = frame.camera
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (FX, FY, CX, CY), atol=1e-6)
