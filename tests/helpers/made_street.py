# SPDX-License-Identifier: Apache-2.0
"""Small KITTI recordings whose images really show the wall that the lidar sees, so that stereo finds it."""

from __future__ import annotations

from pathlib import Path

import made_kitti as made
import numpy as np
import pytest

SIZE = (256, 96)
F = 160.0
WALL_X = 15.07


def sharpen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Give the cameras of `made_kitti` images in which the wall has five pixels of disparity."""
    for name, value in {"SIZE": SIZE, "F": F, "CX": 127.5, "CY": 47.5}.items():
        monkeypatch.setattr(made, name, value)


def raw(folder: Path, count: int) -> Path:
    """Write a drive of KITTI raw data; return its folder."""
    drive = made.raw(folder, count)
    for eye in (0, 1):
        for n in range(count):
            made.write_picture(drive / f"image_{eye:02d}/data/{n:010d}.png", _view(n, eye))
    return drive


def tracking(folder: Path, count: int, sequence: str) -> Path:
    """Write a sequence of KITTI tracking, colour, with a labelled car; return its folder `training`."""
    training = made.tracking(folder, count, sequence)
    for eye in (2, 3):
        for n in range(count):
            grey = _view(n, eye)
            made.write_picture(training / f"image_{eye:02d}/{sequence}/{n:06d}.png", np.stack([grey] * 3, axis=-1))
    return training


def _view(n: int, eye: int) -> np.ndarray:
    """Return what an eye sees of an endless wall with a texture, (height, width) uint8."""
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    rays = np.stack([(u - made.CX) / F, (v - made.CY) / F, np.ones(u.shape)], axis=-1)
    T = made.cam0_pose(n)
    origin = T[:3, :3] @ [-made.OFFSETS[eye], 0, 0] + T[:3, 3]
    rays = rays @ T[:3, :3].T
    points = origin + rays * ((WALL_X - origin[0]) / rays[..., :1])
    return _texture(points[..., 1] / 0.25, points[..., 2] / 0.25)


def _texture(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return smooth noise: random values on a lattice, linear between."""
    lattice = np.random.default_rng(5).uniform(0, 255, (512, 512))
    i, j = np.floor(a).astype(int), np.floor(b).astype(int)
    x, y = a - i, b - j
    at = [[lattice[(i + di) % 512, (j + dj) % 512] for dj in (0, 1)] for di in (0, 1)]
    value = (at[0][0] * (1 - x) + at[1][0] * x) * (1 - y) + (at[0][1] * (1 - x) + at[1][1] * x) * y
    return value.astype(np.uint8)
