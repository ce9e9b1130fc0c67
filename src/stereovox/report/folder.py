# SPDX-License-Identifier: Apache-2.0
"""The folder that `--out` names."""

from __future__ import annotations

from pathlib import Path

from stereovox.errors import StereovoxError


def out_folder(out: str | Path) -> Path:
    """Return the folder `out`, made if need be; raises StereovoxError, one line, where that cannot be done."""
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:  # ValueError: a character 0
        reason = getattr(error, "strerror", None) or error
        raise StereovoxError(f"{str(out)!r}: cannot make this folder ({reason}); choose another --out") from None
    return folder
