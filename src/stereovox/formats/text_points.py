# SPDX-License-Identifier: Apache-2.0
"""Points as text: `.xyz`, `.csv`, `.txt`, `.asc`, `.pts`, with or without a line that names the columns."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path

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


def read_text_points(path: str | Path) -> NDArray[np.float64]:
    """Return points (N, 3): the columns named x, y and z, else the first three.

    Columns are separated by commas, semicolons or blanks; `#` and `//` begin comments, which may name the columns; a
    first line with a single number counts the points. Raises MapFileError: one line with the file and the problem.
    """
    try:
        text = read_text(Path(path), MAX_BYTES)
        start, separator, columns = _layout(text)
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
    return table


def _layout(text: str) -> tuple[int, str | None, tuple[int, ...]]:
    """Return the offset of the numbers, their separator, and which columns are x, y and z.

    Raises ValueError if no line holds three numbers.
    """
    start, named = 0, None
    for line in text[:HEAD].splitlines(keepends=True):
        words, separator = _words(line)
        if words and _is_row(words):
            columns = named if named is not None and max(named) < len(words) else (0, 1, 2)
            return start, separator, columns
        named = _named(words) or named
        if words and not line.lstrip().startswith(COMMENTS) and _named(words) is None and not _is_count(words):
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
    names = [name for name in names if name] if words and not NAME.search(words[0].lower()) else names
    return (names.index("x"), names.index("y"), names.index("z")) if {"x", "y", "z"} <= set(names) else None
