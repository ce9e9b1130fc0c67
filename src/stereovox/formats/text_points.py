# SPDX-License-Identifier: Apache-2.0
"""Points as text: `.xyz`, `.csv`, `.txt`, `.asc`, `.pts`, with or without a line that names the columns; `.ptx`."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError
from stereovox.files.safe_io import read_text, shown

MAX_BYTES = 1 << 30
HEAD = 1 << 16
"""Characters that must contain the first line with numbers."""
COMMENTS = ("#", "//")
SEPARATORS = (",", ";", "\t")
NAME = re.compile(r"[a-z]+")
PARAVIEW, UNIT = re.compile(r'"?points\w*:([012])"?'), re.compile(r"[\[(] *(mm|cm|m|ft) *[\])]")
"""A coordinate's name as VeloView and ParaView write it, and a unit in a name."""
LINES_OF_PTX = (1, 1, 3, 3, 3, 3, 4, 4, 4, 4)
"""Numbers in the first lines of a scan: columns, rows, place and axes of the scanner, the matrix of its points."""


class TextPoints(NamedTuple):
    """xyz: points (N, 3) as in the file. unit: of their columns' names, such as mm; "" if they have none. scans: number
    of scans of a `.ptx`, whose points are in their common frame; 0 for others.
    """

    xyz: NDArray[np.float64]
    unit: str = ""
    scans: int = 0


def read_text_points(path: str | Path) -> TextPoints:
    """Return points: the columns named x, y and z, else the first three.

    Columns are separated by commas, semicolons or blanks; `#` and `//` begin comments, which may name the columns; a
    first line with a single number counts the points. Scans of a `.ptx`, whatever the file's ending, are moved by their
    matrices. Raises MapFileError: one line with the file and the problem.
    """
    try:
        text = read_text(Path(path), MAX_BYTES)
        if _is_ptx(text):
            parts = list(_scans(io.StringIO(text)))
            return TextPoints(np.concatenate(parts), "m", len(parts))
        start, separator, columns, unit = _layout(text)
        with warnings.catch_warnings(action="ignore"):  # an empty table is refused below
            table = np.loadtxt(
                io.StringIO(text[start:]), delimiter=separator, usecols=columns, comments=COMMENTS, ndmin=2
            )
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error}); name a file of points") from None
    except UnicodeError:
        raise MapFileError(f"{path}: is not text; give it its real ending, .ply, .pcd or .las") from None
    except (ValueError, OverflowError) as error:
        why = " ".join(str(error).split())[:120]
        raise MapFileError(f"{path}: no readable points: {why}; write x y z a line") from None
    if not len(table):
        raise MapFileError(f"{path}: holds no point; write x y z a line")
    return TextPoints(table, unit)


def _is_ptx(text: str) -> bool:
    lines = text[:HEAD].split("\n", len(LINES_OF_PTX))[: len(LINES_OF_PTX)]
    return [len(line.split()) for line in lines] == list(LINES_OF_PTX) and all(
        _is_count(line.split()) for line in lines[:2]
    )


def _scans(lines: Iterator[str]) -> Iterator[NDArray[np.float64]]:
    """Yield the points (N, 3) of each scan of a `.ptx`; a direction without echo has the point 0 0 0.

    Raises ValueError for one that is cut off, or whose matrix, by which rows x y z 1 are multiplied, is no motion.
    """
    while head := list(islice(lines, len(LINES_OF_PTX))):
        numbers = [[float(word) for word in line.split()] for line in head]
        if tuple(map(len, numbers)) != LINES_OF_PTX or numbers[0][0] < 0 or numbers[1][0] < 0:
            raise ValueError("the head of a scan is damaged")
        M, count = np.array(numbers[6:]), int(numbers[0][0] * numbers[1][0])
        if (
            np.abs(M @ [0, 0, 0, 1] - [0, 0, 0, 1]).max() > 1e-6
            or np.abs(M[:3, :3] @ M[:3, :3].T - np.eye(3)).max() > 0.01
        ):
            raise ValueError(
                "the matrix of a scan moves no points: its last column is not 0 0 0 1, or it does not rotate"
            )
        with warnings.catch_warnings(action="ignore"):
            points = np.loadtxt(islice(lines, count), usecols=(0, 1, 2), ndmin=2).reshape(-1, 3)
        if len(points) != count:
            raise ValueError(f"a scan of {count} points holds {len(points)}")
        yield points[points.any(axis=1)] @ M[:3, :3] + M[3, :3]


def _layout(text: str) -> tuple[int, str | None, tuple[int, ...], str]:
    """Return the offset of the numbers, their separator, which columns are x, y and z, and their unit.

    Raises ValueError if no line holds three numbers.
    """
    start, named, unit = 0, None, ""
    for line in text[:HEAD].splitlines(keepends=True):
        words, separator = _words(line)
        columns = named if named is not None and max(named) < len(words) else (0, 1, 2)
        if words and _is_row([words[k] for k in columns if k < len(words)]):
            return start, separator, columns, unit
        names = _named(words)
        if names is not None:
            named, found = names, UNIT.search(line.lower())
            unit = found[1] if found else "m" if "points_m_" in line.lower() else ""
        elif words and not line.lstrip().startswith(COMMENTS) and not _is_count(words):
            raise ValueError(f"a line {shown(line.strip())} without columns x, y and z")
        start += len(line)
    raise ValueError("no line of three numbers")


def _words(line: str) -> tuple[list[str], str | None]:
    line = line.strip()
    separator = next((mark for mark in SEPARATORS[:2] if mark in line), None)
    return [word.strip() for word in line.split(separator) if word.strip()], separator


def _is_row(words: list[str]) -> bool:
    try:
        return len([float(word) for word in words[:3]]) == 3
    except ValueError:
        return False


def _is_count(words: list[str]) -> bool:
    return len(words) == 1 and words[0].isdigit()


def _named(words: list[str]) -> tuple[int, ...] | None:
    """Return the columns of x, y and z in a line of names (`//X`, `x [m]`), None if it does not name them."""
    names = [found[0] if (found := NAME.search(word.lower())) else "" for word in words]
    if any(map(PARAVIEW.fullmatch, map(str.lower, words))):
        names = ["xyz"[int(found[1])] if (found := PARAVIEW.fullmatch(word.lower())) else "other" for word in words]
    names = [name for name in names if name] if words and not NAME.search(words[0].lower()) else names
    return (names.index("x"), names.index("y"), names.index("z")) if {"x", "y", "z"} <= set(names) else None
