# SPDX-License-Identifier: Apache-2.0
"""Folder of the option `--out`."""

from __future__ import annotations

from pathlib import Path

from stereovox.errors import StereovoxError
from stereovox.files.safe_io import check_local


def out_folder(out: str | Path) -> Path:
    """Return the folder `out`, created if missing; raises StereovoxError, one line, if that fails."""
    check_local(out)
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a character 0
        reason = getattr(error, "strerror", None) or error
        raise StereovoxError(f"{str(out)!r}: cannot make this folder ({reason}); choose another --out") from None
    return folder
