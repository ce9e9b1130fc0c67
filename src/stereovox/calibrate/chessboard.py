# SPDX-License-Identifier: Apache-2.0
"""Chessboards: their inner corners in images, to a fraction of a pixel, and matching image files."""

from __future__ import annotations

import os
import re
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError

ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm")
SIDES = re.compile(r"left|right|(?<![a-z])[lr](?![a-z])|[LR](?=[^A-Za-z]*$)", re.IGNORECASE)
"""Marks the eye in a file name without its ending: left01, cam_r_3, imageL0."""
WIDEST_WINDOW = 11
"""Pixels on each side of a corner used to refine it; fewer for small squares."""
MAX_PIXELS = 100_000_000
"""Headers that claim more pixels are rejected; nothing is allocated for them."""


@dataclass(frozen=True)
class Board:
    """A chessboard with `columns` by `rows` inner corners and squares of `square` metres.

    Raises StereovoxError for fewer than three corners a side and squares without a size.
    """

    columns: int
    rows: int
    square: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0 < self.square < 100:
            size = f"{self.columns}x{self.rows} corners of {self.square:g} m"
            raise StereovoxError(
                f"board {size}: count inner corners, at least 3x3, and give the square's side in metres"
            )

    def points(self) -> NDArray[np.float64]:
        """Return (N, 3) corners in metres in the board's frame (z = 0), row by row."""
        v, u = np.mgrid[: self.rows, : self.columns]
        return self.square * np.column_stack([u.ravel(), v.ravel(), np.zeros(u.size)])


def find_corners(image: NDArray[np.uint8], board: Board) -> NDArray[np.float64] | None:
    """Return the (N, 2) pixels of the board's inner corners in a grey image, row by row; None if missing."""
    import cv2

    size = (board.columns, board.rows)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    found, corners = cv2.findChessboardCorners(image, size, flags=flags)
    if not found:  # slower, but sees boards that are blurred, bent by the lens or partly in shadow
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_EXHAUSTIVE)
    if not found or corners is None or corners.size != 2 * board.columns * board.rows:
        return None
    rough = np.ascontiguousarray(corners.reshape(-1, 1, 2), np.float32)
    window = _window(rough.reshape(board.rows, board.columns, 2))
    until = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60, 1e-4)
    return np.asarray(cv2.cornerSubPix(image, rough, (window, window), (-1, -1), until), float).reshape(-1, 2)


def same_order(corners: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `corners` of one eye, reversed if the other eye's were found from the opposite end."""
    return corners if (corners[-1] - corners[0]) @ (other[-1] - other[0]) > 0 else corners[::-1]


def read_grey(path: Path) -> NDArray[np.uint8] | None:
    """Return the (height, width) uint8 image in `path`, None if OpenCV cannot read one."""
    import cv2
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as picture:  # reads the header alone
            if picture.width * picture.height > MAX_PIXELS:
                return None
        data = np.fromfile(path, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if data.size else None
    except Exception:  # Pillow's readers of headers raise anything
        return None
    return None if image is None else np.asarray(image, np.uint8)


def unmatched(folder: str | os.PathLike[str]) -> list[str]:
    """Return the names of the images in `folder` of one eye without a partner of the other."""
    eyes = _eyes(Path(folder))
    return sorted(
        path.name for ours, theirs in ("lr", "rl") for key, path in eyes[ours].items() if key not in eyes[theirs]
    )


def image_pairs(folder: str | os.PathLike[str]) -> list[tuple[str, Path, Path]]:
    """Return name, left file and right file of each pair in `folder`, in order of name.

    Both files have the same name in folders `left` and `right`, or differ only in `left` and `right` or L and R.
    Raises StereovoxError if there is no folder or no pair.
    """
    where = Path(folder)
    if not where.is_dir():
        raise StereovoxError(f"{folder}: no such folder; give the one with the images of the chessboard")
    eyes = _eyes(where)
    pairs = [(key, left, eyes["r"][key]) for key, left in eyes["l"].items() if key in eyes["r"]]
    if not pairs:
        raise StereovoxError(f"{folder}: holds no pair of images; name them left01.png and right01.png, and so on")
    return sorted(
        pairs, key=lambda pair: [int(word) if word.isdigit() else word for word in re.split(r"(\d+)", pair[0])]
    )


def _eyes(where: Path) -> dict[str, dict[str, Path]]:
    """Return, for `l` and `r`, the images of that eye by the common part of both names."""
    below = [where / "left", where / "right"]
    files = [path for place in (below if all(map(Path.is_dir, below)) else [where]) for path in sorted(place.iterdir())]
    eyes: dict[str, dict[str, Path]] = {"l": {}, "r": {}}
    for path in files:
        side, key = _side(path) if path.suffix.lower() in ENDINGS else ("", "")
        if side:
            eyes[side].setdefault(key, path)
    return eyes


def _side(path: Path) -> tuple[str, str]:
    """Return `l` or `r` and the part of the name common to both eyes; empty if it names no eye."""
    if path.parent.name in ("left", "right"):
        return path.parent.name[0], path.stem
    found = SIDES.search(path.stem)
    if found is None:
        return "", ""
    return found[0][0].lower(), f"{path.stem[: found.start()]}{path.stem[found.end() :]}"


def _window(grid: NDArray[np.float32]) -> int:
    """Return half the window for corners (rows, columns, 2): it must not reach the next corner."""
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    return int(np.clip(min(steps) / 2 - 1, 2, WIDEST_WINDOW))
