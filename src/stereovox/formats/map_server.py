# SPDX-License-Identifier: Apache-2.0
"""Maps of ROS's map_server and nav2_map_server: an image, and a .yaml that explains it."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import MapFileError, StereovoxError, did_you_mean
from stereovox.files.safe_io import MAX_YAML, read_bounded, replacing, shown, yaml_value
from stereovox.maps import VoxelMap
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.voxel_map import State
from stereovox.products.floor_axes import Heights
from stereovox.products.floor_heights import FloorHeights
from stereovox.products.projection import inflated_grid, project

MODES = ("trinary", "scale", "raw")
NEEDED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
MAX_PIXELS = 1 << 28
MAX_BYTES = 1 << 31
"""Larger images, in pixels or bytes, are refused."""
WHITE = 255.0
FORMATS = ("PNG", "BMP", "PPM", "JPEG", "GIF")
PIXELS_A_BYTE = 512
PIXELS_OF_ANY = 1 << 22
"""Most pixels of a compressed image per byte of its file; small images may exceed it."""
_NUMBER = re.compile(rb"\s*(?:#[^\n\r]*[\n\r]\s*)*(\d{1,9})")
OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
"""Values that map_saver writes. With nav2's free_thresh of 0.25, its own grey 205, unknown, would be read as free."""
FREE_PIXEL, UNKNOWN_PIXEL, OCCUPIED_PIXEL, NO_PIXEL = 254, 205, 0, 128
MANY_UNKNOWN = 0.01
"""Share of pixels with the grey of unknown cells that is no chance."""
SCALE_STEPS = 254
"""Grey levels of mode scale between 0 and 99 per cent: each per cent is read back unchanged."""


def read_map_server(path: str | Path) -> OccupancyGrid:
    """Return the map of a .yaml `path`, or of the .yaml next to `path` if that is its picture.

    With p = (255 - brightness) / 255, or brightness / 255 if `negate` is set, cells are, by mode:
    trinary: 100 if p > occupied_thresh, 0 if p < free_thresh, else -1; opacity counts as one more colour.
    scale: the same, but between them 99 (p - free_thresh) / (occupied_thresh - free_thresh) rounded down, and -1
    for transparent pixels.
    raw: the brightness, rounded down, if that is 0 to 100, else -1. The map's thresholds are then the file's.
    (map_server 1.17, image_loader.cpp. nav2_map_server scales by 100 and rounds, and negates no raw maps.)
    If that makes the grey of unknown cells free, as in map_server, the map's `note` says so.
    Raises MapFileError: one line with the file and the problem.
    """
    metadata = metadata_of(path)
    picture = read_picture(metadata.image)
    found = _cells(picture, metadata)
    cells = np.ascontiguousarray(found[::-1])
    if metadata.mode != "raw":
        return OccupancyGrid(cells, metadata.resolution, metadata.origin, note=_note(picture, found, metadata))
    return OccupancyGrid(cells, metadata.resolution, metadata.origin, metadata.free_thresh, metadata.occupied_thresh)


def metadata_of(path: str | Path) -> Metadata:
    """Return the contents of the .yaml `path`, or of the .yaml next to `path` if that is a picture.

    Raises MapFileError for anything invalid.
    """
    return read_metadata(_yaml_of(Path(path)))


def write_map_server(grid: OccupancyGrid, path: str | Path, mode: str = "trinary", negate: bool = False) -> None:
    """Write an image and its .yaml; `path` names either (a .yaml's image is a .pgm, a scaled one a .png).

    Both or neither: after a power failure the .yaml still names an image that belongs to it, perhaps one with a
    temporary name.

    trinary: free cells 254, occupied ones 0, all others 205, which are unknown. scale: per cent as greys, unknown cells
    are transparent and need a .png. raw: per cent as they are, unknown 255; the thresholds are the map's own. Scaled
    and raw maps are read back exactly. negate: white is occupied. Raises MapFileError for an empty map, an unknown
    mode or ending, or an unwritable path.
    """
    yaml, image = _files(Path(path), mode)
    png = image.suffix.lower() == ".png"
    _check(grid, image, mode, negate)
    greys, occupied, free = _greys(grid, mode)
    shown = np.ascontiguousarray(grid.cells[::-1])
    pixels = _through(255 - greys if negate else greys, shown)
    opaque = shown >= 0 if mode == "scale" else None
    spare = image.with_name(f".{image.name}")
    # Renamed from the last to the first: so at any moment the .yaml names its own picture.
    with (
        replacing(yaml) as text,
        replacing(image) as picture,
        replacing(yaml) as text_between,
        replacing(spare) as picture_between,
    ):
        for file, name in ((text, image), (text_between, spare)):
            file.write(Metadata(name, grid.resolution, grid.origin, negate, occupied, free, mode).text().encode())
        for file in (picture, picture_between):
            if png:
                write_png(file, pixels, opaque)
            else:
                write_pgm(file, pixels, f"CREATOR: stereovox {grid.resolution:.3f} m/pix")
        for file in (text, picture, text_between):
            file.flush()  # a full disk shows before the first of them is renamed
    spare.unlink(missing_ok=True)


