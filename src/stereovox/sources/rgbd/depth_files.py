# SPDX-License-Identifier: Apache-2.0
"""Depth images of the usual kinds of files, recognised by content: PNG, PGM, TIFF, PFM, OpenEXR, NumPy.

A PNG's checksums are verified before it is decoded (see `images`); the other kinds have none.

Confidence images next to depth images, as in ARKit: 0 low, 1 medium, 2 high. Conversion of depth images of a distorting
lens into those of a pinhole camera.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zipfile
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import MAX_PIXELS, PinholeCamera
from stereovox.errors import FrameRefused, MissingExtra
from stereovox.files.safe_io import read_bounded
from stereovox.sources.foreign_files import POINTER, POINTS
from stereovox.sources.photos import GREY_16, MAX_BYTES, SIGNATURE, decode_png, size_text, spread

SUFFIXES = (".png", ".pgm", ".tif", ".tiff", ".pfm", ".exr", ".npy", ".npz")
"""Suffixes of depth images, in lower case."""
PACKED_KINDS = frozenset({(8, 2), (8, 6)})
"""8-bit RGB and RGBA, whose bytes may encode depth."""
FLOAT_TOP = (58, 71)
"""Smallest and largest leading byte of float32 depths from 1 mm to 100 km (the sky of simulators)."""
CARLA_M, CARLA_MAX = 1000.0, 256**3 - 1
"""CARLA's depth camera: (R + 256 G + 65536 B) / (256^3 - 1) of 1000 m."""
COUNTS, FEWEST, ROUGH = 0.03, 20, 0.1
"""Required share of such neighbours in packed depth (photos have none), their minimum number, largest relative step."""
KIND = "depth must be a 16-bit grey PNG, PGM or TIFF, or floats (TIFF, PFM, EXR, NPY)"
COLMAP = re.compile(rb"(\d{1,6})&(\d{1,6})&1&")
"""Start of COLMAP's depth maps: columns, rows and channels; then float32 row by row."""
HEADER = re.compile(
    rb"(P5|P2|Pf)\s(?:\s|#[^\n]*\n)*(\d{1,6})(?:\s|#[^\n]*\n)+(\d{1,6})(?:\s|#[^\n]*\n)+(-?[\d.]{1,12})\s"
)
"""Kind, width, height, and largest value or, of a PFM, scale, whose sign is the order of bytes."""
Depth = NDArray[np.uint16] | NDArray[np.float32]


def read_depth(path: Path, size: tuple[int, int]) -> Depth:
    """Read a depth image.

    Args:
        path: The file.
        size: Required (width, height).

    Returns:
            (height, width) uint16, or float32 if the file has floats or larger integers; in the file's unit. Negative
            integers become 0, which is invalid.

    Raises:
        FrameRefused: `missing_file`; `unreadable` (cut off, damaged, absurdly large); `bad_dtype` (a picture);
            `bad_shape` (another size).
    """
    image = decode_depth(path, _read(path), size)
    found = image.shape[1], image.shape[0]
    if found != size:
        raise FrameRefused(
            "bad_shape", f"{path}: {size_text(found)} pixels, the recording has {size_text(size)}; remove it"
        )
    return image


def depth_size(path: Path) -> tuple[int, int]:
    """Return (width, height) of a depth image; raises FrameRefused as `read_depth`."""
    height, width = decode_depth(path, _read(path)).shape
    return width, height


def common_depth_size(paths: Sequence[Path], samples: int = 5) -> tuple[int, int] | str:
    """Return the most frequent (width, height) of readable images spread over `paths`.

    If none is readable: the fault of the first.
    """
    found: Counter[tuple[int, int]] = Counter()
    fault = "there is no image"
    for path in spread(paths, samples):
        try:
            found[depth_size(path)] += 1
        except FrameRefused as refused:
            fault = str(refused) if fault == "there is no image" else fault
        if found.total() == samples:
            break
    return found.most_common(1)[0][0] if found else fault


def decode_depth(path: Path, content: bytes, size: tuple[int, int] | None = None) -> Depth:
    """Return the depth image in the bytes of a file, as `read_depth` does; `path` names it in messages.

    size: required (width, height) of a PNG; None: any.
    """
    if content.startswith(SIGNATURE):
        return _depth(path, _png(path, content, size))
    if COLMAP.match(content):
        return _depth(path, _colmap(path, content))
    for start, decode in DECODERS.items():
        if content.startswith(start):
            return _depth(path, decode(path, content))
    if content.startswith(POINTER):
        raise FrameRefused("unreadable", f"{path}: {POINTS}")
    raise FrameRefused("unreadable", f"{path}: not a depth image of a known kind ({', '.join(SUFFIXES)})")


