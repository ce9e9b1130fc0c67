# SPDX-License-Identifier: Apache-2.0
"""Files that a command writes beside what it tells."""

from __future__ import annotations

from pathlib import Path

from stereovox.errors import StereovoxError


def check_ending(option: str, file: str | None, *endings: str) -> None:
    """Raise StereovoxError where the file of an option does not end as it must."""
    if file is not None and Path(file).suffix.lower() not in endings:
        raise StereovoxError(f"{option} {file}: end the file's name with {' or '.join(endings)}")
