# SPDX-License-Identifier: Apache-2.0
"""Lenses and extrinsics of a stereo pair, from image pairs of a chessboard.

Chessboards: their inner corners in images, to a fraction of a pixel, and matching image files.
"""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.stereo_fit import Fit, fit_stereo, missed_pixels, refined
from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import MODELS, Lens
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import inverse

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


MIN_PAIRS = 3
"""Fewest usable image pairs."""
FAR_PX, FAR_TIMES = 0.5, 3.0
"""A pair is dropped if its RMS exceeds this and this many times the median of all pairs."""
FOLDS = 6
"""Number of parts of the pairs left out in turn, to see how well the rest predicts them."""
Names = tuple[str, Path, Path]
Shown = Callable[[list[Names]], Iterable[Names]]
Pixels = NDArray[np.float64]


@dataclass(eq=False)
class BoardPair:
    """One pair of images.

    left, right: (N, 2) pixels of the corners; None if no board was seen. why: the reason if it was dropped.
    rms_px: root mean square reprojection error of the corners, both images.
    epipolar_px: RMS difference of a corner's rows in both images after rectification; unseen_px: the same, from a
        calibration without this pair. NaN if it does not count.
    """

    name: str
    left_file: Path
    right_file: Path
    left: Pixels | None = None
    right: Pixels | None = None
    size: tuple[int, int] = (0, 0)
    why: str = ""
    rms_px: float = np.nan
    epipolar_px: float = np.nan
    unseen_px: float = np.nan

    def as_dict(self) -> dict[str, Any]:
        """Return the reported values, None if unknown."""
        told = {key: _finite_or_none(getattr(self, key)) for key in ("rms_px", "epipolar_px", "unseen_px")}
        return {"name": self.name, "used": not self.why, "why": self.why, **told}


@dataclass(frozen=True, eq=False)
class StereoCalibration:
    """Both lenses, the right eye's extrinsics, and the agreement of all pairs with them."""

    eyes: Eyes
    board: Board
    pairs: list[BoardPair] = field(repr=False)

    @property
    def used(self) -> list[BoardPair]:
        """The pairs used."""
        return [pair for pair in self.pairs if not pair.why]

    def overall(self, key: str) -> float:
        """Return the root mean square of `rms_px`, `epipolar_px` or `unseen_px` over the pairs used."""
        return float(np.sqrt(np.mean([getattr(pair, key) ** 2 for pair in self.used])))

    def as_dict(self) -> dict[str, Any]:
        """Return all figures for people and programs."""
        return {
            "lens": self.eyes.left.model,
            "pairs": [pair.as_dict() for pair in self.pairs],
            "used": len(self.used),
            **{key: _finite_or_none(self.overall(key)) for key in ("rms_px", "epipolar_px", "unseen_px")},
            "baseline_m": self.eyes.baseline,
            "field_of_view_deg": [field_of_view(lens) for lens in (self.eyes.left, self.eyes.right)],
        }


def calibrate_stereo(pairs: Iterable[BoardPair], board: Board, model: str = "pinhole") -> StereoCalibration:
    """Return the calibration of `model` lenses from the corners of all pairs; pairs that do not fit are dropped.

    Raises StereovoxError for an unknown model, or if fewer than three pairs are left.
    """
    check_model(model)
    pairs = list(pairs)
    fit = None
    while fit is None or _drop_worst(pairs):
        used = _usable(pairs)
        left, right = _corners(used)
        fit = fit_stereo(model, used[0].size, board.points(), left, right)
        _measure(used, fit, board)
    _predict(_usable(pairs), fit, board)
    return StereoCalibration(fit.eyes, board, pairs)


def check_model(model: str) -> None:
    """Raise StereovoxError for an unknown lens model."""
    if model not in MODELS:
        raise StereovoxError(f"--lens {model}: must be one of {', '.join(MODELS)}")


def read_boards(folder: str | Path, board: Board, shown: Shown = iter) -> list[BoardPair]:
    """Return the pairs of images in `folder` with their corners; pairs without are marked with the reason.

    shown: is given the list of pairs and yields them one by one; it may show progress.
    Raises StereovoxError if there is no pair at all.
    """
    pairs = [_with_corners(BoardPair(*names), board) for names in shown(image_pairs(folder))]
    sizes = [pair.size for pair in pairs if not pair.why]
    usual = max(set(sizes), key=sizes.count, default=(0, 0))
    for pair in pairs:
        if not pair.why and pair.size != usual:
            pair.why = f"{_format_size(pair.size)} pixels, most others have {_format_size(usual)}"
    return pairs


