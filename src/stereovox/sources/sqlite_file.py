# SPDX-License-Identifier: Apache-2.0
"""SQLite files of unknown origin, read within bounds of size and time."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

STEPS = 10_000
"""SQLite instructions between two checks of the step limit."""
FAULTS = (sqlite3.Error, ValueError, TypeError, OverflowError, MemoryError)
"""Errors of reading a damaged file; ValueError: invalid text."""


class SqliteFile:
    """A SQLite file opened read-only; views, virtual tables and computed columns are refused.

    Args:
        path: The file.
        tables: Tables that will be read.
        longest: Most bytes of a value.

    Raises:
        ValueError, sqlite3.Error: It is not a SQLite file, is damaged, or a table is not a plain one; see `FAULTS`.
    """

    def __init__(self, path: Path, tables: Sequence[str], longest: int):
        size = path.stat().st_size
        self._lock, self._patience = threading.Lock(), _StepLimit(size)
        self._file = sqlite3.connect(
            f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True, check_same_thread=False
        )
        self._file.text_factory = lambda data: data.decode("utf-8", "replace")
        self._file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, min(longest, size))
        self._file.set_progress_handler(self._patience.is_over, STEPS)
        if self.rows(_suspicious(tables))[0][0]:
            raise ValueError(f"{' or '.join(tables)} is not a plain table")

    def rows(self, query: str, *values: Any) -> list[Any]:
        """Return all rows of a query; raises sqlite3.Error."""
        with self._lock:
            self._patience.begin()
            return self._file.execute(query, values).fetchall()


class _StepLimit:
    """Aborts a query of more steps than a file of `size` bytes has rows: damaged pages form cycles."""

    def __init__(self, size: int):
        self._most, self._done = 1_000_000 + 10 * size, 0

    def begin(self) -> None:
        """Reset the count."""
        self._done = 0

    def is_over(self) -> bool:
        """Count `STEPS` more; return whether the limit is exceeded."""
        self._done += STEPS
        return self._done > self._most


def _suspicious(tables: Sequence[str]) -> str:
    """Return the query that counts tables that are not plain: SQLite would run the file's own expressions."""
    names = ", ".join(f"'{name.lower()}'" for name in tables)
    columns = "".join(f" + (SELECT count(*) FROM pragma_table_xinfo('{name}') WHERE hidden)" for name in tables)
    return f"""SELECT (SELECT count(*) FROM sqlite_master WHERE lower(name) IN ({names})
        AND (type <> 'table' OR NOT rootpage > 0)){columns}"""
