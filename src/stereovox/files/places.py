# SPDX-License-Identifier: Apache-2.0
"""Places for files: a local folder, or a prefix in an object store (`s3://bucket/name`), with one interface.

Folders need only Python. Object stores are reached through obstore (extra `fleet`), which takes endpoint and
credentials from the usual variables: AWS_ENDPOINT_URL, AWS_ACCESS_KEY_ID, AWS_REGION, AWS_ALLOW_HTTP and so on.
"""

from __future__ import annotations

import os
import uuid
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from datetime import timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

from stereovox.errors import MapFileError, MissingExtra
from stereovox.files.safe_io import is_url as is_url
from stereovox.files.safe_io import read_bounded, sync_folder

UNFINISHED = ".unfinished-"
"""Prefix of incomplete files in a folder; they are never listed."""
MAX_FILE = 1 << 32
"""Most bytes that are read at once, unless the caller sets another limit."""
AT_ONCE = 8
"""Objects that are written or read at the same time."""
RETRIES = {"max_retries": 5, "retry_timeout": timedelta(seconds=60)}


class NoBucketError(MapFileError):
    """An object store has no bucket of this name."""


class Place(ABC):
    """Files by their names, with `/` between the parts of a name.

    A file is written whole or not at all, and is stored when `write` returns. Places can be pickled; a process
    that receives one opens its own connection. All methods raise MapFileError, one line with the file, the reason and
    the cure.
    """

    @staticmethod
    def of(where: str | os.PathLike[str] | Place) -> Place:
        """Return the place with this name: a URL or a local folder, which need not exist.

        Raises MissingExtra for a URL if obstore is not installed.
        """
        if isinstance(where, Place):
            return where
        return Bucket(os.fspath(where)) if is_url(where) else Folder(Path(where))

    @abstractmethod
    def __str__(self) -> str: ...

    @abstractmethod
    def __truediv__(self, name: str) -> Place:
        """Return the place whose files have names that begin with `name/` here."""

    @abstractmethod
    def find(self, name: str, most: int = MAX_FILE) -> bytes | None:
        """Return the contents of a file, None if missing. Raises MapFileError for more than `most` bytes."""

    @abstractmethod
    def write(self, name: str, data: bytes) -> None:
        """Write a file, whole or not at all; it replaces an older one of this name."""

    @abstractmethod
    def write_all(self, files: dict[str, bytes]) -> None:
        """Write several files by their names, each as `write` does, in any order."""

    @abstractmethod
    def create(self, name: str, data: bytes) -> bool:
        """Write a file as `write` does if there is none; otherwise return False and change nothing.

        If several processes try at the same moment, only one succeeds.
        """

    @abstractmethod
    def sizes(self, prefix: str = "") -> dict[str, int]:
        """Return names and bytes of all files whose names begin with `prefix`, in ascending order."""

    @abstractmethod
    def remove(self, names: Iterable[str]) -> None:
        """Remove files; missing ones are ignored."""

    def read(self, name: str, most: int = MAX_FILE) -> bytes:
        """Return the contents of a file. Raises MapFileError if it is missing or has more than `most` bytes."""
        data = self.find(name, most)
        if data is None:
            raise MapFileError(f"{self}/{name}: is missing; what it belongs to is damaged, make it again")
        return data

    @abstractmethod
    def tidy(self) -> None:
        """Remove the incomplete files of killed writers; no one else may be writing here."""

    def names(self, prefix: str = "") -> list[str]:
        """Return the names of all files that begin with `prefix`, in ascending order."""
        return list(self.sizes(prefix))

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self}>"

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return Place.of, (str(self),)


