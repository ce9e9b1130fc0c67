# SPDX-License-Identifier: Apache-2.0
"""Write a file all or nothing, so that not even a power cut leaves half of one."""

from __future__ import annotations

import errno
import os
import re
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from stereovox.errors import MapFileError, StereovoxError

FLOOR_ENDINGS = (".yaml", ".pgm", ".png")
"""Files of a floor's map: the picture and its .yaml are written together, whichever is named."""
FLOOR_READABLE = (*FLOOR_ENDINGS, ".yml")
"""Those that can be read."""


def check_in_space(out: str | Path) -> None:
    """Raise StereovoxError where a map in space would get the name of a floor's map."""
    if Path(out).suffix.lower() in FLOOR_READABLE:
        raise StereovoxError(f"{out}: names a floor's map; end the name of a map in space in .svox, or leave it bare")


def check_file(out: str | Path, endings: Iterable[str]) -> Path:
    """Return `out` as a path; raises StereovoxError before the work where it could not be written after it."""
    path = Path(out)
    if path.suffix.lower() not in endings:
        raise StereovoxError(f"{out}: give a name that ends in {' or '.join(endings)}")
    if os.path.isdir(out):
        raise StereovoxError(f"{out}: is a folder; name a file")
    check_folder(path.absolute().parent, str(out))
    return path


def check_folder(folder: Path, name: str) -> None:
    """Raise StereovoxError unless files can be made in `folder`, where `name` shall be."""
    if not folder.is_dir():
        raise StereovoxError(f"{name}: there is no folder {folder}; make it or choose another")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise StereovoxError(f"{name}: {folder} cannot be written to; choose another folder")


@contextmanager
def replacing(path: str | Path, error: type[StereovoxError] = MapFileError) -> Iterator[IO[bytes]]:
    """Yield a binary file that becomes `path` when the block ends well; otherwise an older `path` stays as it was.

    Raises `error`: one line when the folder is missing or cannot be written, or the disk is full.
    """
    target = Path(os.path.realpath(path))  # a link keeps pointing to where it pointed
    temporary = target.with_name(f".{_short(target)}.{uuid.uuid4().hex[:12]}.new")
    try:
        if target.is_dir():
            raise error(f"{path}: is a folder; name a file")
        if target.exists() and not target.is_file():
            raise error(f"{path}: is no plain file, which could be replaced; name another")
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
        sync_folder(target.parent)
    except OSError as failed:
        reason = f"cannot be written ({failed.strerror or failed})"
        raise error(f"{path}: {reason}; choose a folder that exists and has room, and can be written") from None
    finally:
        _remove(temporary)


def sweep_unfinished(*paths: Path) -> None:
    """Remove what `replacing` left of these files where it was killed; nobody else may be writing them."""
    for target in map(Path, map(os.path.realpath, paths)):
        left = re.compile(rf"\.{re.escape(_short(target))}\.[0-9a-f]{{12}}\.new")
        with suppress(OSError):  # what cannot be removed is in nobody's way
            for entry in target.parent.iterdir():
                if left.fullmatch(entry.name):
                    entry.unlink()


def sync_file(path: Path) -> None:
    """Wait until the disk holds what is in a file."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Wait until the disk holds the names in `folder`: what was made, renamed and removed there."""
    try:
        number = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return  # a folder that may be written but not read; not on every system can it be asked
    try:
        os.fsync(number)
    except OSError as error:
        if error.errno != errno.EINVAL:  # the file system has no such thing for folders
            raise
    finally:
        os.close(number)


def sync_tree(folder: Path) -> None:
    """Wait until the disk holds all files below `folder`, and their names."""
    for place, _, names in os.walk(folder, topdown=False):
        for name in names:
            sync_file(Path(place) / name)
        sync_folder(Path(place))


def _short(target: Path) -> str:
    """Return so much of a file's name that a longer one is still a name."""
    return os.fsdecode(os.fsencode(target.name)[:200])


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return  # the folder cannot be written, so the file was never made
