# SPDX-License-Identifier: Apache-2.0
"""The camera of a recording, from the small text files that lie beside it."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from stereovox.cameras import PinholeCamera
from stereovox.errors import SourceError, StereovoxError
from stereovox.sources.camera_file import FILE, pinhole, read_camera
from stereovox.untrusted import read_text

MATRIX, LIST = "camera-intrinsics.txt", "calibration.txt"
VGA = (640, 480)
Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in pixels."""


def find_camera(
    folders: Sequence[Path], size: tuple[int, int], baseline: float, default: Intrinsics
) -> tuple[PinholeCamera, tuple[str, ...]]:
    """Return the camera of images of (width, height) = `size`, and notes: what was assumed, used, or passed over.

    The first file found counts: `camera.toml` (see `camera_file`) in the first of `folders`, the recording's own; then
    `camera-intrinsics.txt` (3x3 matrix) and `calibration.txt` (fx fy cx cy), in the order of `folders`. Without one,
    640x480 images get `default`. `baseline` in metres, where the file tells none.
    Raises SourceError for a bad file, or where there is none and the images have another size.
    """
    places = [folders[0] / FILE, *(folder / name for folder in folders for name in (MATRIX, LIST))]
    found = [path for path in places if os.path.isfile(path)]  # Path.is_file may raise
    far = [folder / FILE for folder in folders[1:] if os.path.isfile(folder / FILE)]
    cure = "it counts only in the recording's own folder; give it with --camera"
    passed_over = [f"{path} is not used: {cure}" for path in far]
    passed_over += [f"{path} is not used: {found[0]} comes first" for path in found[1:]]
    if found:
        camera = _read(found[0], size, baseline)
        used = (f"{found[0]} is used ({correction_words(camera)})",) if found[0].name == FILE else ()
        return camera, (*used, *passed_over)
    if size != VGA:
        raise SourceError(
            f"{folders[0] / MATRIX}: no such file, and {size[0]}x{size[1]} images have no standard calibration; "
            "write the 3x3 camera matrix into it"
        )
    numbers = " ".join(f"{n:g}" for n in default)
    note = f"{folders[0]} has no {MATRIX}: assuming the data set's standard fx fy cx cy = {numbers}"
    return PinholeCamera(*size, *default, baseline), (note, *passed_over)


def correction_words(camera: PinholeCamera) -> str:
    """Return in words what the depth of a camera will be corrected by."""
    return f"depth correction '{camera.correction.model}'" if camera.correction else "no depth correction"


def read_intrinsics(path: Path) -> Intrinsics:
    """Return fx, fy, cx, cy in pixels from a 3x3 matrix or from these four numbers; `#` starts a comment.

    Raises SourceError naming the file for anything else, also for skew: such a camera is no plain pinhole.
    """
    numbers = _numbers(path)
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
    elif len(numbers) == 9 and numbers[6:] == [0, 0, 1] and numbers[1] == numbers[3] == 0:
        fx, _, cx, _, fy, cy, *_ = numbers
    else:
        raise SourceError(f"{path}: needs the matrix 'fx 0 cx / 0 fy cy / 0 0 1' or the four numbers fx fy cx cy")
    return fx, fy, cx, cy


def _read(path: Path, size: tuple[int, int], baseline: float) -> PinholeCamera:
    return _of_size(path, size, baseline) if path.name == FILE else _plain(path, size, baseline)


def _of_size(path: Path, size: tuple[int, int], baseline: float) -> PinholeCamera:
    camera = read_camera(path)
    if (camera.width, camera.height) != size:
        raise SourceError(
            f"{path}: is of a camera with {camera.width}x{camera.height} pixels, the images have {size[0]}x{size[1]}; "
            "replace or remove it"
        )
    return camera if camera.baseline else replace(camera, baseline=baseline)


def _numbers(path: Path) -> list[float]:
    try:
        lines = read_text(path).splitlines()
        numbers = [float(word) for line in lines for word in line.partition("#")[0].replace(",", " ").split()]
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    except ValueError as error:
        raise SourceError(f"{path}: {error}; write plain numbers") from None
    if not all(map(math.isfinite, numbers)):
        raise SourceError(f"{path}: holds NaN or infinity; write plain numbers")
    return numbers


def _plain(path: Path, size: tuple[int, int], baseline: float) -> PinholeCamera:
    intrinsics = read_intrinsics(path)
    try:
        return pinhole(size, intrinsics, baseline)
    except StereovoxError as error:
        raise SourceError(f"{path}: {error}") from None
