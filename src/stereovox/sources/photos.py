# SPDX-License-Identifier: Apache-2.0
"""Pictures taken with depth images: JPEG, PNG and the like, as grey images."""

from __future__ import annotations

import io
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import MAX_PIXELS, PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.files.safe_io import read_bounded
from stereovox.sources.images import MAX_BYTES, size_text

SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".bmp")
"""Suffixes of pictures, in lower case."""
FOLDERS = ("rgb", "color", "colour", "image", "images")
"""Folders of pictures next to one of depth images."""
ASPECT = 0.01
"""Largest relative difference of the aspect ratios of a picture and a depth image with the same view."""


def read_photo(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the picture in a file as a grey image (height, width) uint8; raises FrameRefused as `decode_photo`."""
    try:
        return decode_photo(read_bounded(path, MAX_BYTES), size, str(path))
    except OSError as error:
        raise FrameRefused("unreadable", f"{path}: {error.strerror}; put it back or remove its entry") from None


def decode_photo(data: bytes, size: tuple[int, int], name: str) -> NDArray[np.uint8]:
    """Return the picture in the bytes of a file as a grey image (height, width) uint8.

    Its size must be (width, height) = `size`; images of 16 bits keep the upper eight. `name` is used in messages.
    Raises FrameRefused: `unreadable`, `bad_shape`.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(data)) as image:
            if image.size != size:
                words = f"{size_text(image.size)} pixels, the recording has {size_text(size)}"
                raise FrameRefused("bad_shape", f"{name}: {words}; remove it")
            if image.mode.startswith("I"):
                return np.right_shift(np.asarray(image), 8).astype(np.uint8)
            image.draft("L", size)  # decode only the grey channel of a JPEG
            return np.asarray(image.convert("L"), np.uint8)
    except FrameRefused:  # it is also a ValueError
        raise
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise FrameRefused("unreadable", f"{name}: {str(error)[:80]}; copy it again or remove it") from None


def photo_size(path: Path) -> tuple[int, int] | None:
    """Return (width, height) of the picture in a file, None if it is not a readable picture."""
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path) as image:
            return image.size if 0 < image.size[0] * image.size[1] <= MAX_PIXELS else None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        return None


def registered(camera: PinholeCamera, size: tuple[int, int]) -> PinholeCamera | None:
    """Return the camera of pictures of (width, height) = `size` to which a depth camera's images are registered.

    None if the aspect ratio differs, because then the views differ.
    """
    if abs(size[0] * camera.height / (size[1] * camera.width) - 1) > ASPECT:
        return None
    across, down = size[0] / camera.width, size[1] / camera.height
    return replace(
        camera, width=size[0], height=size[1], fx=camera.fx * across, fy=camera.fy * down,
        cx=(camera.cx + 0.5) * across - 0.5, cy=(camera.cy + 0.5) * down - 0.5,
    )  # fmt: skip


def nearest_in_time(stamps_ns: Sequence[int], others_ns: Sequence[int], within_ns: int) -> list[int | None]:
    """Return for each time the index of the nearest other time, None if none is near enough."""
    order = np.argsort(others_ns, kind="stable")
    others, stamps = np.asarray(others_ns, np.int64)[order], np.asarray(stamps_ns, np.int64)
    if not len(others):
        return [None] * len(stamps)
    after = np.clip(np.searchsorted(others, stamps), 0, len(others) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(others[before] - stamps) <= np.abs(others[after] - stamps), before, after)
    near = np.abs(others[nearest] - stamps) <= within_ns
    return [int(order[k]) if good else None for k, good in zip(nearest, near, strict=True)]
