# SPDX-License-Identifier: Apache-2.0
"""Write a file all or nothing."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from stereovox.errors import MapFileError


@contextmanager
def replacing(path: str | Path) -> Iterator[IO[bytes]]:
    """Yield a binary file that becomes `path` when the block ends well; otherwise an older `path` stays as it was.

    Raises MapFileError: one line when the folder is missing or cannot be written, or the disk is full.
    """
    target = Path(os.path.realpath(path))  # a link keeps pointing to where it pointed
    temporary = target.with_name(f".{uuid.uuid4().hex[:12]}.new")
    try:
        if target.is_dir():
            raise MapFileError(f"{path}: is a folder; name a file")
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except OSError as error:
        reason = f"cannot be written ({error.strerror or error})"
        raise MapFileError(f"{path}: {reason}; choose a folder that exists and has room, and can be written") from None
    finally:
        _remove(temporary)


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return  # the folder cannot be written, so the file was never made