def _read(path: Path) -> bytes:
    if not os.path.isfile(path):  # Path.is_file may raise
        raise FrameRefused("missing_file", f"{path}: no such file; put it back or remove its entry")
    try:
        return read_bounded(path, MAX_BYTES)
    except OSError as error:
        raise FrameRefused("unreadable", f"{path}: {error.strerror}; make it readable or remove it") from None


def _depth(path: Path, image: NDArray[np.generic]) -> Depth:
    """Return the decoded array as a depth image; raises FrameRefused `bad_dtype` or `unreadable`."""
    image = image[..., 0] if image.ndim == 3 and image.shape[2] == 1 else image
    if image.ndim != 2 or image.dtype.kind not in "uif" or (image.dtype.kind in "ui" and image.dtype.itemsize == 1):
        what = f"{' x '.join(map(str, image.shape))} {image.dtype}"
        raise FrameRefused("bad_dtype", f"{path}: holds {what}; {KIND}")
    if not 0 < image.size <= MAX_PIXELS:
        raise FrameRefused("unreadable", f"{path}: {image.size} pixels; remove it")
    if image.dtype.kind in "ui" and image.max() <= np.iinfo(np.uint16).max:
        return np.ascontiguousarray(np.maximum(image, 0), np.uint16)
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(image, np.float32)


def _png(path: Path, content: bytes, size: tuple[int, int] | None) -> NDArray[np.generic]:
    image = decode_png(path, content, size, frozenset({GREY_16}) | PACKED_KINDS, KIND)
    return image if image.ndim == 2 else _unpacked(path, image.astype(np.uint8, copy=False))


