# SPDX-License-Identifier: Apache-2.0
"""Read the points of `.ply` and `.pcd` files of any program (formats: Turk 1994; PCL's PCD 0.7).

Written by hand, because trimesh reads no PCD and no dependency decompresses its LZF.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError
from stereovox.files.safe_io import read_bounded, shown
from stereovox.sources._lzf import unpack

MAX_BYTES = 1 << 32
MAX_HEADER_LENGTH, MAX_FIELDS = 1 << 16, 256
TEXT_PIECE, BLANK = 1 << 20, re.compile(rb"\s")
"""Bytes of text read at once, and the separator of its numbers."""
OURS = re.compile(r"centres of occupied cells of (\S+) m")
"""The comment in our own files with the side of a cell."""
PLY_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float": "f4", "double": "f8", "float32": "f4", "float64": "f8",
}  # fmt: skip
PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
FACES = ("face", "tristrips")
"""Elements of a `.ply` that turn its points into a mesh."""
COLUMNS = "columns"
"""Layout of compressed points: all numbers of one field, little-endian, then all of the next."""
PCD_ORDERS = {"ascii": "", "binary": "<", "binary_compressed": COLUMNS}
MAX_RATIO = 100
"""Largest LZF compression ratio accepted; at best 3 bytes expand to 264."""
PCD_KINDS = {"I": "i", "U": "u", "F": "f"}
PCD_SIZES = {"i": (1, 2, 4, 8), "u": (1, 2, 4, 8), "f": (4, 8)}


class Points(NamedTuple):
    """Points as stored in a file.

    xyz: (N, 3) float64. voxel_size: metres, if the file has the size of its cells. ply: whether it is a `.ply`. faces:
    number of faces after the points of a `.ply`. width, height: of an organised `.pcd`, whose points are the
    pixels of an image; height 1 for all others. turned: whether a `.pcd` has a VIEWPOINT that rotates or moves points.
    """

    xyz: NDArray[np.float64]
    voxel_size: float | None
    ply: bool = False
    faces: int = 0
    width: int = 0
    height: int = 1
    turned: bool = False


def read_points(path: str | Path) -> Points:
    """Return the points of a `.ply` or `.pcd` file; raises MapFileError: one line with the file and the problem."""
    try:
        content = read_bounded(Path(path), MAX_BYTES)
        head = (_ply_head if content.startswith(b"ply") else _pcd_head)(content)
        size, ply = _parse_voxel_size(content[: head.start]), content.startswith(b"ply")
        xyz = _xyz(content[head.start :], head)
        return Points(xyz, size, ply, head.faces, *(head.shape or (len(xyz), 1)), head.turned)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a file of points") from None
    except ValueError as error:
        raise MapFileError(f"{path}: no readable points: {error}") from None


class _Head(NamedTuple):
    """record: one point: name, kind and count of its fields. order: "" for text. start: offset of the points.

    faces, shape and turned: as in `Points`; shape is None if there are no rows and columns.
    """

    record: list[tuple[str, str, int]]
    number: int
    order: str
    start: int
    faces: int = 0
    shape: tuple[int, int] | None = None
    turned: bool = False


def _lines(content: bytes, last: Callable[[list[str]], bool]) -> tuple[list[list[str]], int]:
    """Return the words of the header's lines, up to the one that satisfies `last`, and the offset of the rest."""
    found, start = [], 0
    for line in content[:MAX_HEADER_LENGTH].splitlines(keepends=True):
        start += len(line)
        words = line.decode("ascii", "replace").split()
        found.append(words)
        if last(words) and line.endswith((b"\n", b"\r")):
            return found, start
    raise ValueError("its header does not end; it is not a .ply or .pcd, or is cut off")


def _ply_head(content: bytes) -> _Head:
    lines, start = _lines(content, lambda words: words == ["end_header"])
    order, count, record, element, faces = None, None, [], "", 0
    for words in lines:
        match words:
            case ["format", form, *_]:
                order = PLY_ORDERS.get(form)
            case ["element", element, number]:
                if element != "vertex" and count is None:
                    raise ValueError(f"{shown(element)} comes before its vertices; write the vertices first")
                count = _count(number) if element == "vertex" else count
                faces = _count(number) if element in FACES else faces
            case ["property", kind, name] if element == "vertex" and kind in PLY_TYPES:
                record.append((name, PLY_TYPES[kind], 1))
            case ["property", *rest] if element == "vertex":
                raise ValueError(f"its vertices have {shown(' '.join(rest))}, which no point has")
    if order is None or count is None:
        raise ValueError("its header has no format or no vertices")
    return _Head(record, count, order, start, faces)


