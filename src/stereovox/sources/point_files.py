# SPDX-License-Identifier: Apache-2.0
"""Read the points of `.ply` and `.pcd` files of any program (formats: Turk 1994; PCL's PCD 0.7).

Written by hand, because trimesh reads no PCD and no dependency decompresses its LZF.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

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
ENDIAN: dict[str, Literal["little", "big"]] = {"<": "little", ">": "big"}
PLY_LENGTHS = ("char", "uchar", "short", "ushort", "int", "uint", "int8", "uint8", "int16", "uint16", "int32", "uint32")
CHUNK, OPAQUE = 256, 128
"""Splats of a compressed `.ply` that share a box, and least opacity of 255 of a surface: half."""
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
    haze: number of Gaussian splats left out of `xyz` because they are more transparent than not; None for bare points.
    """

    xyz: NDArray[np.float64]
    voxel_size: float | None
    ply: bool = False
    faces: int = 0
    width: int = 0
    height: int = 1
    turned: bool = False
    haze: int | None = None


def read_points(path: str | Path) -> Points:
    """Return the points of a `.ply` or `.pcd` file; raises MapFileError: one line with the file and the problem."""
    try:
        content = read_bounded(Path(path), MAX_BYTES)
        head = (_ply_head if content.startswith(b"ply") else _pcd_head)(content)
        size, ply = _parse_voxel_size(content[: head.start]), content.startswith(b"ply")
        xyz, opaque = _xyz(content[head.start :], head)
        xyz = xyz if opaque is None else xyz[opaque]
        haze = None if opaque is None else int((~opaque).sum())
        return Points(xyz, size, ply, head.faces, *(head.shape or (len(xyz), 1)), head.turned, haze)
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a file of points") from None
    except ValueError as error:
        raise MapFileError(f"{path}: no readable points: {error}") from None


Field = tuple[str, str, int]
"""Name, kind and count of a field of a record; a list has the kinds of its length and its numbers, and the count 0."""


class _Element(NamedTuple):
    name: str
    number: int
    record: list[Field]


class _Head(NamedTuple):
    """record: one point. order: "" for text. start: offset of the first element; before: elements before the points.

    faces, shape and turned: as in `Points`; shape is None if there are no rows and columns.
    """

    record: list[Field]
    number: int
    order: str
    start: int
    faces: int = 0
    shape: tuple[int, int] | None = None
    turned: bool = False
    before: tuple[_Element, ...] = ()


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
    order, elements = None, list[_Element]()
    for words in lines:
        match words:
            case ["format", form, *_]:
                order = PLY_ORDERS.get(form)
            case ["element", element, number]:
                elements.append(_Element(element, _count(number), []))
            case ["property", "list", of, kind, name] if elements and of in PLY_LENGTHS and kind in PLY_TYPES:
                elements[-1].record.append((name, f"{PLY_TYPES[of]} {PLY_TYPES[kind]}", 0))
            case ["property", kind, name] if elements and kind in PLY_TYPES:
                elements[-1].record.append((name, PLY_TYPES[kind], 1))
            case ["property", *rest]:
                raise ValueError(f"it has {shown(' '.join(rest))}, which is no property")
    at = next((k for k, element in enumerate(elements) if element.name == "vertex"), None)
    if order is None or at is None:
        raise ValueError("its header has no format or no vertices")
    faces = sum(element.number for element in elements if element.name in FACES)
    return _Head(elements[at].record, elements[at].number, order, start, faces, before=tuple(elements[:at]))


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


def _xyz(body: bytes, head: _Head) -> tuple[NDArray[np.float64], NDArray[np.bool_] | None]:
    """Return the points (N, 3), and which splats are opaque (N,), None for bare points.

    Raises ValueError, before memory is allocated, if there are too few bytes.
    """
    names = [name for name, _, _ in head.record]
    if "packed_position" in names:
        return _packed_splats(body, head)
    if not {"x", "y", "z"} & set(names):
        names = [name.lower() if name in ("X", "Y", "Z") else name for name in names]
    if any(names.count(axis) != 1 for axis in "xyz") or any(
        record[2] != 1 for name, record in zip(names, head.record, strict=True) if name in ("x", "y", "z")
    ):
        raise ValueError(f"its points have no x, y and z of one number each (they have {shown(' '.join(names))})")
    splats = {"opacity", "scale_0", "rot_0"} <= set(names)
    table = _table(body, head, [names.index(name) for name in ("x", "y", "z", *["opacity"] * splats)])
    return table[:, :3], table[:, 3] >= 0 if splats else None  # a logit


def _table(body: bytes, head: _Head, at: list[int]) -> NDArray[np.float64]:
    """Return numbers (N, len(at)) of the points, those of the fields at these places of the record."""
    if head.order == COLUMNS:
        return _unpacked(body, head, at)
    if head.order == "":
        return _text_table(body, head, at)
    start = 0
    for element in head.before:
        _, start = _rows(body, start, head.order, element)
    if any(count == 0 for _, _, count in head.record):
        return _ragged(body, start, head, at)
    record = np.dtype([(f"{k}", head.order + kind, (n,)) for k, (_, kind, n) in enumerate(head.record)])
    if head.number * record.itemsize > len(body) - start:
        raise ValueError(
            f"{head.number} points need {head.number * record.itemsize} bytes, {len(body) - start} are left"
        )
    points = np.frombuffer(body, record, head.number, start)
    with np.errstate(invalid="ignore"):
        return np.concatenate([points[str(k)].astype(np.float64) for k in at], axis=1)