def _unpacked(path: Path, image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return depths of a PNG that packs them into its bytes: float32 as RGBA, or CARLA's 24 bits.

    image: (height, width, 3 or 4) uint8 in the order B, G, R, A of OpenCV. Raises FrameRefused for a picture.
    """
    blue, green, red = (image[..., k].astype(np.uint32) for k in range(3))
    if image.shape[2] == 4:
        top = image[..., 3]
        used = top > 0
        if used.any() and np.mean((top[used] >= FLOAT_TOP[0]) & (top[used] <= FLOAT_TOP[1])) > 0.99:
            orders = [(blue, red), (red, blue)]  # OpenCV's (RTAB-Map), and that of programs that write R first
            made = [(low | green << 8 | high << 16 | top.astype(np.uint32) << 24) for low, high in orders]
            return min((bits.view(np.float32) for bits in made), key=_roughness)
    code = red + 256 * green + 65536 * blue
    if max(_counts_over(blue, green), _counts_over(green, red)) > COUNTS and _roughness(code) < ROUGH:
        return (code * (CARLA_M / CARLA_MAX)).astype(np.float32)
    raise FrameRefused("bad_dtype", f"{path}: is a colour picture; {KIND}")


def _roughness(depth: NDArray[np.generic]) -> float:
    """Return the median relative step from pixel to pixel."""
    values = np.asarray(depth, np.float64)
    step = np.abs(np.diff(values, axis=1)) / np.maximum(np.abs(values[:, 1:]), 1e-9)
    return float(np.nanmedian(step)) if step.size else 0.0


def _counts_over(high: NDArray[np.uint32], low: NDArray[np.uint32]) -> float:
    """Return the share of neighbours whose `high` bytes differ by one and whose `low` byte carries over, as in a
    number.

    0 if there are too few such neighbours.
    """
    found = []
    for axis in (0, 1):
        rise, fall = (np.diff(byte.astype(np.int32), axis=axis) for byte in (high, low))
        one = np.abs(rise) == 1
        found.append(fall[one] * rise[one] < -128)
    over = np.concatenate(found)
    return float(np.mean(over)) if len(over) >= FEWEST else 0.0


def _tiff(path: Path, content: bytes) -> NDArray[np.generic]:
    import cv2

    _check_pixels(path, _tiff_pixels(content))
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # or a damaged file prints on the terminal
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    if image is None:
        raise FrameRefused("unreadable", f"{path}: is cut off or damaged; copy it again or remove it")
    return image


def _tiff_pixels(content: bytes) -> int:
    """Return width times height times samples from the first directory of a TIFF; 0 if unreadable."""
    order: Literal["little", "big"] = "little" if content.startswith(b"II") else "big"
    start = int.from_bytes(content[4:8], order)
    told = {256: 0, 257: 0, 277: 1}  # width, height, samples
    for at in range(start + 2, start + 2 + 12 * int.from_bytes(content[start : start + 2], order), 12):
        tag, kind = (int.from_bytes(content[at + k : at + k + 2], order) for k in (0, 2))
        if tag in told:
            told[tag] = int.from_bytes(content[at + 8 : at + (10 if kind == 3 else 12)], order)
    return told[256] * told[257] * told[277]


def _check_pixels(path: Path, pixels: int) -> None:
    """Raise FrameRefused if a header declares no pixels, or more than are accepted."""
    if not 0 < pixels <= MAX_PIXELS:
        raise FrameRefused("unreadable", f"{path}: its header is damaged or declares {pixels} pixels; remove it")


def _netpbm(path: Path, content: bytes) -> NDArray[np.generic]:
    """Return the image of a PGM (P5 binary, P2 text) or grey PFM (Pf, its lowest row first).

    OpenCV would fill missing rows of a truncated file.
    """
    header = HEADER.match(content)
    if header is None:
        raise FrameRefused("unreadable", f"{path}: its header is damaged; copy it again or remove it")
    kind, (width, height), most = header[1], (int(header[2]), int(header[3])), float(header[4])
    if not 0 < width * height <= MAX_PIXELS or not 0 < abs(most) < 65536:
        raise FrameRefused("unreadable", f"{path}: its header declares {width}x{height} pixels; remove it")
    order = "<" if kind == b"Pf" and most < 0 else ">"
    dtype = np.dtype(f"{order}f4" if kind == b"Pf" else ">u2" if most > 255 else "u1")
    rest = content[header.end() :]
    if kind == b"P2":
        return _plain_pgm(path, rest, (height, width), dtype)
    if len(rest) < width * height * dtype.itemsize:
        raise FrameRefused("unreadable", f"{path}: is cut off; copy it again or remove it")
    image = np.frombuffer(rest, dtype, width * height).reshape(height, width)
    return (image[::-1] if kind == b"Pf" else image).astype(dtype.newbyteorder("="))


def _plain_pgm(path: Path, text: bytes, shape: tuple[int, int], dtype: np.dtype[np.generic]) -> NDArray[np.generic]:
    try:
        numbers = np.array(text.split(), np.int64)
    except (ValueError, OverflowError):
        numbers = np.empty(0, np.int64)
    if numbers.size != shape[0] * shape[1] or numbers.min() < 0 or numbers.max() > 65535:
        raise FrameRefused("unreadable", f"{path}: is cut off or damaged; copy it again or remove it")
    return numbers.reshape(shape).astype(dtype.newbyteorder("="))


def _colmap(path: Path, content: bytes) -> NDArray[np.float32]:
    """Return one of COLMAP's depth maps, in the unit of its poses."""
    start = COLMAP.match(content)
    width, height = (int(start[k]) for k in (1, 2)) if start else (0, 0)
    if start is None or len(content) - start.end() != 4 * width * height:
        raise FrameRefused("unreadable", f"{path}: is cut off or damaged; copy it again")
    return np.frombuffer(content, "<f4", offset=start.end()).reshape(height, width)


def _numpy(path: Path, content: bytes) -> NDArray[np.generic]:
    """Return the array of an `.npy`, or of an `.npz` with one array or one named `depth`."""
    try:
        if content.startswith(b"PK"):
            with zipfile.ZipFile(io.BytesIO(content)) as arrays:
                _check_pixels(path, max(1, max(array.file_size for array in arrays.infolist()) // 8))
        with np.errstate(all="ignore"):  # a damaged shape
            found = np.load(io.BytesIO(content), allow_pickle=False)
        if isinstance(found, np.ndarray):
            return _squeezed(found)
        name = "depth" if "depth" in found.files else found.files[0] if len(found.files) == 1 else ""
        return _squeezed(found[name])
    except FrameRefused:
        raise
    except Exception as error:  # a damaged file can raise anything in zipfile, zlib and NumPy
        why = " ".join(str(error).split())[:100]
        raise FrameRefused("unreadable", f"{path}: not an array of depths ({why}); save it again") from None


def _squeezed(array: NDArray[np.generic]) -> NDArray[np.generic]:
    """Return the array without axes of length one beyond the second."""
    axes = [axis for axis, length in enumerate(array.shape) if length == 1]
    return np.squeeze(array, tuple(axes[: max(array.ndim - 2, 0)]))


def _exr(path: Path, content: bytes) -> NDArray[np.generic]:
    """Return the depth channel of an OpenEXR image: Z or depth, else its only one or the first of equal ones."""
    try:
        import OpenEXR
    except ImportError:
        raise MissingExtra("OpenEXR", "exr") from None
    window = re.search(rb"dataWindow\0box2i\0\x10\0\0\0(.{16})", content, re.DOTALL)
    left, low, right, high = struct.unpack("<4i", window[1]) if window else (0, 0, -1, -1)
    _check_pixels(path, max(0, right - left + 1) * max(0, high - low + 1))
    try:
        with OpenEXR.File(os.fspath(path), separate_channels=True) as file:
            channels = {name: np.asarray(channel.pixels) for name, channel in file.channels().items()}
    except Exception as error:  # the library raises plain RuntimeError and more
        why = " ".join(str(error).split())[:100]
        raise FrameRefused("unreadable", f"{path}: not a readable OpenEXR image ({why})") from None
    named = next((name for name in channels if name.rpartition(".")[2].lower() in ("z", "depth", "y", "v")), None)
    first = channels[named or next(iter(channels))]
    if named is None and any(not np.array_equal(first, other, equal_nan=True) for other in channels.values()):
        raise FrameRefused("bad_dtype", f"{path}: its channels {', '.join(channels)} differ, none is Z; {KIND}")
    return first


DECODERS: dict[bytes, Callable[[Path, bytes], NDArray[np.generic]]] = {
    b"P5": _netpbm,
    b"P2": _netpbm,
    b"Pf": _netpbm,
    b"II*\0": _tiff,
    b"MM\0*": _tiff,
    b"\x76\x2f\x31\x01": _exr,
    b"\x93NUMPY": _numpy,
    b"PK\x03\x04": _numpy,
}
"""By the first bytes of a file; PNG is handled separately."""


KINDS = frozenset({(8, 0)})


def without_low(depth: Depth, path: Path, lowest: int) -> Depth:
    """Return a depth image with 0 where its confidence is less than `lowest`.

    Args:
        depth: (height, width) in any unit.
            path: 8-bit grey PNG of the same size, values growing with the confidence; without it all is kept.
            lowest: Smallest confidence that is kept.

        Returns:
            (height, width), of the same type; 0 is invalid.

    Raises:
        FrameRefused: `unreadable`, `bad_dtype` or `bad_shape` of the confidence image.
    """
    try:
        content = read_bounded(path, MAX_BYTES)
    except FileNotFoundError:
        return depth
    except OSError as error:
        raise FrameRefused("unreadable", f"{path}: {error.strerror}; make it readable or remove it") from None
    size = depth.shape[1], depth.shape[0]
    confidence = decode_png(path, content, size, KINDS, "confidence must be an 8-bit grey PNG")
    return np.where(confidence.astype(np.uint8) < lowest, depth.dtype.type(0), depth)


Image = TypeVar("Image", bound=NDArray[Any])

NEGLIGIBLE_PX = 0.5
"""Distortion of at most this is ignored."""


class Undistortion:
    """Moves the pixels of depth images to their positions in a pinhole camera with the same intrinsics.

    Each pixel takes the value of the nearest pixel of the distorted image, since depth must not be averaged across
    edges.

    Args:
        camera: The pinhole camera.
        coefficients: k1, k2, p1, p2, k3 and so on, in OpenCV's order.

    Attributes:
        moved_px: Largest displacement of a pixel; 0 if it is negligible, and then nothing is changed.
    """

    def __init__(self, camera: PinholeCamera, coefficients: Sequence[float]):
        self._maps: tuple[NDArray[Any], NDArray[Any]] | None = None
        self.moved_px = 0.0
        if not any(coefficients):
            return
        import cv2

        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        size = camera.width, camera.height
        columns, rows = cv2.initUndistortRectifyMap(K, np.array(coefficients), np.eye(3), K, size, cv2.CV_32FC1)
        v, u = np.mgrid[: camera.height, : camera.width]
        moved = float(np.hypot(columns - u, rows - v).max())
        if not moved <= NEGLIGIBLE_PX:
            self._maps, self.moved_px = (columns, rows), moved

    def __call__(self, image: Image) -> Image:
        """Return the undistorted image (height, width), 0 outside the distorted one."""
        if self._maps is None:
            return image
        import cv2

        return cast("Image", cv2.remap(image, *self._maps, cv2.INTER_NEAREST, borderValue=0))
