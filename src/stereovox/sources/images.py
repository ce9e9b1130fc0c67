# SPDX-License-Identifier: Apache-2.0
"""PNG images and folders of them; only intact files are decoded.

Decoders differ on damaged files: half an image, noise, or lines on the terminal from the C library. So the file's own
checksums are verified first (0.02 ms for 90 kB).
"""

from __future__ import annotations

import os
import struct
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import MAX_PIXELS
from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import Frame
from stereovox.safe_io import read_bounded
from stereovox.se3 import Transform
from stereovox.sources.base import DepthSource
from stereovox.sources.camera_file import Intrinsics, find_camera

SIGNATURE = b"\x89PNG\r\n\x1a\n"
START = SIGNATURE + b"\0\0\0\rIHDR"
HEADER_BYTES = 33  # signature, then IHDR: length, name, 13 bytes, check sum
MAX_BYTES = 1 << 28
"""Largest file: more than the most pixels can need."""
MAX_RATIO = 1100
"""Most bytes that one byte of a PNG can decompress to (deflate: 1032)."""
GREY_16 = (16, 0)  # bit depth and colour type
DEPTH_KINDS = frozenset({GREY_16})
PICTURE_KINDS = frozenset({(8, 0), (8, 2)})
"""Kinds of PNG that are read: 16-bit grey; 8-bit grey and RGB."""
EYE_KINDS = frozenset({GREY_16, (8, 0), (8, 2), (8, 6)})
"""Kinds of PNG that stereo cameras write: also 16-bit grey (TUM VI), and RGB with transparency."""
EXPECTED = {
    DEPTH_KINDS: "depth must be a 16-bit grey PNG",
    PICTURE_KINDS: "pictures must be 8-bit grey or RGB PNGs",
    EYE_KINDS: "pictures must be 8-bit grey or RGB, or 16-bit grey PNGs",
}
Kinds = frozenset[tuple[int, int]]