def _pcd_head(content: bytes) -> _Head:
    lines, start = _lines(content, lambda words: words[:1] == ["DATA"])
    told = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    names, data = told.get("FIELDS", []), " ".join(told["DATA"])
    sizes, kinds = told.get("SIZE", []), told.get("TYPE", [])
    counts = told.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts) <= MAX_FIELDS:
        raise ValueError("FIELDS, SIZE, TYPE and COUNT have different numbers of fields")
    if data not in PCD_ORDERS:
        raise ValueError(f"DATA is {shown(data)}, only {', '.join(PCD_ORDERS)} can be read")
    record = [(name, *one) for name, one in zip(names, map(_pcd_type, kinds, sizes, counts), strict=True)]
    number = _count(" ".join(told.get("POINTS", [])))
    width, height = (" ".join(told.get(name, ["1"])) for name in ("WIDTH", "HEIGHT"))
    rows = _count(height) if height.isdigit() else 1
    shape = (_count(width), rows) if rows > 1 and width.isdigit() and _count(width) * rows == number else None
    turned = not set(told.get("VIEWPOINT", [])[:3] + told.get("VIEWPOINT", [])[4:]) <= {"0", "-0", "0.0"}
    return _Head(record, number, PCD_ORDERS[data], start, shape=shape, turned=turned)


def _pcd_type(kind: str, size: str, count: str) -> tuple[str, int]:
    letter = PCD_KINDS.get(kind, "")
    if size not in map(str, PCD_SIZES.get(letter, ())):
        raise ValueError(f"no field of TYPE {shown(kind)} has SIZE {shown(size)}")
    if not 0 < _count(count) <= MAX_HEADER_LENGTH:
        raise ValueError(f"a field of COUNT {shown(count)}")
    return f"{letter}{size}", int(count)


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 16):
        raise ValueError(f"{shown(text)} is not a number of points")
    return int(text)


def _xyz(body: bytes, head: _Head) -> NDArray[np.float64]:
    """Return the points (N, 3); raises ValueError, before memory is allocated, if there are too few bytes."""
    names = [name for name, _, _ in head.record]
    if any(names.count(axis) != 1 for axis in "xyz") or any(n > 1 for name, _, n in head.record if name in "xyz"):
        raise ValueError(f"its points have no x, y and z of one number each (they have {shown(' '.join(names))})")
    read = {"": _text_xyz, COLUMNS: _packed_xyz}.get(head.order, _binary_xyz)
    return read(body, head, names)


def _packed_xyz(body: bytes, head: _Head, names: list[str]) -> NDArray[np.float64]:
    types = [np.dtype((f"<{kind}", (n,))) for _, kind, n in head.record]
    starts = np.cumsum([0, *(head.number * kind.itemsize for kind in types)]).tolist()
    size, whole = np.frombuffer(body[:8], "<u4").tolist() if len(body) >= 8 else (0, -1)
    if whole != starts[-1] or size > len(body) - 8 or whole > MAX_RATIO * size:
        raise ValueError(f"{head.number} points in {starts[-1]} bytes, packed in {len(body) - 8} bytes, are impossible")
    columns = np.empty(whole, np.uint8)
    if unpack(np.frombuffer(body, np.uint8, size, 8), columns) != whole:
        raise ValueError("its packed points are damaged")
    at = [names.index(axis) for axis in "xyz"]
    return np.stack([columns[starts[k] : starts[k + 1]].view(types[k].base).astype(np.float64) for k in at], axis=1)


def _binary_xyz(body: bytes, head: _Head, names: list[str]) -> NDArray[np.float64]:
    record = np.dtype([(f"{k}", head.order + kind, (n,)) for k, (_, kind, n) in enumerate(head.record)])
    if head.number * record.itemsize > len(body):
        raise ValueError(f"{head.number} points need {head.number * record.itemsize} bytes, {len(body)} are left")
    points = np.frombuffer(body, record, head.number)
    with np.errstate(invalid="ignore"):
        return np.concatenate([points[str(names.index(axis))].astype(np.float64) for axis in "xyz"], axis=1)


def _text_xyz(body: bytes, head: _Head, names: list[str]) -> NDArray[np.float64]:
    width = sum(n for _, _, n in head.record)
    before = np.cumsum([0, *(n for _, _, n in head.record)])
    numbers = np.concatenate([np.empty(0), *_numbers(body, head.number * width)])
    if len(numbers) < head.number * width:
        raise ValueError(f"{head.number} points need {head.number * width} numbers, {len(numbers)} are left")
    return numbers.reshape(-1, width)[:, [int(before[names.index(axis)]) for axis in "xyz"]]


def _numbers(text: bytes, most: int) -> Iterator[NDArray[np.float64]]:
    """Yield the first numbers of a text, piece by piece: words of the whole text would take 20 times its memory."""
    start = 0
    while start < len(text) and most > 0:
        blank = BLANK.search(text, start + TEXT_PIECE)
        end = blank.start() if blank else len(text)
        words = text[start:end].split()[:most]
        yield np.fromiter(map(float, words), np.float64, len(words))
        start, most = end, most - len(words)


def _parse_voxel_size(head: bytes) -> float | None:
    found = OURS.search(head.decode("ascii", "replace"))
    try:
        return float(found[1]) if found else None
    except ValueError:
        return None
