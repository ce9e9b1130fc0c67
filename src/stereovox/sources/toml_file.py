# SPDX-License-Identifier: Apache-2.0
"""Small TOML files that lie beside a recording: read with one-line errors, and written so that they read back."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stereovox.errors import SourceError
from stereovox.untrusted import read_text, toml_table

LARGEST = 1e300
"""TOML's whole numbers have no end, but those of a float do."""


def read_table(path: Path) -> dict[str, Any]:
    """Return what stands in `path`; raises SourceError, one line, for a file that cannot be read or is no TOML."""
    try:
        return toml_table(read_text(path))
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a TOML file you may read") from None
    except ValueError as error:  # bad TOML, bad UTF-8
        raise SourceError(f"{path}: {error}; correct it") from None


def is_number(value: Any) -> bool:
    """Tell whether a value is a finite number that a float can hold."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST < value < LARGEST


def toml_text(value: Any) -> str:
    """Return a text, a number or a list of them as TOML; floats keep all their digits."""
    if isinstance(value, str):
        escaped = "".join(f"\\u{ord(c):04x}" if ord(c) < 32 or c in '"\\\x7f' else c for c in value)
        return f'"{escaped}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_text, value))}]"
    return repr(value if isinstance(value, int) else float(value))
