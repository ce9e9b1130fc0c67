# SPDX-License-Identifier: Apache-2.0
"""Pictures taken with depth images: JPEG, PNG and the like, as grey images.

PNG images and folders of them; only intact files are decoded.

Decoders differ on damaged files: half an image, noise, or output of the C library on the terminal. So the file's own
checksums are verified first (0.02 ms for 90 kB).
"""

from __future__ import annotations

import io
import os
import struct
import warnings
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import MAX_PIXELS, PinholeCamera
from stereovox.errors import FrameRefused, SourceError
from stereovox.files.safe_io import read_bounded

SIGNATURE = b"\x89PNG\r\n\x1a\n"
START = SIGNATURE + b"\0\0\0\rIHDR"
HEADER_BYTES = 33  # signature, then IHDR: length, name, 13 bytes, checksum
MAX_BYTES = 1 << 28
"""Largest file: more than the largest image can need."""
MAX_RATIO = 1100
"""Most bytes that one byte of a PNG can decompress to (deflate: 1032)."""
GREY_16 = (16, 0)  # bit depth and colour type
DEPTH_KINDS = frozenset({GREY_16})
PICTURE_KINDS = frozenset({(8, 0), (8, 2)})
"""Supported kinds of PNG: 16-bit grey; 8-bit grey and RGB."""
EYE_KINDS = frozenset({GREY_16, (8, 0), (8, 2), (8, 6)})
"""Kinds of PNG that stereo cameras write: also 16-bit grey (TUM VI), and RGB with transparency."""
EXPECTED = {
    DEPTH_KINDS: "depth must be a 16-bit grey PNG",
    PICTURE_KINDS: "pictures must be 8-bit grey or RGB PNGs",
    EYE_KINDS: "pictures must be 8-bit grey or RGB, or 16-bit grey PNGs",
}
Kinds = frozenset[tuple[int, int]]