def write_grid(
    voxel_map: VoxelMap,
    path: str | Path,
    heights: Heights | None = None,
    inflate: float | None = None,
    floor: FloorHeights | float | None = None,
    start: ArrayLike | None = None,
) -> None:
    """Write the map seen from above as map_server's two files, an image and its .yaml; `path` names either.

    heights, floor, start: see `project`. inflate: radius of a robot in metres by which obstacles grow, with a
    margin of one cell.
    Raises StereovoxError as `project`, `inflated_grid` and `write_map_server` do.
    """
    try:
        grid = project(voxel_map, heights, floor, start)
        grid = grid if inflate is None else inflated_grid(grid, inflate)
    except StereovoxError as error:
        raise StereovoxError(f"{path}: {error}") from None
    write_map_server(grid, path)


@dataclass(frozen=True)
class Metadata:
    """The contents of a map's .yaml.

    image: the picture. resolution: side of a cell in metres. origin: x, y in metres and yaw of its lower left corner.
    negate: white is occupied. occupied_thresh, free_thresh: probabilities. mode: one of MODES.
    """

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: str

    def text(self) -> str:
        """Return the YAML text."""
        origin = ", ".join(map(_plain, self.origin))
        return (
            f"image: {_quoted(self.image.name)}\nmode: {self.mode}\nresolution: {_plain(self.resolution)}\n"
            f"origin: [{origin}]\nnegate: {int(self.negate)}\n"
            f"occupied_thresh: {_plain(self.occupied_thresh)}\nfree_thresh: {_plain(self.free_thresh)}\n"
        )


def read_metadata(path: Path) -> Metadata:
    """Read the .yaml `path`; `image` is relative to it. Raises MapFileError for anything invalid."""
    try:
        if path.is_dir():
            raise MapFileError(
                f"{path}: not a map of a floor; make one from a map in space: stereovox export {path} floor.yaml"
            )
        if not path.is_file():
            raise MapFileError(f"{path}: no such file; give the .yaml of a map_server map")
        fields: Any = yaml_value(read_bounded(path, MAX_YAML))
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error})") from None
    except MapFileError:
        raise
    except ValueError as error:
        raise MapFileError(f"{path}: is not YAML ({str(error)[:200]})") from None
    if not isinstance(fields, dict) or not any(name in fields for name in NEEDED):
        raise MapFileError(f"{path}: is not the .yaml of a map_server map")
    return _checked(path, fields)


@dataclass(frozen=True, eq=False)
class Picture:
    """An image with its top row first; all arrays (height, width).

    brightness: uint8 or float64, mean of the colours, from 0 (black) to 255. see_through: bool, transparent
    pixels; None: none. with_opacity: float64, mean of the colours and the opacity; None without opacity.
    """

    brightness: NDArray[Any]
    see_through: NDArray[np.bool_] | None = None
    with_opacity: NDArray[np.float64] | None = None


def read_picture(path: Path) -> Picture:
    """Return the picture in a file. Raises MapFileError if it is missing, damaged, too large or not a picture."""
    try:
        if not path.is_file():
            raise MapFileError(f"{path}: no such picture; the map's .yaml names it as its image")
        if path.stat().st_size > MAX_BYTES:
            raise MapFileError(f"{path}: larger than {MAX_BYTES} bytes, too large for a map")
        with path.open("rb") as file:
            kind = file.read(2)
        return Picture(_read_pgm(path)) if kind in (b"P5", b"P2") else _read_with_pillow(path)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error})") from None


def write_pgm(file: IO[bytes], pixels: NDArray[np.uint8], comment: str) -> None:
    """Write (height, width) uint8 pixels as a binary PGM with one line of comment."""
    height, width = pixels.shape
    file.write(f"P5\n# {comment}\n{width} {height}\n255\n".encode())
    file.write(np.ascontiguousarray(pixels).data)


def write_png(file: IO[bytes], pixels: NDArray[np.uint8], opaque: NDArray[np.bool_] | None) -> None:
    """Write (height, width) uint8 grey pixels as a PNG; as RGBA, like nav2_map_server, if `opaque` is given."""
    from PIL import Image

    if opaque is not None:
        alpha = np.where(opaque, np.uint8(255), np.uint8(0))
        pixels = np.stack([pixels, pixels, pixels, alpha], axis=-1)
    Image.fromarray(np.ascontiguousarray(pixels)).save(file, "PNG", compress_level=1)


