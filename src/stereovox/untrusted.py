# SPDX-License-Identifier: Apache-2.0
"""Small files from strangers: no more bytes, nesting or copies than such a file can need, and nothing is executed."""

from __future__ import annotations

import errno
import json
import os
import re
import reprlib
import stat
import tomllib
from pathlib import Path
from typing import Any

MOST_LIST = 1 << 28
"""Bytes of a list with a line for each image or pose."""
MOST_SETTINGS = 1 << 16
"""Bytes of a file of settings, or of one calibration."""
MOST_YAML = 1 << 14
"""Bytes of a small YAML file: reading takes 20 us for each."""
MOST_DOTS = 200
"""Dots in one line of TOML; the time for a key `a.b.c` goes with their square."""
DEEPEST = 64
"""Brackets within brackets in YAML."""
BRACKETS = re.compile(r"[\[\]{}]")
LARGEST_COUNT = 1 << 62
MOST_NODES = 100_000
"""Values in a YAML file, each counted as often as aliases repeat it."""


def read_bounded(path: Path, most: int = MOST_SETTINGS) -> bytes:
    """Return the bytes of a file. Raises OSError where it cannot be read, holds more than `most`, or is no file.

    A pipe would be waited for, and a device never ends.
    """
    with open(path, "rb", opener=_without_waiting) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a file")
        if status.st_size > most:
            raise OSError(errno.EFBIG, f"holds more than {most} bytes, which is too many for such a file")
        return file.read(status.st_size)  # room is made for all that is asked for, there or not


def read_text(path: Path, most: int = MOST_SETTINGS, errors: str = "strict") -> str:
    """Return the text (UTF-8) of a file; raises OSError as `read_bounded`, UnicodeDecodeError where it is no text."""
    return read_bounded(path, most).decode("utf-8-sig", errors)


def toml_table(text: str) -> dict[str, Any]:
    """Return what stands in TOML; raises ValueError, one line."""
    if any(line.count(".") > MOST_DOTS for line in text.splitlines()):
        raise ValueError(f"a line with more than {MOST_DOTS} dots")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def json_value(text: str | bytes) -> Any:
    """Return what stands in JSON; raises ValueError, one line."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def yaml_value(text: str | bytes, loader_class: Any = None) -> Any:
    """Return what stands in YAML, by a SafeLoader: plain values only. Raises ValueError, one line.

    Aliases may repeat a value, but neither nest without end nor unfold to more than `MOST_NODES`.
    """
    import yaml

    loader = None
    text = text.decode("utf-8-sig") if isinstance(text, bytes) else text  # UnicodeDecodeError is a ValueError
    _check_brackets(text)
    try:
        loader = (loader_class or yaml.SafeLoader)(text)
        node = loader.get_single_node()
        if node is None:
            return None
        _unfolded(node, {})
        return loader.construct_document(node)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except (yaml.YAMLError, ValueError, TypeError, AttributeError, LookupError) as error:  # PyYAML's own slips too
        raise ValueError(" ".join(str(error).split()) or type(error).__name__) from None
    finally:
        if loader is not None:
            loader.dispose()


def count_in(table: dict[str, Any], key: str) -> int:
    """Return the count that stands under `key`; raises KeyError, and ValueError for what cannot be a count."""
    count = table[key]
    if type(count) is not int or not 0 <= count < LARGEST_COUNT:
        raise ValueError(f"{key} {shown(count)} is no count")
    return count


def shown(value: Any) -> str:
    """Return a value as messages show it: short, whatever it is."""
    return _SHORT.repr(value)


class _Short(reprlib.Repr):
    """Python's own short texts, also of whole numbers that Python refuses to write out."""

    def repr_int(self, x: int, level: int) -> str:
        return repr(x) if x.bit_length() < 256 else f"{x if x.bit_length() < 13_000 else hex(x)}"[:60] + "..."


_SHORT = _Short()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxdict, _SHORT.maxstring = 4, 16, 16, 4, 80


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _check_brackets(text: str) -> None:
    """Raise ValueError where brackets nest deeper than `DEEPEST`: PyYAML's time goes with the square of that."""
    depth = 0
    for bracket in BRACKETS.findall(text):
        depth = depth + 1 if bracket in "[{" else max(depth - 1, 0)
        if depth > DEEPEST:
            raise ValueError("nested too deeply")


def _unfolded(node: Any, known: dict[int, int]) -> int:
    """Return how many values a node stands for; raises ValueError for too many, and for one that holds itself."""
    if isinstance(node.value, str):
        return 1
    if id(node) not in known:
        known[id(node)] = 0  # while it is being counted
        parts = [part for item in node.value for part in (item if isinstance(item, tuple) else (item,))]
        known[id(node)] = 1 + sum(_unfolded(part, known) for part in parts)
    if not 0 < known[id(node)] <= MOST_NODES:
        raise ValueError("aliases that hold themselves or unfold to too many values")
    return known[id(node)]
