# SPDX-License-Identifier: Apache-2.0
"""Images of a chessboard as known lenses see it, rendered pixel by pixel from their rays."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from stereovox.calibrate.stereo import Board
from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import Lens
from stereovox.geometry.se3 import Transform, inverse, rotation_matrix

BOARD = Board(7, 5, 0.04)
SUB = 2
"""Rays along each side of a pixel."""


def pinhole_eyes() -> Eyes:
    left = Lens("pinhole", 320, 240, 290.0, 291.5, 162.0, 117.0, (-0.22, 0.06, 0.0008, -0.0005))
    right = Lens("pinhole", 320, 240, 287.0, 288.0, 157.0, 121.0, (-0.19, 0.04, -0.0006, 0.0004))
    return Eyes(left, right, _apart())


def fisheye_eyes() -> Eyes:
    left = Lens("fisheye", 320, 240, 115.0, 115.6, 161.0, 118.0, (-0.02, 0.011, -0.008, 0.0014))
    right = Lens("fisheye", 320, 240, 114.0, 114.4, 158.5, 121.0, (-0.015, 0.008, -0.006, 0.001))
    return Eyes(left, right, _apart())


def poses(near: float, spread: float, count: int = 6) -> list[Transform]:
    """T_left_board: tilted boards round the image, at `near` metres and more, up to `spread` times that to a side."""
    rng = np.random.default_rng(5)
    made = []
    for k in range(count):
        T = np.eye(4)
        turn = 2 * np.pi * k / count
        T[:3, :3] = rotation_matrix([0.5 * np.cos(turn + 1), 0.5 * np.sin(turn + 1), rng.uniform(-0.2, 0.2)])
        place = np.array([spread * np.cos(turn), 0.7 * spread * np.sin(turn), 1]) * near * rng.uniform(1, 1.25)
        middle = 0.5 * BOARD.square * np.array([BOARD.columns - 1, BOARD.rows - 1, 0])
        T[:3, 3] = place + np.array([0.04, 0, 0]) - T[:3, :3] @ middle
        made.append(T)
    return made


def seen(lens: Lens, T_lens_board: Transform) -> np.ndarray:
    """The board on a white sheet, before grey."""
    T_board_lens = inverse(T_lens_board)
    rays = _rays(lens) @ T_board_lens[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        along = -T_board_lens[2, 3] / rays[:, 2]
    x, y = (T_board_lens[:2, 3, None] + along * rays[:, :2].T) / BOARD.square
    grey = np.where(along > 0, _paper(x, y), 120.0)
    return np.round(grey.reshape(SUB**2, lens.height, lens.width).mean(axis=0)).astype(np.uint8)


@lru_cache
def _rays(lens: Lens) -> np.ndarray:
    steps = (np.arange(SUB) + 0.5) / SUB - 0.5
    dv, du, v, u = np.meshgrid(steps, steps, np.arange(lens.height), np.arange(lens.width), indexing="ij")
    return lens.directions(np.column_stack([(u + du).ravel(), (v + dv).ravel()]))


def _paper(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    squares = (x > -1) & (x < BOARD.columns) & (y > -1) & (y < BOARD.rows)
    sheet = (x > -1.7) & (x < BOARD.columns + 0.7) & (y > -1.7) & (y < BOARD.rows + 0.7)
    black = squares & ((np.floor(np.nan_to_num(x)) + np.floor(np.nan_to_num(y))) % 2 == 0)
    return np.where(black, 25.0, np.where(sheet, 230.0, 120.0))


def write_boards(folder: Path, eyes: Eyes, boards: list[Transform]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for k, T in enumerate(boards):
        assert cv2.imwrite(str(folder / f"left{k:02d}.png"), seen(eyes.left, T))
        assert cv2.imwrite(str(folder / f"right{k:02d}.png"), seen(eyes.right, inverse(eyes.T_left_right) @ T))
    return folder


def _apart() -> Transform:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0.012, -0.04, 0.015]), (0.09, 0.002, -0.003)
    return T