def read_depth_png(path: Path, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Return the (height, width) uint16 image in `path`, whose size must be (width, height) = `size`.

    Raises FrameRefused: `missing_file`; `unreadable` (no PNG, cut off, damaged, absurdly large); `bad_dtype`
    (not 16-bit grey); `bad_shape` (another size).
    """
    return decode_depth_png(path, _read(path), size)


def decode_depth_png(path: Path | str, data: bytes, size: tuple[int, int]) -> NDArray[np.uint16]:
    """Return the (height, width) uint16 image in the bytes of a PNG; `path` names it in messages.

    Raises FrameRefused as `read_depth_png`.
    """
    _check(path, data, size, DEPTH_KINDS)
    image = _decode(path, data)
    if image.dtype != np.uint16 or image.ndim != 2:
        raise _undecodable(path)
    return image.astype(np.uint16, copy=False)


def read_picture_png(path: Path, size: tuple[int, int], kinds: Kinds = PICTURE_KINDS) -> NDArray[np.uint8]:
    """Return the (height, width) uint8 grey or (height, width, 3) uint8 RGB image in `path`.

    Its size must be (width, height) = `size`. Where `kinds` allow them, images of 16 bits keep the upper eight, and
    transparency is ignored. Raises FrameRefused as `read_depth_png`; `bad_dtype`: of none of these kinds.
    """
    data = _read(path)
    _check(path, data, size, kinds)
    image = _decode(path, data)
    if GREY_16 in kinds and image.dtype == np.uint16:
        image = (image >> 8).astype(np.uint8)
    image = image[..., :3] if image.shape[2:] == (4,) else image
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)):
        raise _undecodable(path)
    return np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image, np.uint8)  # OpenCV gives BGR


def png_size(path: Path, kinds: Kinds = DEPTH_KINDS) -> tuple[int, int]:
    """Return (width, height) from the header of a PNG of these kinds; raises FrameRefused as `read_depth_png`."""
    return _header_size(path, _read(path, header_only=True), kinds)


def common_size(paths: Sequence[Path], samples: int = 5, kinds: Kinds = DEPTH_KINDS) -> tuple[int, int] | None:
    """Return the most frequent (width, height) of `samples` readable images spread over `paths`; None if none is
    readable.
    """
    found: Counter[tuple[int, int]] = Counter()
    for path in _spread(paths, samples):
        try:
            found[png_size(path, kinds)] += 1
        except FrameRefused:
            continue  # it is reported when its turn comes
        if found.total() == samples:
            break
    return found.most_common(1)[0][0] if found else None


class DepthFolder(DepthSource, ABC):
    """Frames from depth PNGs, one file each; an unusable file becomes a frame with a `fault`.

    A layout sets `depth_scale` (metres per unit), `baseline` (metres) and `intrinsics` (for 640x480 images without a
    calibration file), calls `_set_camera` in its constructor, and provides each frame's image and pose. The PNGs hold 0
    or 65535 for every pixel without value and no reason: all are UNKNOWN, none clears.
    """

    depth_scale: float
    baseline: float
    intrinsics: Intrinsics

    def __init__(self, where: str | os.PathLike[str]):
        self.folder = Path(where)
        self.name = self.folder.resolve().name

    @abstractmethod
    def image(self, i: int) -> tuple[Path, int]:
        """Return the image file of frame `i` (0 to len - 1) and its time in nanoseconds."""

    @abstractmethod
    def pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) of frame `i` (0 to len - 1); raises FrameRefused where there is none."""

    def frame(self, i: int) -> Frame:
        """Return frame `i`; depth is (0, 0) and the pose NaN where the frame has a `fault`."""
        i = range(len(self))[i]
        path, stamp_ns = self.image(i)
        try:
            T_world_camera = self.pose(i)
            depth = read_depth_png(path, (self.camera.width, self.camera.height))
        except FrameRefused as refused:
            no_depth, no_pose = np.empty((0, 0), np.uint16), np.full((4, 4), np.nan)
            blank = Frame(no_depth, self.camera, no_pose, stamp_ns, self.depth_scale, name=str(path))
            return replace(blank, fault=refused.reason, fault_detail=str(refused))
        return Frame(depth, self.camera, T_world_camera, stamp_ns, self.depth_scale, name=str(path))

    def _set_camera(self, *calibration_folders: Path) -> None:
        paths = [self.image(i)[0] for i in range(len(self))]
        size = common_size(paths)
        if size is None:
            raise SourceError(f"{self.folder}: none of its {len(paths)} depth images is a readable 16-bit grey PNG")
        self.camera, notes = find_camera(calibration_folders, size, self.baseline, self.intrinsics)
        self.notes = (*self.notes, *notes)


def file_names(folder: Path) -> list[str]:
    """Return the names of the entries of `folder`; raises SourceError where it cannot be listed."""
    try:
        return os.listdir(folder)
    except OSError as error:
        raise SourceError(f"{folder}: {error.strerror}; give a folder you may read") from None


def _spread(paths: Sequence[Path], samples: int) -> list[Path]:
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


def _check(path: Path | str, data: bytes, size: tuple[int, int], kinds: Kinds) -> None:
    """Raise FrameRefused unless `data` is a whole PNG of one of `kinds` and of this size."""
    found = _header_size(path, data, kinds)
    if found != size:
        raise FrameRefused(
            "bad_shape", f"{path}: {_format_size(found)} pixels, the recording has {_format_size(size)}; remove it"
        )
    if not _is_whole(data) or size[0] * size[1] > MAX_RATIO * len(data):
        raise FrameRefused("unreadable", f"{path}: the PNG is cut off or damaged; copy it again or remove it")


def _header_size(path: Path | str, data: bytes, kinds: Kinds) -> tuple[int, int]:
    header = data[12 : HEADER_BYTES - 4]
    if data[:16] != START or zlib.crc32(header) != int.from_bytes(data[HEADER_BYTES - 4 : HEADER_BYTES]):
        raise FrameRefused("unreadable", f"{path}: no PNG file, or its header is damaged; copy it again or remove it")
    width, height, bits, colour = struct.unpack_from(">IIBB", header, 4)
    if not 0 < width * height <= MAX_PIXELS:
        raise FrameRefused(
            "unreadable", f"{path}: its header tells of {_format_size((width, height))} pixels; remove it"
        )
    if (bits, colour) not in kinds:
        kind = "grey" if colour == 0 else "colour"
        raise FrameRefused("bad_dtype", f"{path}: {bits}-bit {kind} image; {EXPECTED[kinds]}")
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


def _format_size(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"