def _checked(path: Path, fields: dict[Any, Any]) -> Metadata:
    missing = [name for name in NEEDED if name not in fields]
    if missing:
        raise MapFileError(f"{path}: has no '{missing[0]}', which the .yaml of a map_server map needs")
    mode, origin, image = fields.get("mode", MODES[0]), fields["origin"], fields["image"]
    if mode not in MODES:
        raise MapFileError(f"{path}: mode '{mode}'{did_you_mean(str(mode), MODES)}")
    if not isinstance(origin, list) or len(origin) != 3:
        raise MapFileError(f"{path}: origin {shown(origin)}; give [x, y, yaw]")
    if not isinstance(image, str) or not image or "\0" in image:
        raise MapFileError(f"{path}: image {shown(image)}; give the name of the picture")
    x, y, yaw = (_number(path, "origin", number) for number in origin)
    resolution, occupied, free, negate = (
        _number(path, name, fields[name]) for name in ("resolution", "occupied_thresh", "free_thresh", "negate")
    )
    if not resolution > 0:
        raise MapFileError(f"{path}: resolution {resolution:g}; cells have a side above 0 metres")
    if not 0 <= free < occupied <= 1:
        raise MapFileError(f"{path}: free_thresh {free:g} and occupied_thresh {occupied:g} must rise, from 0 to 1")
    return Metadata(_image_of(path, image), resolution, (x, y, yaw), bool(negate), occupied, free, str(mode))


def _image_of(path: Path, image: str) -> Path:
    """Return the picture that a .yaml names, or that of the same name next to it if both were copied from elsewhere."""
    named, beside = path.parent / image, path.parent / re.split(r"[/\\]", image)[-1]
    return beside if not named.is_file() and beside.is_file() else named


def _number(path: Path, name: str, value: Any) -> float:
    try:
        number = float(value)  # strings too: YAML parses 1e-5 as one
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not np.isfinite(number):
        raise MapFileError(f"{path}: {name} {shown(value)} is not a number")
    return number


def _plain(number: float) -> str:
    """Return a number in full and without exponent, which YAML would parse as a string."""
    return np.format_float_positional(float(number), trim="0")


def _quoted(name: str) -> str:
    """Return any file name as a YAML string."""
    import yaml

    return yaml.safe_dump(name, allow_unicode=True, width=10**6).removesuffix("\n").removesuffix("\n...")


def _read_pgm(path: Path) -> NDArray[Any]:
    data = read_bounded(path, MAX_BYTES)
    numbers, at = [], 2
    for _ in range(3):
        found = _NUMBER.match(data, at)
        if not found:
            raise _damaged(path, "its header is not a PGM's")
        numbers.append(int(found[1]))
        at = found.end()
    width, height, white = numbers
    _check_size(path, width, height)
    if not 0 < white < 65536:
        raise _damaged(path, f"its white is {white}")
    read = _words if data[:2] == b"P2" else _bytes
    pixels = read(data, at, width * height, white)
    if len(pixels) < width * height:
        raise _damaged(path, f"it has fewer than {width} x {height} pixels")
    pixels = pixels.reshape(height, width)
    return pixels if white == WHITE else np.minimum(pixels, white) * (WHITE / white)


def _bytes(data: bytes, at: int, count: int, white: int) -> NDArray[Any]:
    kind = np.dtype(np.uint8 if white < 256 else ">u2")
    there = max(len(data) - at - 1, 0) // kind.itemsize
    return np.frombuffer(data, kind, min(count, there), at + 1 if there else 0)


def _words(data: bytes, at: int, count: int, white: int) -> NDArray[Any]:
    text = re.sub(rb"#[^\n\r]*", b"", data[at:])
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # NumPy only warns of invalid numbers
        try:
            numbers = np.fromstring(text.decode("ascii"), np.int64, sep=" ")[:count]
        except (DeprecationWarning, ValueError):
            return np.empty(0)
    if (numbers < 0).any():
        return np.empty(0)
    return np.minimum(numbers, white).astype(np.uint8 if white < 256 else np.uint16)


def _read_with_pillow(path: Path) -> Picture:
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
    """Return the mean of the channels; NumPy's own is five times slower."""
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


def _check_size(path: Path, width: int, height: int, most: int = MAX_PIXELS) -> None:
    if not (width > 0 and height > 0 and width * height <= min(most, MAX_PIXELS)):
        raise MapFileError(f"{path}: {width} x {height} pixels; a map has 1 to {min(most, MAX_PIXELS)}")


def _damaged(path: Path, why: str) -> MapFileError:
    return MapFileError(f"{path}: damaged or not a picture ({why}); save the map again")


def _cells(picture: Picture, metadata: Metadata) -> NDArray[np.int8]:
    if metadata.mode == "trinary" and picture.with_opacity is not None:
        return _percent(picture.with_opacity, None, metadata)
    if picture.brightness.dtype == np.uint8:
        return _through(_percent(np.arange(256.0), None, metadata), picture.brightness).view(np.int8)
    return _percent(picture.brightness, picture.see_through, metadata)


