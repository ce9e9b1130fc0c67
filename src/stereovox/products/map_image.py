# SPDX-License-Identifier: Apache-2.0
"""The pictures of map_server maps: PGM by hand, all others by Pillow. Nothing is allocated for a header that lies."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError
from stereovox.untrusted import read_bounded

MOST_PIXELS = 1 << 28
MOST_BYTES = 1 << 31
"""Pictures of more pixels, and files of more bytes, are refused."""
WHITE = 255.0
FORMATS = ("PNG", "BMP", "PPM", "JPEG", "GIF")
PIXELS_A_BYTE = 512
PIXELS_OF_ANY = 1 << 22
"""A packed picture holds at most so many pixels for each byte of its file; one of few pixels may hold fewer bytes."""
_NUMBER = re.compile(rb"\s*(?:#[^\n\r]*[\n\r]\s*)*(\d{1,9})")


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture with its top row first; all arrays (height, width).

    brightness: uint8 or float64, mean of the colours, from 0 (black) to 255.
    see_through: bool, where it lets any background through; None: nowhere.
    with_opacity: float64, mean of the colours and the opacity; None where it knows no opacity.
    """

    brightness: NDArray[Any]
    see_through: NDArray[np.bool_] | None = None
    with_opacity: NDArray[np.float64] | None = None


def read_picture(path: Path) -> Picture:
    """Return the picture in a file. Raises MapFileError, one line: missing, damaged, too large or no picture."""
    try:
        if not path.is_file():
            raise MapFileError(f"{path}: no such picture; the map's .yaml names it as its image")
        if path.stat().st_size > MOST_BYTES:
            raise MapFileError(f"{path}: larger than {MOST_BYTES} bytes; no map is")
        with path.open("rb") as file:
            kind = file.read(2)
        return Picture(_read_pgm(path)) if kind in (b"P5", b"P2") else _read_other(path)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error})") from None


def write_pgm(file: IO[bytes], pixels: NDArray[np.uint8], comment: str) -> None:
    """Write (height, width) uint8 pixels as a binary PGM with one line of comment."""
    height, width = pixels.shape
    file.write(f"P5\n# {comment}\n{width} {height}\n255\n".encode())
    file.write(np.ascontiguousarray(pixels).data)


def write_png(file: IO[bytes], pixels: NDArray[np.uint8], opaque: NDArray[np.bool_] | None) -> None:
    """Write (height, width) uint8 grey pixels as a PNG; as RGBA, like nav2_map_server, where `opaque` is given."""
    from PIL import Image

    if opaque is not None:
        alpha = np.where(opaque, np.uint8(255), np.uint8(0))
        pixels = np.stack([pixels, pixels, pixels, alpha], axis=-1)
    Image.fromarray(np.ascontiguousarray(pixels)).save(file, "PNG", compress_level=1)


def _read_pgm(path: Path) -> NDArray[Any]:
    data = read_bounded(path, MOST_BYTES)
    numbers, at = [], 2
    for _ in range(3):
        found = _NUMBER.match(data, at)
        if not found:
            raise _damaged(path, "its header is no PGM's")
        numbers.append(int(found[1]))
        at = found.end()
    width, height, white = numbers
    _check_size(path, width, height)
    if not 0 < white < 65536:
        raise _damaged(path, f"its white is {white}")
    read = _words if data[:2] == b"P2" else _bytes
    pixels = read(data, at, width * height, white)
    if len(pixels) < width * height:
        raise _damaged(path, f"it holds no {width} x {height} pixels")
    pixels = pixels.reshape(height, width)
    return pixels if white == WHITE else np.minimum(pixels, white) * (WHITE / white)


def _bytes(data: bytes, at: int, count: int, white: int) -> NDArray[Any]:
    kind = np.dtype(np.uint8 if white < 256 else ">u2")
    there = max(len(data) - at - 1, 0) // kind.itemsize
    return np.frombuffer(data, kind, min(count, there), at + 1 if there else 0)


def _words(data: bytes, at: int, count: int, white: int) -> NDArray[Any]:
    text = re.sub(rb"#[^\n\r]*", b"", data[at:])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # what is no number, NumPy only warns of
        try:
            numbers = np.fromstring(text.decode("ascii"), np.int64, sep=" ")[:count]
        except (DeprecationWarning, ValueError):
            return np.empty(0)
    if (numbers < 0).any():
        return np.empty(0)
    return np.minimum(numbers, white).astype(np.uint8 if white < 256 else np.uint16)


def _read_other(path: Path) -> Picture:
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(path, formats=FORMATS) as image:
            _check_size(path, *image.size, most=max(PIXELS_OF_ANY, PIXELS_A_BYTE * path.stat().st_size))
            pixels = _channels(image)
    except MapFileError:
        raise
    except Exception as error:  # decoders raise anything: SyntaxError, struct.error, DecompressionBombError, ...
        raise _damaged(path, " ".join(str(error).replace(str(path), "it").split())[:200]) from None
    if pixels.ndim == 2:
        return Picture(pixels)
    if pixels.shape[2] == 3:
        return Picture(_mean(pixels))
    return Picture(_mean(pixels[..., :3]), pixels[..., 3] < WHITE, _mean(pixels))


def _mean(pixels: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the mean of the channels: NumPy's own takes five times as long."""
    total = pixels[..., 0].astype(np.uint16)
    for channel in range(1, pixels.shape[2]):
        total += pixels[..., channel]
    return total / pixels.shape[2]


def _channels(image: Any) -> NDArray[Any]:
    """Return grey (height, width), RGB (..., 3) or RGBA (..., 4), each from 0 to 255."""
    if image.mode.startswith("I"):
        return np.asarray(image).astype(float) * (WHITE / 65535)
    if image.mode in ("1", "L") and "transparency" not in image.info:
        return np.asarray(image.convert("L"))
    see_through = image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if see_through else "RGB"))


def _check_size(path: Path, width: int, height: int, most: int = MOST_PIXELS) -> None:
    if not (width > 0 and height > 0 and width * height <= min(most, MOST_PIXELS)):
        raise MapFileError(f"{path}: {width} x {height} pixels; a map has 1 to {min(most, MOST_PIXELS)}")


def _damaged(path: Path, why: str) -> MapFileError:
    return MapFileError(f"{path}: damaged or no picture ({why}); save the map anew")