def decode_depth_png(path: Path | str, data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Return the (height, width) uint16 image in the bytes of a PNG; `path` names it in messages.

    Its size must be (width, height) = `size`. Raises FrameRefused: `missing_file`; `unreadable` (not a PNG, cut off,
    damaged, absurdly large); `bad_dtype` (not 16-bit grey); `bad_shape` (another size).
    """
    _check(path, data, size, DEPTH_KINDS)
    image = _decode(path, data)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise _undecodable(path)
    return image.astype(np.uint16, copy=False)


def decode_rvl(path: Path | str, data: bytes, size: tuple[int, int] | None = None) -> NDArray[np.uint16]:
    """Return the (height, width) uint16 image packed as RVL, after its columns and rows as uint32.

    size: required (width, height); None: any. Raises FrameRefused as `decode_depth_png`.
    """
    from stereovox.sources._rvl import unpack

    if len(data) < 8:
        raise FrameRefused("unreadable", f"{path}: is cut off or damaged; leave it out")
    width, height = found = struct.unpack_from("<2I", data)
    if size is not None and found != size:
        raise FrameRefused("bad_shape", f"{path}: {size_text(found)} pixels, its camera has {size_text(size)}")
    if size is None and not 0 < width * height <= min(MAX_PIXELS, 1000 * len(data)):
        raise FrameRefused("unreadable", f"{path}: is damaged; leave it out")
    depth = np.empty(width * height, np.uint16)
    if unpack(np.frombuffer(data, "<u4", (len(data) - 8) // 4, 8), depth) != depth.size:
        raise FrameRefused("unreadable", f"{path}: is cut off or damaged; leave it out")
    return depth.reshape(height, width)


def decode_png(
    path: Path | str, data: bytes, size: tuple[int, int] | None, kinds: Kinds, expected: str = ""
) -> NDArray[np.generic]:
    """Return the image in the bytes of a PNG of one of `kinds`, as OpenCV gives it; `path` names it in messages.

    size: required (width, height); None: any. expected: supported kinds, for the message.
    Raises FrameRefused as `decode_depth_png`.
    """
    _check(path, data, size or header_size(path, data, kinds, expected), kinds, expected)
    return _decode(path, data)


def read_picture_png(path: Path, size: tuple[int, int], kinds: Kinds = PICTURE_KINDS) -> NDArray[np.uint8]:
    """Return the (height, width) uint8 grey or (height, width, 3) uint8 RGB image in `path`.

    Its size must be (width, height) = `size`. If `kinds` allow them, images of 16 bits keep the upper eight, and
    transparency is ignored. Raises FrameRefused as `decode_depth_png`; `bad_dtype`: none of these kinds.
    """
    data = _read(path)
    _check(path, data, size, kinds)
    image = _decode(path, data)
    if GREY_16 in kinds and image.dtype == np.uint16:
        image = np.right_shift(image.astype(np.uint16, copy=False), 8).astype(np.uint8)
    image = image[..., :3] if image.shape[2:] == (4,) else image
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)):
        raise _undecodable(path)
    return np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image, np.uint8)  # OpenCV returns BGR


def png_size(path: Path, kinds: Kinds = DEPTH_KINDS) -> tuple[int, int]:
    """Return (width, height) from the header of a PNG of these kinds; raises FrameRefused as `decode_depth_png`."""
    return header_size(path, _read(path, header_only=True), kinds)


def common_size(paths: Sequence[Path], samples: int = 5, kinds: Kinds = DEPTH_KINDS) -> tuple[int, int] | None:
    """Return the most frequent (width, height) of `samples` readable images spread over `paths`; None if none is
    readable.
    """
    found: Counter[tuple[int, int]] = Counter()
    for path in spread(paths, samples):
        try:
            found[png_size(path, kinds)] += 1
        except FrameRefused:
            continue  # reported when it is read
        if found.total() == samples:
            break
    return found.most_common(1)[0][0] if found else None


def file_names(folder: Path) -> list[str]:
    """Return the names of the entries of `folder`; raises SourceError if it cannot be listed."""
    try:
        return os.listdir(folder)
    except OSError as error:
        raise SourceError(f"{folder}: {error.strerror}; give a readable folder") from None


def spread(paths: Sequence[Path], samples: int) -> list[Path]:
    """Return all paths, beginning with evenly spaced ones."""
    step = max(1, len(paths) // samples)
    return [path for start in range(step) for path in paths[start::step]]


def _read(path: Path, header_only: bool = False) -> bytes:
    if not os.path.isfile(path):  # Path.is_file may raise
        raise FrameRefused("missing_file", f"{path}: no such file; put it back or remove its entry")
    try:
        if not header_only:
            return read_bounded(path, MAX_BYTES)
        with path.open("rb") as file:
            return file.read(HEADER_BYTES)
    except OSError as error:
        raise FrameRefused("unreadable", f"{path}: {error.strerror}; make it readable or remove it") from None


def _check(path: Path | str, data: bytes, size: tuple[int, int], kinds: Kinds, expected: str = "") -> None:
    """Raise FrameRefused unless `data` is a whole PNG of one of `kinds` and of this size."""
    found = header_size(path, data, kinds, expected)
    if found != size:
        raise FrameRefused(
            "bad_shape", f"{path}: {size_text(found)} pixels, the recording has {size_text(size)}; remove it"
        )
    if not _is_whole(data) or size[0] * size[1] > MAX_RATIO * len(data):
        raise FrameRefused("unreadable", f"{path}: the PNG is cut off or damaged; copy it again or remove it")


def header_size(path: Path | str, data: bytes, kinds: Kinds, expected: str = "") -> tuple[int, int]:
    """Return (width, height) from the first bytes of a PNG; raises FrameRefused as `decode_depth_png`."""
    header = data[12 : HEADER_BYTES - 4]
    if data[:16] != START or zlib.crc32(header) != int.from_bytes(data[HEADER_BYTES - 4 : HEADER_BYTES]):
        raise FrameRefused("unreadable", f"{path}: not a PNG, or its header is damaged; copy it again or remove it")
    width, height, bits, colour = struct.unpack_from(">IIBB", header, 4)
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameRefused("unreadable", f"{path}: its header declares {size_text((width, height))} pixels; remove it")
    if (bits, colour) not in kinds:
        kind = "grey" if colour == 0 else "colour"
        raise FrameRefused("bad_dtype", f"{path}: {bits}-bit {kind} image; {expected or EXPECTED[kinds]}")
    return width, height


def _is_whole(data: bytes) -> bool:
    """Return whether every chunk up to the end mark is present and has the right checksum."""
    view, at, kind = memoryview(data), len(SIGNATURE), b""
    while kind != b"IEND":
        if at + 12 > len(data):
            return False
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data) or zlib.crc32(view[at + 4 : end]) != int.from_bytes(view[end : end + 4]):
            return False
        at = end + 4
    return True


def _decode(path: Path | str, data: bytes) -> NDArray[np.generic]:
    import cv2

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise _undecodable(path)
    return image


def _undecodable(path: Path | str) -> FrameRefused:
    return FrameRefused("unreadable", f"{path}: OpenCV cannot decode it; write it again as a plain PNG")


def size_text(size: tuple[int, int]) -> str:
    """Return (width, height) as text."""
    return f"{size[0]}x{size[1]}"


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
