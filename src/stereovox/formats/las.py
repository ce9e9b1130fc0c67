# SPDX-License-Identifier: Apache-2.0
"""Lidar surveys, `.las` and `.laz` (ASPRS LAS 1.0 to 1.4), read by laspy, with the unit of their coordinate system."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, MissingExtra
from stereovox.files.safe_io import read_bounded

MAX_BYTES = 1 << 32
MAX_POINTS = 1 << 28
PER_BYTE = 50
"""Points for each byte of a packed file; LAZ needs several bytes per point, unless points are equal."""
AT_ONCE = 1 << 20
HEADER, RECORD, LONG_RECORD, LEAST_POINT = 227, 54, 60, 20
"""Minimum bytes of the header, of a record, of a long record and of a point."""
LASZIP, LAYERED, FEWEST_LAYERS = 22204, 6, 9
"""Record that describes the packing; first point format that is packed in layers, and its number of layers."""
PACKED = 0xC0
"""Bits of the point format that mark packed points."""
MODEL, LINEAR_UNIT, VERTICAL_UNIT = 1024, 3076, 4099
"""Keys of GeoTIFF 1.8.2: kind of the coordinate system, unit of x and y, unit of z."""
GEOGRAPHIC = 2
EPSG_UNITS = {9001: (1.0, "metres"), 9002: (0.3048, "feet"), 9003: (1200 / 3937, "US survey feet")}
WKT_UNIT = re.compile(r'UNIT\["([^"]*)",\s*([0-9.eE+-]+)')
DEGREES = (
    "its x and y are degrees, not lengths; project it, for example: pdal translate IN OUT reprojection "
    "--filters.reprojection.out_srs=EPSG:32633 (the UTM zone of the place)"
)


class _Degrees(Exception):  # noqa: N818 - not an error by itself
    """The coordinates are degrees."""


class LasPoints(NamedTuple):
    """As `clouds.Cloud`."""

    xyz: NDArray[np.float64]
    holds: str
    metres: tuple[tuple[float, float, float], str] | None


def read_las(path: str | Path) -> LasPoints:
    """Return the points of a survey, and the unit of its coordinate system if it names one.

    Raises MapFileError: unreadable, damaged, or in degrees; MissingExtra without laspy.
    """
    try:
        import laspy
    except ImportError:
        raise MissingExtra("laspy", "las") from None
    try:
        content = read_bounded(Path(path), MAX_BYTES)
        _check_header(content)
        one_thread = laspy.LazBackend.Lazrs  # several threads allocate whole chunks, whatever length the file declares
        with laspy.open(io.BytesIO(content), laz_backend=one_thread) as reader:
            header = reader.header
            _check_count(header, len(content))
            _check_layers(content, header)
            metres = _metres(header)
            xyz = np.concatenate([np.empty((0, 3)), *_pieces(reader)])
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a file of points") from None
    except _Degrees:
        raise MapFileError(f"{path}: {DEGREES}") from None
    except struct.error:
        raise MapFileError(f"{path}: no readable points: it is cut off; copy or export it again") from None
    except BaseException as error:  # laspy and its Rust library can raise anything on a damaged file
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        why = (" ".join(str(error).split()) or type(error).__name__)[:120]
        raise MapFileError(f"{path}: no readable points: {why}; copy or export it again") from None
    kind = "LAZ" if header.are_points_compressed else "LAS"
    return LasPoints(xyz, f"{kind} {header.version}, {len(xyz):,} points", metres)


def _check_header(content: bytes) -> None:
    """Raise ValueError for counts and offsets in the header that the file has no room for; laspy trusts them all."""
    size = len(content)
    if not content.startswith(b"LASF") or size < HEADER:
        raise ValueError("its header is not a survey's")
    start, offset, records = struct.unpack_from("<HII", content, 94)
    if not start + records * RECORD <= offset <= size:
        raise ValueError(f"{records} records before byte {offset} of {size}")
    if content[25] >= 4 and size >= 247:
        place, more = struct.unpack_from("<QI", content, 235)
        if more and place + more * LONG_RECORD > size:
            raise ValueError(f"{more} long records behind byte {place} of {size}")
    if content[104] & PACKED:
        _check_chunks(content, offset)


def _check_chunks(content: bytes, offset: int) -> None:
    """Raise ValueError if the table of packed chunks is outside the file or lists too many of them."""
    (table,) = struct.unpack_from("<q", content, offset)
    (table,) = struct.unpack_from("<q", content, len(content) - 8) if table == -1 else (table,)
    if not offset + 8 <= table <= len(content) - 8:
        raise ValueError(f"the table of its chunks is at byte {table} of {len(content)}")
    (chunks,) = struct.unpack_from("<I", content, table + 4)
    if chunks * LEAST_POINT > len(content):
        raise ValueError(f"{chunks} chunks in {len(content)} bytes")


def _check_count(header: Any, size: int) -> None:
    """Raise ValueError for more points than a file of `size` bytes can hold."""
    count = header.point_count
    least = count / PER_BYTE if header.are_points_compressed else count * header.point_format.size
    if count > MAX_POINTS or least > size:
        raise ValueError(f"{count} points in {size} bytes")


def _check_layers(content: bytes, header: Any) -> None:
    """Raise ValueError if a packed chunk declares a layer longer than the chunk.

    Points of format 6 and above are packed in layers: a chunk is a point, a count, the size of each layer, and the
    layers.
    """
    if not header.are_points_compressed or header.point_format.id < LAYERED:
        return
    lazrs: Any = import_module("lazrs")  # has no type information
    stream = io.BytesIO(content)
    stream.seek(header.offset_to_point_data)
    packing = next(vlr for vlr in header.vlrs if vlr.record_id == LASZIP)
    table = lazrs.read_chunk_table(stream, lazrs.LazVlr(packing.record_data))
    at, layers = header.offset_to_point_data + 8, FEWEST_LAYERS + header.point_format.num_extra_bytes
    layers += {7: 1, 8: 2, 10: 3}.get(header.point_format.id, 0) + (header.point_format.id == 9)
    for points, size in table:
        lengths = struct.unpack_from(f"<{layers}I", content, at + header.point_format.size + 4) if points else ()
        if sum(lengths) > size or at + size > len(content):
            raise ValueError(f"a chunk of {size} bytes with layers of {sum(lengths)}")
        at += size


def _pieces(reader: Any) -> Iterator[NDArray[np.float64]]:
    for points in reader.chunk_iterator(AT_ONCE):
        yield np.column_stack([points.x, points.y, points.z]).astype(np.float64)


def _metres(header: Any) -> tuple[tuple[float, float, float], str] | None:
    """Return metres per unit along x, y and z, and the unit's name; None if the file names none.

    Raises _Degrees if x and y are degrees.
    """
    texts = [vlr.string for vlr in header.vlrs if hasattr(vlr, "string")]
    keys = [key for vlr in header.vlrs for key in getattr(vlr, "geo_keys", ())]
    return _by_text(" ".join(texts)) if any(texts) else _by_keys({key.id: key.value_offset for key in keys})


def _by_keys(keys: dict[int, int]) -> tuple[tuple[float, float, float], str] | None:
    if keys.get(MODEL) == GEOGRAPHIC:
        raise _Degrees
    if keys.get(LINEAR_UNIT) not in EPSG_UNITS:
        return None
    flat, name = EPSG_UNITS[keys[LINEAR_UNIT]]
    upright, _ = EPSG_UNITS.get(keys.get(VERTICAL_UNIT, 0), (flat, name))
    return (flat, flat, upright), name


def _by_text(text: str) -> tuple[tuple[float, float, float], str] | None:
    units = [(name, float(factor)) for name, factor in WKT_UNIT.findall(text)]
    lengths = [(name, factor) for name, factor in units if not re.search("degree|radian|unity", name, re.IGNORECASE)]
    if "PROJ" not in text and "GEOG" in text:
        raise _Degrees
    if not lengths or not all(1e-4 < factor < 1e4 for _, factor in lengths):
        return None
    (name, flat), (_, upright) = lengths[0], lengths[-1]
    return (flat, flat, upright), name
