# SPDX-License-Identifier: Apache-2.0
"""One writer at a time: a file lock that the system releases however its holder ends.

Readers need no lock. A killed process leaves the file behind, which does no harm.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from stereovox.errors import MapFileError
from stereovox.files.safe_io import FLOOR_ENDINGS, sweep_unfinished, sync_folder

LOCK = ".lock"
"""The lock file in a folder that is being written."""
PATIENCE_S = 0.1
"""Time a writer waits for another: just enough for one that is about to end."""


@contextmanager
def only_writer_in(folder: Path) -> Iterator[None]:
    """Hold the right to write to `folder`; it is created, and removed at the end if empty.

    Re-entrant within one thread. Raises MapFileError if another process or thread is the writer, or
    if the folder cannot be written.
    """
    with _made(folder), _held(folder, folder / LOCK, again=True):
        yield


@contextmanager
def only_store_in(folder: Path) -> Iterator[None]:
    """Hold the right to write to `folder` for one object: as `only_writer_in`, but not re-entrant."""
    with _made(folder), _held(folder, folder / LOCK, again=False):
        yield


@contextmanager
def only_writer_of(file: Path, *others: Path) -> Iterator[None]:
    """Hold the right to write `file`, and `others` with it: as `only_writer_in`; the lock is next to it.

    Remains of a killed writer are removed.
    """
    with _held(file, file.with_name(f".{file.name}{LOCK}"), again=True):
        sweep_unfinished(file, *others)
        yield


def only_writer_of_floor(out: Path) -> AbstractContextManager[None]:
    """Hold the right to write a floor's map, its pictures and its trajectory, whichever of these `out` names."""
    yaml, *pictures, way = (out.with_suffix(ending) for ending in (*FLOOR_ENDINGS, ".tum"))
    between = [picture.with_name(f".{picture.name}") for picture in pictures]
    return only_writer_of(yaml, *pictures, *between, way)


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        with _one_line_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for place in made:
                sync_folder(place.parent)
        yield
    finally:
        for place in made:
            with suppress(OSError):  # something is in it
                place.rmdir()


@contextmanager
def _held(what: Path, where: Path, again: bool) -> Iterator[None]:
    from filelock import FileLock, Timeout

    where = Path(os.path.realpath(where.parent)) / where.name  # the same lock by any name
    with _one_line_errors(what):
        os.stat(where.parent)  # filelock would make the folder
        lock = FileLock(where, is_singleton=again, thread_local=again)
        try:
            lock.acquire(PATIENCE_S, PATIENCE_S / 5)
        except Timeout:
            raise MapFileError(f"{what}: is being written by another run; wait for its end or name another") from None
    try:
        if not where.exists():  # entered again
            raise MapFileError(f"{what}: was removed or moved while it was written; nothing more can be saved there")
        yield
    finally:
        if lock.lock_counter == 1:
            with suppress(OSError):
                where.unlink()
        lock.release()


@contextmanager
def _one_line_errors(what: Path) -> Iterator[None]:
    """Turn system errors into a one-line MapFileError."""
    try:
        yield
    except (OSError, NotImplementedError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MapFileError(f"{what}: cannot be written ({reason}); choose a writable folder") from None