def _unpacked(body: bytes, head: _Head, at: list[int]) -> NDArray[np.float64]:
    types = [np.dtype((f"<{kind}", (n,))) for _, kind, n in head.record]
    starts = np.cumsum([0, *(head.number * kind.itemsize for kind in types)]).tolist()
    size, whole = np.frombuffer(body[:8], "<u4").tolist() if len(body) >= 8 else (0, -1)
    if whole != starts[-1] or size > len(body) - 8 or whole > MAX_RATIO * size:
        raise ValueError(f"{head.number} points in {starts[-1]} bytes, packed in {len(body) - 8} bytes, are impossible")
    columns = np.empty(whole, np.uint8)
    if unpack(np.frombuffer(body, np.uint8, size, 8), columns) != whole:
        raise ValueError("its packed points are damaged")
    return np.stack([columns[starts[k] : starts[k + 1]].view(types[k].base).astype(np.float64) for k in at], axis=1)


def _rows(body: bytes, start: int, order: str, element: _Element) -> tuple[NDArray[np.int64], int]:
    """Return the offsets (N, L + 1) of a row's numbers before, between and after its L lists, and the end of all."""
    runs, lists = [0], list[tuple[np.dtype, int]]()
    for _, kind, count in element.record:
        if count:
            runs[-1] += np.dtype(kind).itemsize * count
            continue
        length, item = map(np.dtype, kind.split())
        lists.append((length, item.itemsize))
        runs.append(0)
    least = sum(runs) + sum(length.itemsize for length, _ in lists)
    if element.number * least > len(body) - start:
        raise ValueError(
            f"its {shown(element.name)} needs {element.number * least} bytes, {len(body) - start} are left"
        )
    if not lists:
        return start + runs[0] * np.arange(element.number)[:, None], start + runs[0] * element.number
    steps, endian = [(length.itemsize, item) for length, item in lists], ENDIAN[order]
    offsets = np.empty((element.number, len(runs)), np.int64)
    for row in offsets:
        row[0] = start
        start += runs[0]
        for k, (width, item) in enumerate(steps):
            start += width + item * int.from_bytes(body[start : start + width], endian)
            row[k + 1] = start
            start += runs[k + 1]
        if start > len(body):
            raise ValueError(f"its {shown(element.name)} is cut off")
    return offsets, start


def _ragged(body: bytes, start: int, head: _Head, at: list[int]) -> NDArray[np.float64]:
    """Return columns of points that have lists: OpenMVS's views."""
    offsets, _ = _rows(body, start, head.order, _Element("vertex", head.number, head.record))
    content, found = np.frombuffer(body, np.uint8), []
    for k in at:
        lists = [n for n in range(k) if head.record[n][2] == 0]
        before = head.record[lists[-1] + 1 if lists else 0 : k]
        kind = np.dtype(head.order + head.record[k][1])
        first = offsets[:, len(lists)] + sum(np.dtype(other).itemsize for _, other, _ in before)
        picked = content[first[:, None] + np.arange(kind.itemsize)]
        found.append(np.ascontiguousarray(picked).view(kind)[:, 0].astype(np.float64))
    return np.stack(found, axis=1)


def _text_table(body: bytes, head: _Head, at: list[int]) -> NDArray[np.float64]:
    start = 0
    for _ in range(sum(element.number for element in head.before)):
        start = body.find(b"\n", start) + 1
        if not start:
            raise ValueError("the elements before its points are cut off")
    if any(count == 0 for _, _, count in head.record):
        lines = body[start:].splitlines()[: head.number]
        if len(lines) < head.number:
            raise ValueError(f"{head.number} points need {head.number} lines, {len(lines)} are left")
        return np.array([_in_line(line.split(), head.record, at) for line in lines]).reshape(-1, len(at))
    width = sum(n for _, _, n in head.record)
    before = np.cumsum([0, *(n for _, _, n in head.record)])
    numbers = np.concatenate([np.empty(0), *_numbers(body[start:], head.number * width)])
    if len(numbers) < head.number * width:
        raise ValueError(f"{head.number} points need {head.number * width} numbers, {len(numbers)} are left")
    return numbers.reshape(-1, width)[:, [int(before[k]) for k in at]]


def _in_line(words: list[bytes], record: list[Field], at: list[int]) -> list[float]:
    """Return numbers of a line in which some fields are lists, each with its length before it."""
    places, place = [], 0
    for _, _, count in record:
        places.append(place)
        if place >= len(words):
            raise ValueError("a point is cut off")
        place += count or 1 + max(int(words[place]), 0)
    return [float(words[places[k]]) for k in at]


def _packed_splats(body: bytes, head: _Head) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the splats of SuperSplat's compressed `.ply`: 11, 10 and 11 bits of x, y and z within the box of their
    chunk of 256, and 8 bits each of red, green, blue and opacity.
    """
    chunks = next((element for element in head.before if element.name == "chunk"), _Element("", 0, []))
    names = [[name for name, _, _ in record] for record in (chunks.record, head.record)]
    box = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    if not (set(box) <= set(names[0]) and "packed_color" in names[1] and chunks.number * CHUNK >= head.number):
        raise ValueError("its splats are packed in an unknown form; export them uncompressed")
    before = head.before[: head.before.index(chunks)]
    boxes = _table(body, head._replace(record=chunks.record, number=chunks.number, before=before),
                   [names[0].index(name) for name in box])  # fmt: skip
    packed = _table(body, head, [names[1].index(name) for name in ("packed_position", "packed_color")]).astype(
        np.uint32
    )
    share = np.stack([packed[:, 0] >> 21, packed[:, 0] >> 11 & 1023, packed[:, 0] & 2047], axis=1) / [2047, 1023, 2047]
    of = boxes[np.arange(head.number) // CHUNK]
    return of[:, :3] + share * (of[:, 3:] - of[:, :3]), (packed[:, 1] & 255) >= OPAQUE


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