class Folder(Place):
    """Files below a local folder; the first `write` creates it."""

    def __init__(self, path: Path):
        self.path = path

    def __str__(self) -> str:
        return str(self.path)

    def __truediv__(self, name: str) -> Folder:
        return Folder(self._path(name))

    def find(self, name: str, most: int = MAX_FILE) -> bytes | None:
        """Return the contents of a file, None if missing; links are not followed."""
        path = self._path(name)
        with _one_line(path, "read"):
            if path.is_symlink():
                raise MapFileError(f"{path}: is a link; a map has all its files in one folder")
            try:
                return read_bounded(path, most)
            except FileNotFoundError:
                return None

    def write(self, name: str, data: bytes) -> None:
        """Write a temporary file next to the target and rename it."""
        self.write_all({name: data})

    def write_all(self, files: dict[str, bytes]) -> None:
        """Write temporary files next to the targets and rename them; each folder is flushed once."""
        for name, data in files.items():
            with self._unfinished(name, data) as (temporary, path):
                temporary.replace(path)
        self._flush(files)

    def create(self, name: str, data: bytes) -> bool:
        """Write a file if there is none, by linking a whole temporary file to its name: the system lets one process
        win."""
        with self._unfinished(name, data) as (temporary, path):
            try:
                os.link(temporary, path)
            except FileExistsError:
                return False
        self._flush([name])
        return True

    def sizes(self, prefix: str = "") -> dict[str, int]:
        """Return names and bytes of the plain files below the folder."""
        start = self._path(prefix.rpartition("/")[0])
        found: dict[str, int] = {}
        for above, _, names in os.walk(start):
            for path in (Path(above) / name for name in names if not name.startswith(UNFINISHED)):
                with suppress(FileNotFoundError):  # removed in the meantime
                    if path.is_file() and not path.is_symlink():
                        found[path.relative_to(self.path).as_posix()] = path.stat().st_size
        return {name: found[name] for name in sorted(found) if name.startswith(prefix)}

    def remove(self, names: Iterable[str]) -> None:
        """Remove files, and the folders that this leaves empty, except the place itself."""
        for path in map(self._path, names):
            with _one_line(path, "removed"):
                path.unlink(missing_ok=True)
            with suppress(OSError):  # not empty
                for folder in path.parents:
                    if folder == self.path or self.path not in folder.parents:
                        break
                    folder.rmdir()

    def tidy(self) -> None:
        """Remove files that were never renamed to their targets."""
        for above, _, names in os.walk(self.path):
            for name in names:
                if name.startswith(UNFINISHED):
                    with suppress(OSError):  # a leftover does no harm
                        (Path(above) / name).unlink()

    @contextmanager
    def _unfinished(self, name: str, data: bytes) -> Iterator[tuple[Path, Path]]:
        """Yield a temporary file with `data`, flushed to disk, and its target path; the temporary file is removed at
        the end."""
        path = self.path / _checked(self, name)
        temporary = path.with_name(f"{UNFINISHED}{uuid.uuid4().hex[:12]}")
        with _one_line(path, "written"):
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                with temporary.open("xb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
                yield temporary, path
            finally:
                temporary.unlink(missing_ok=True)

    def _flush(self, names: Iterable[str]) -> None:
        """Wait until the names of these files, and of the folders that lead to them, are on disk."""
        inner = {folder for name in names for folder in self._path(name).parents}
        with _one_line(self.path, "written"):
            for folder in sorted(inner - set(self.path.absolute().parents) - set(self.path.parents), reverse=True):
                sync_folder(folder)
            sync_folder(self.path.parent)

    def _path(self, name: str) -> Path:
        return self.path / _checked(self, name) if name else self.path


class Bucket(Place):
    """Files below a prefix of an object store."""

    def __init__(self, url: str):
        self.url = url.rstrip("/")
        _obstore()

    def __str__(self) -> str:
        return self.url

    def __truediv__(self, name: str) -> Bucket:
        return Bucket(f"{self.url}/{_checked(self, name)}")

    def find(self, name: str, most: int = MAX_FILE) -> bytes | None:
        """Return the contents of an object, None if missing."""
        with self._one_line(name):
            try:
                got = self._store.get(_checked(self, name))
                if got.meta["size"] > most:
                    raise MapFileError(f"{self}/{name}: {got.meta['size']} bytes; at most {most} are read")
                return got.bytes().to_bytes()
            except FileNotFoundError as error:
                if "NoSuchBucket" in str(error):
                    raise
                return None

    def write(self, name: str, data: bytes) -> None:
        """Put an object; stores do this whole or not at all."""
        with self._one_line(name):
            self._store.put(_checked(self, name), data)

    def create(self, name: str, data: bytes) -> bool:
        """Put an object if there is none."""
        with self._one_line(name):
            try:
                self._store.put(_checked(self, name), data, mode="create")
            except _obstore().exceptions.AlreadyExistsError:
                return False
            return True

    def sizes(self, prefix: str = "") -> dict[str, int]:
        """Return names and bytes of the objects. Stores only list by whole parts of names; the rest is filtered
        here."""
        return {item["path"]: item["size"] for item in self._listed(prefix)}

    def versions(self, prefix: str = "") -> dict[str, list[Any]]:
        """Return the names of files as `sizes` does, with bytes and a tag that changes with the contents.

        Empty objects that represent folders, as consoles of stores create them, are left out.
        """
        found = self._listed(prefix)
        folders = {above for item in found for above in _folders_above(item["path"])}
        return {
            item["path"]: [item["size"], item["e_tag"] or str(item["last_modified"])]
            for item in found
            if item["path"] not in folders
        }

    def _listed(self, prefix: str) -> list[Any]:
        within = prefix.rpartition("/")[0] or None
        with self._one_line(prefix):
            found = [item for part in self._store.list(within) for item in part if item["path"].startswith(prefix)]
        return sorted(found, key=lambda item: item["path"])

    def remove(self, names: Iterable[str]) -> None:
        """Delete many objects with one request."""
        if listed := [_checked(self, name) for name in names]:
            with self._one_line(listed[0]):
                self._store.delete(listed)

    def write_all(self, files: dict[str, bytes]) -> None:
        """Put several objects at a time."""
        with ThreadPoolExecutor(AT_ONCE) as pool:
            list(pool.map(self.write, files.keys(), files.values()))

    def tidy(self) -> None:
        """Do nothing: a store keeps no incomplete objects."""

    @cached_property
    def _store(self) -> Any:
        _obstore()
        from obstore import store

        make: Any = store.from_url  # its stubs have a separate overload for each store
        return make(self.url, retry_config=RETRIES)

    @contextmanager
    def _one_line(self, name: str) -> Iterator[None]:
        """Turn errors of the store into a MapFileError of one line."""
        known = _obstore().exceptions
        try:
            yield
        except (known.PermissionDeniedError, known.UnauthenticatedError):
            cure = "the store denies access; check the credentials (AWS_ACCESS_KEY_ID and so on)"
            raise MapFileError(f"{self}/{name}: {cure}") from None
        except (known.BaseError, OSError) as error:
            if isinstance(error, FileNotFoundError) or "NoSuchBucket" in str(error):  # the latter from listings
                raise NoBucketError(f"{self}: there is no such bucket; check the name, or create it") from None
            reason = str(error).partition("\n")[0].strip()[:200]
            raise MapFileError(
                f"{self}/{name}: the store cannot be used ({reason}); check AWS_ENDPOINT_URL, keys and the network"
            ) from None


def _folders_above(name: str) -> Iterator[str]:
    """Yield the names of the folders that lead to a file."""
    while name:
        name = name.rpartition("/")[0]
        yield name


def _checked(place: Place, name: str) -> str:
    """Return a name; raises MapFileError if it leads out of the place."""
    parts = name.split("/")
    if not name or "\0" in name or "\\" in name or any(part in ("", ".", "..") for part in parts):
        raise MapFileError(f"{place}: '{name}' is not a valid file name")
    return name


def _obstore() -> Any:
    try:
        import obstore
        import obstore.exceptions
    except ImportError:
        raise MissingExtra("obstore", "fleet") from None
    return obstore


@contextmanager
def _one_line(path: Path, what: str) -> Iterator[None]:
    """Turn errors of the system into a MapFileError of one line."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or error
        raise MapFileError(f"{path}: cannot be {what} ({reason}); check the name, permissions and free space") from None
