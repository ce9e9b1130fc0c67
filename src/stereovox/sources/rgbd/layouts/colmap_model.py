# SPDX-License-Identifier: Apache-2.0
"""Models of COLMAP: cameras, posed images and points, as text or binary files."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_LIST, read_bounded
from stereovox.geometry.se3 import Transform, from_quaternion, inverse

MODELS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
}  # fmt: skip
"""Camera models in the order of their numbers in binary files, and their numbers of parameters."""
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
READABLE = (*ONE_FOCAL, "PINHOLE", "OPENCV", "FULL_OPENCV")
LARGEST = 1e9
"""Bound of numbers in poses and pixels."""
UNDISTORT = "undistort its images first: colmap image_undistorter"


class ColmapCamera(NamedTuple):
    """A camera: (width, height); fx, fy, cx, cy in pixels, pixel centres at whole numbers; OpenCV's coefficients."""

    size: tuple[int, int]
    intrinsics: tuple[float, float, float, float]
    coefficients: tuple[float, ...]


class ColmapImage(NamedTuple):
    """A posed image.

    name: of its file. camera: number of its camera. T_world_camera: (4, 4) in the model's unit. pixels: (K, 2) columns
    and rows of its points, pixel centres at whole numbers. points: (K,) int64 their numbers.
    """

    name: str
    camera: int
    T_world_camera: Transform
    pixels: NDArray[np.float64]
    points: NDArray[np.int64]


class ColmapModel(NamedTuple):
    """Cameras by number, images in the order of the file, and points (3,) by number in the model's unit."""

    cameras: dict[int, ColmapCamera]
    images: list[ColmapImage]
    points: dict[int, NDArray[np.float64]]


def read_model(folder: Path) -> ColmapModel:
    """Read a model; binary files take precedence, as in COLMAP.

    Args:
        folder: Contains cameras, images and perhaps points3D, all `.bin` or all `.txt`.

    Returns:
        The model.

    Raises:
        SourceError: A file is missing or damaged, or a camera is not a (distorted) pinhole.
    """
    suffix = ".bin" if (folder / "images.bin").is_file() else ".txt"
    read = (_cameras_bin, _images_bin, _points_bin) if suffix == ".bin" else (_cameras_txt, _images_txt, _points_txt)
    paths = [folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D")]
    found: list[Any] = []
    for path, parse in zip(paths, read, strict=True):
        try:
            found.append(parse(path, read_bounded(path, MAX_LIST)))
        except FileNotFoundError:
            if path.stem != "points3D":
                raise SourceError(f"{path}: no such file; copy the whole model") from None
            found.append({})
        except OSError as error:
            raise SourceError(f"{path}: {error.strerror}; make it readable") from None
        except (ValueError, struct.error, IndexError, OverflowError) as error:
            if isinstance(error, SourceError):
                raise
            raise SourceError(f"{path}: is damaged ({str(error)[:80]}); export the model again") from None
    cameras, images, points = found
    for image in images:
        if image.camera not in cameras:
            raise SourceError(f"{paths[1]}: {image.name[:60]} is of camera {image.camera}, which {paths[0].name} lacks")
    return ColmapModel(cameras, images, points)


def _camera(path: Path, model: str, size: tuple[int, int], numbers: list[float]) -> ColmapCamera:
    if model not in READABLE or len(numbers) != MODELS[model]:
        raise SourceError(f"{path}: a {model[:40]} camera; {UNDISTORT}")
    if not np.isfinite(numbers).all() or min(size) <= 0:
        raise ValueError(f"a camera of {size[0]}x{size[1]} pixels, or NaN or infinity")
    fx, fy, cx, cy, *rest = [numbers[0], *numbers] if model in ONE_FOCAL else numbers
    return ColmapCamera(size, (fx, fy, cx - 0.5, cy - 0.5), tuple(rest))  # COLMAP's first pixel starts at 0


def _image(name: str, camera: int, seven: list[float], pixels: NDArray[np.float64], points: NDArray) -> ColmapImage:
    qw, qx, qy, qz, *t = seven
    if not max(map(abs, seven)) < LARGEST or max(map(abs, seven[:4])) < 1e-6:
        raise ValueError(f"{name[:60]} has no pose")
    T_world_camera = inverse(from_quaternion(t, (qx, qy, qz, qw)))
    seen = (points >= 0) & (np.abs(pixels) < LARGEST).all(1)
    return ColmapImage(name, camera, T_world_camera, pixels[seen] - 0.5, points[seen].astype(np.int64))


def _lines(content: bytes) -> list[str]:
    """Return all lines except comments; empty ones stay, as an image without points has an empty second line."""
    return [line for line in content.decode("utf-8", "replace").splitlines() if not line.lstrip().startswith("#")]


def _cameras_txt(path: Path, content: bytes) -> dict[int, ColmapCamera]:
    found = {}
    for line in filter(str.strip, _lines(content)):
        number, model, width, height, *numbers = line.split()
        found[int(number)] = _camera(path, model, (int(width), int(height)), [float(word) for word in numbers])
    return found


def _images_txt(path: Path, content: bytes) -> list[ColmapImage]:
    lines, found = iter(_lines(content)), []
    for line in lines:
        if not line.strip():
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise ValueError(f"'{line[:40]}' is not a line of an image")
        rows = np.array(next(lines, "").split(), float).reshape(-1, 3)
        seven = [float(word) for word in words[1:8]]
        found.append(_image(words[9], int(words[8]), seven, rows[:, :2], rows[:, 2]))
    return found


def _points_txt(path: Path, content: bytes) -> dict[int, NDArray[np.float64]]:
    rows = (line.split(maxsplit=4) for line in filter(str.strip, _lines(content)))
    return {int(row[0]): np.array(row[1:4], float) for row in rows if len(row) > 3}


def _cameras_bin(path: Path, content: bytes) -> dict[int, ColmapCamera]:
    found, at, names = {}, 8, list(MODELS)
    for _ in range(struct.unpack_from("<Q", content)[0]):
        number, model, width, height = struct.unpack_from("<iiQQ", content, at)
        name = names[model] if 0 <= model < len(names) else f"number {model}"
        numbers = struct.unpack_from(f"<{MODELS.get(name, 0)}d", content, at + 24)
        found[number] = _camera(path, name, (width, height), list(numbers))
        at += 24 + 8 * len(numbers)
    return found


def _images_bin(path: Path, content: bytes) -> list[ColmapImage]:
    found, at = [], 8
    kind = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
    for _ in range(struct.unpack_from("<Q", content)[0]):
        _, *seven, camera = struct.unpack_from("<i7di", content, at)
        end = content.index(b"\0", at + 64)
        count = struct.unpack_from("<Q", content, end + 1)[0]
        rows = np.frombuffer(content, kind, count, end + 9)
        name = content[at + 64 : end].decode("utf-8", "replace")
        found.append(_image(name, camera, seven, np.stack([rows["x"], rows["y"]], 1), rows["point"]))
        at = end + 9 + rows.nbytes
    return found


def _points_bin(path: Path, content: bytes) -> dict[int, NDArray[np.float64]]:
    return dict(_each_point(content))


def _each_point(content: bytes) -> Iterator[tuple[int, NDArray[np.float64]]]:
    at = 8
    for _ in range(struct.unpack_from("<Q", content)[0]):
        number, x, y, z = struct.unpack_from("<Q3d", content, at)
        yield number, np.array([x, y, z])
        at += 51 + 8 * struct.unpack_from("<Q", content, at + 43)[0]