def epipolar_errors(eyes: Eyes, left: Pixels, right: Pixels) -> Pixels:
    """Return the row differences (N,) in pixels of points (N, 2) of both images after rectification.

    Rows are of a pinhole with the lenses' focal length; for fisheyes, uniform in angle, as for wide cameras.
    """
    focal = (eyes.left.fy + eyes.right.fy) / 2
    rays = [
        lens.directions(pixels) @ R
        for (lens, pixels), R in zip(((eyes.left, left), (eyes.right, right)), eyes.rectifying_rotations(), strict=True)
    ]
    if eyes.left.model == "fisheye":
        a, b = (np.arctan2(ray[:, 1], ray[:, 2]) for ray in rays)
    else:
        a, b = (ray[:, 1] / ray[:, 2] for ray in rays)
    return focal * (a - b)


def field_of_view(lens: Lens) -> tuple[float, float]:
    """Return a lens's field of view in degrees, horizontal and vertical, through the image's middle."""
    ends = [[-0.5, lens.cy], [lens.width - 0.5, lens.cy], [lens.cx, -0.5], [lens.cx, lens.height - 0.5]]
    off = np.degrees(np.nan_to_num(np.arccos(np.clip(lens.directions(ends)[:, 2], -1, 1)), nan=lens.widest))
    return float(off[0] + off[1]), float(off[2] + off[3])


def _with_corners(pair: BoardPair, board: Board) -> BoardPair:
    images = [read_grey(path) for path in (pair.left_file, pair.right_file)]
    for path, image in zip((pair.left_file, pair.right_file), images, strict=True):
        if image is None:
            pair.why = f"{path.name} cannot be read as an image"
            return pair
    left, right = (image for image in images if image is not None)
    pair.size = left.shape[1], left.shape[0]
    if left.shape != right.shape:
        pair.why = f"left {_format_size(pair.size)} pixels, right {right.shape[1]}x{right.shape[0]}"
        return pair
    pair.left, pair.right = find_corners(left, board), find_corners(right, board)
    blind = [path.name for path, found in ((pair.left_file, pair.left), (pair.right_file, pair.right)) if found is None]
    if pair.left is not None and pair.right is not None:
        pair.right = same_order(pair.right, pair.left)
    else:
        pair.why = f"no board of {board.columns}x{board.rows} inner corners in {' and '.join(blind)}"
    return pair


def _usable(pairs: Sequence[BoardPair]) -> list[BoardPair]:
    used = [pair for pair in pairs if not pair.why]
    if len(used) < MIN_PAIRS:
        reasons = "; ".join(f"{pair.name}: {pair.why}" for pair in pairs if pair.why)
        said = f" ({reasons})" if reasons else ""
        raise StereovoxError(f"only {len(used)} pairs of images are of use, {MIN_PAIRS} are needed{said}; take more")
    return used


def _corners(pairs: Sequence[BoardPair]) -> tuple[list[Pixels], list[Pixels]]:
    left = [pair.left for pair in pairs if pair.left is not None]
    return left, [pair.right for pair in pairs if pair.right is not None]


def _measure(used: Sequence[BoardPair], fit: Fit, board: Board) -> None:
    left, right = _corners(used)
    T_right = [inverse(fit.eyes.T_left_right) @ T for T in fit.T_left_board]
    ours = missed_pixels(fit.eyes.left, fit.T_left_board, board.points(), left)
    theirs = missed_pixels(fit.eyes.right, T_right, board.points(), right)
    for k, pair in enumerate(used):
        both = np.concatenate([ours[k], theirs[k]]).reshape(-1, 2)
        pair.rms_px = float(np.sqrt((both**2).sum(axis=1).mean()))
        pair.epipolar_px = _rms(epipolar_errors(fit.eyes, left[k], right[k]))


def _drop_worst(pairs: Sequence[BoardPair]) -> bool:
    """Drop the pair that fits worst, if it fits much worse than the others, and return whether there was one."""
    used = [pair for pair in pairs if not pair.why]
    worst, usual = max(used, key=lambda pair: pair.rms_px), float(np.median([pair.rms_px for pair in used]))
    if worst.rms_px <= max(FAR_PX, FAR_TIMES * usual):
        return False
    worst.why = f"corners missed by {worst.rms_px:.2f} px RMS, the others by about {usual:.2f}; did the board move?"
    return True


def _predict(used: Sequence[BoardPair], fit: Fit, board: Board) -> None:
    """Set each pair's row differences by a calibration without it."""
    if len(used) <= MIN_PAIRS:
        return
    left, right = _corners(used)
    for fold in range(min(FOLDS, len(used))):
        rest = [k for k in range(len(used)) if k % FOLDS != fold]
        if len(rest) < MIN_PAIRS:
            continue
        eyes = fit.eyes
        T, a, b = ([many[k] for k in rest] for many in (fit.T_left_board, left, right))
        without = refined(eyes.left, eyes.right, eyes.T_left_right, T, board.points(), a, b)
        for k in set(range(len(used))) - set(rest):
            used[k].unseen_px = _rms(epipolar_errors(without.eyes, left[k], right[k]))


def _finite_or_none(number: float) -> float | None:
    return float(number) if np.isfinite(number) else None


def _rms(numbers: Pixels) -> float:
    return float(np.sqrt(np.mean(numbers**2)))


def _format_size(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