def _note(picture: Picture, cells: NDArray[np.int8], metadata: Metadata) -> str:
    """Return a note if the grey that map_saver writes for unknown cells is read as free, "" otherwise."""
    lost = np.count_nonzero((cells == 0) & (picture.brightness == UNKNOWN_PIXEL)) / max(cells.size, 1)
    if metadata.mode != "trinary" or lost < MANY_UNKNOWN:  # in mode scale unknown cells are transparent
        return ""
    return (
        f"{lost:.0%} of its pixels are grey {UNKNOWN_PIXEL}, which map_saver writes for unknown cells; "
        f"free_thresh {metadata.free_thresh:g} makes them free: correct it to {FREE_THRESH} in the .yaml"
    )


def _through(table: NDArray[Any], cells: NDArray[Any]) -> NDArray[np.uint8]:
    """Map each byte through a table of 256 bytes, four times as fast as indexing."""
    return np.frombuffer(cells.tobytes().translate(table.tobytes()), np.uint8).reshape(cells.shape)


def _percent(brightness: NDArray[Any], see_through: NDArray[np.bool_] | None, metadata: Metadata) -> NDArray[np.int8]:
    brightness = 255 - brightness if metadata.negate else brightness
    if metadata.mode == "raw":
        value = np.floor(brightness)
        return np.where(value <= 100, value, UNKNOWN).astype(np.int8)
    p, between = (255 - brightness) / 255, np.float64(UNKNOWN)
    if metadata.mode == "scale":
        between = np.trunc(99 * ((p - metadata.free_thresh) / (metadata.occupied_thresh - metadata.free_thresh)))
        between = between if see_through is None else np.where(see_through, UNKNOWN, between)
    free = np.where(p < metadata.free_thresh, 0, between)
    return np.where(p > metadata.occupied_thresh, 100, free).astype(np.int8)


def _greys(grid: OccupancyGrid, mode: str) -> tuple[NDArray[np.uint8], float, float]:
    """Return the grey (256,) of each cell value read as uint8, and the thresholds: occupied above, free below."""
    percent = np.arange(256, dtype=np.uint8).view(np.int8)
    known = percent >= 0
    if mode == "raw":
        greys = np.where(known & (percent <= 100), percent, 255)
        return greys.astype(np.uint8), grid.occupied_above, grid.free_below
    if mode == "scale":
        dark = np.where(percent < 100, np.ceil(percent.astype(float) * SCALE_STEPS / 99), 255)
        return np.where(known, 255 - dark, NO_PIXEL).astype(np.uint8), SCALE_STEPS / 255, 0.0
    states = OccupancyGrid(percent[None], 1.0, (0, 0, 0), grid.free_below, grid.occupied_above).states[0]
    greys = np.full(256, UNKNOWN_PIXEL, np.uint8)
    greys[states == State.FREE], greys[states == State.OCCUPIED] = FREE_PIXEL, OCCUPIED_PIXEL
    return greys, OCCUPIED_THRESH, FREE_THRESH


def _check(grid: OccupancyGrid, image: Path, mode: str, negate: bool) -> None:
    if not grid.cells.size:
        raise MapFileError(f"{image}: the map is empty, there is nothing to write")
    if negate and mode == "raw":
        raise MapFileError(f"{image}: map_server negates raw maps and nav2_map_server does not; leave out negate")
    if mode == "scale" and image.suffix.lower() != ".png" and (grid.cells < 0).any():
        raise MapFileError(f"{image}: mode scale has no grey for unknown cells; name a .png")


def _files(path: Path, mode: str) -> tuple[Path, Path]:
    """Return .yaml and picture."""
    if mode not in MODES:
        raise MapFileError(f"{path}: unknown mode '{mode}'{did_you_mean(mode, MODES)}")
    ending = path.suffix.lower()
    if ending in (".yaml", ".yml"):
        return path, path.with_suffix(".png" if mode == "scale" else ".pgm")
    if ending in (".pgm", ".png"):
        return path.with_suffix(".yaml"), path
    raise MapFileError(f"{path}: the name of a map_server map ends in .yaml, .pgm or .png")


def _yaml_of(path: Path) -> Path:
    if path.suffix.lower() not in (".pgm", ".png", ".bmp"):
        return path
    there = [path.with_suffix(ending) for ending in (".yaml", ".yml") if path.with_suffix(ending).is_file()]
    if not path.is_file():
        raise MapFileError(f"{path}: no such file; give the .yaml of a map_server map")
    if not there:
        raise MapFileError(f"{path}: no {path.stem}.yaml next to it, which defines what its greys mean")
    return there[0]
