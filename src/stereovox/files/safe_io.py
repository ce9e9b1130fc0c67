# SPDX-License-Identifier: Apache-2.0
"""Safe files: written all or nothing, and read within bounds, whoever wrote them.

Writing comes first (`check_file`, `replacing`, `sync_*`), then reading of text, TOML, JSON, YAML and arrays.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import math
import os
import re
import reprlib
import stat
import tomllib
import uuid
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, SourceError, StereovoxError

FLOOR_ENDINGS = (".yaml", ".pgm", ".png")
"""Endings of 2-D maps; the picture and its .yaml are written together, whichever is named."""
FLOOR_READABLE = (*FLOOR_ENDINGS, ".yml")
"""Endings of 2-D maps that can be read."""
SMALL, MAX_PACKING = 1 << 26, 200
"""Archives that claim to unpack to more bytes, and to more than this many times their own size, are rejected."""
MAX_LIST = 1 << 28
"""Most bytes of a list with one line per image or pose."""
MAX_SETTINGS = 1 << 16
"""Most bytes of a settings file or of one calibration."""
MAX_YAML = 1 << 14
"""Most bytes of a small YAML file; each byte takes 20 us to parse."""
MAX_DOTS = 200
"""Most dots in one line of TOML; parsing a key `a.b.c` takes time quadratic in its dots."""
MAX_DEPTH = 64
"""Deepest nesting of brackets in YAML."""
BRACKETS = re.compile(r"[\[\]{}]")
URL = re.compile(r"(s3|s3a|gs|az|abfs|abfss)://.+", re.DOTALL)
"""Names of places in object stores."""
MAX_COUNT = 1 << 62
"""Upper limit of counts in files."""
MAX_NODES = 100_000
"""Most values in a YAML file, with aliases counted as often as they repeat."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of a zstd frame."""
SEAL = re.compile(rb'{"digest": "([0-9a-f]{32})", ')
"""Start of the output of `sealed`."""
MAX_NUMBER = 1e300
"""Bound of numbers in settings: TOML's integers are unbounded, floats are not."""


def check_in_space(out: str | Path) -> None:
    """Raise StereovoxError if a 3-D map would be given the file name of a 2-D map."""
    if Path(out).suffix.lower() in FLOOR_READABLE:
        raise StereovoxError(f"{out}: names a floor's map; give a map in space the ending .svox, or none")


def is_url(where: str | os.PathLike[str]) -> bool:
    """Return whether a name is a URL of an object store."""
    return bool(URL.fullmatch(os.fspath(where)))


def check_local(out: str | Path, error: type[StereovoxError] = StereovoxError) -> None:
    """Raise `error` if a file or folder that can only be local is named as a URL, or as a path made from one."""
    if is_url(url := str(Path(out)).replace(":/", "://", 1)):  # Path turns the two slashes of a URL into one
        raise error(f"{url}: only maps in boxes can be in an object store (fleet); choose a local name")


def check_file(out: str | Path, endings: Iterable[str]) -> Path:
    """Return `out` as a path. Raises StereovoxError, before any work, if it cannot be written."""
    check_local(out)
    path = Path(out)
    if path.suffix.lower() not in endings:
        raise StereovoxError(f"{out}: give a name that ends in {' or '.join(endings)}")
    if os.path.isdir(out):
        raise StereovoxError(f"{out}: is a folder; name a file")
    check_folder(path.absolute().parent, str(out))
    return path


def check_folder(folder: Path, name: str) -> None:
    """Raise StereovoxError unless files can be created in `folder`; `name` is the file shown in messages."""
    if not folder.is_dir():
        raise StereovoxError(f"{name}: there is no folder {folder}; create it or choose another")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise StereovoxError(f"{name}: {folder} cannot be written to; choose another folder")


@contextmanager
def replacing(path: str | Path, error: type[StereovoxError] = MapFileError) -> Iterator[IO[bytes]]:
    """Yield a binary file that replaces `path` when the block ends without error; otherwise `path` is unchanged.

    Raises `error` if the folder is missing or cannot be written, the disk is full, or the name is a URL.
    """
    check_local(path, error)
    target = Path(os.path.realpath(path))  # keep a symbolic link
    temporary = target.with_name(f".{short_name(target)}.{uuid.uuid4().hex[:12]}.new")
    try:
        if target.is_dir():
            raise error(f"{path}: is a folder; name a file")
        if target.exists() and not target.is_file():
            raise error(f"{path}: is not a plain file and cannot be replaced; name another")
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
        sync_folder(target.parent)
    except OSError as failed:
        reason = f"cannot be written ({failed.strerror or failed})"
        raise error(f"{path}: {reason}; choose an existing folder with free space and write permission") from None
    finally:
        _remove(temporary)


def sweep_unfinished(*paths: Path) -> None:
    """Remove the temporary files that a killed `replacing` left for these files; no one else may be writing them."""
    for target in map(Path, map(os.path.realpath, paths)):
        left = re.compile(rf"\.{re.escape(short_name(target))}\.[0-9a-f]{{12}}\.new")
        with suppress(OSError):  # a leftover does no harm
            for entry in target.parent.iterdir():
                if left.fullmatch(entry.name):
                    entry.unlink()


def sync_file(path: Path) -> None:
    """Flush the contents of a file to the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """Flush the entries of `folder` to the disk: created, renamed and removed names."""
    try:
        number = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return  # a folder may be writable but not readable; some systems cannot flush it
    try:
        os.fsync(number)
    except OSError as error:
        if error.errno != errno.EINVAL:  # the file system cannot flush folders
            raise
    finally:
        os.close(number)


def sync_tree(folder: Path) -> None:
    """Flush all files below `folder`, and their names, to the disk."""
    for place, _, names in os.walk(folder, topdown=False):
        for name in names:
            sync_file(Path(place) / name)
        sync_folder(Path(place))


def read_bounded(path: Path, most: int = MAX_SETTINGS) -> bytes:
    """Return the bytes of a file. Raises OSError if it is unreadable, larger than `most`, or not a plain file.

    Pipes would block, and devices never end.
    """
    with _plain_file(path) as (file, size):
        if size > most:
            raise OSError(errno.EOVERFLOW, f"holds more than {most} bytes, too many for such a file")
        return file.read(size)  # read() would allocate any size it is given


def read_part(path: Path, start: int, size: int) -> bytes:
    """Return `size` bytes of a file from an offset, fewer if it ends earlier. Raises OSError as `read_bounded`."""
    with _plain_file(path) as (file, whole):
        file.seek(start)
        return file.read(min(size, whole))


def read_text(path: Path, most: int = MAX_SETTINGS, errors: str = "strict") -> str:
    """Return the text (UTF-8) of a file. Raises OSError as `read_bounded`, UnicodeDecodeError if it is not text."""
    return read_bounded(path, most).decode("utf-8-sig", errors)


def toml_table(text: str) -> dict[str, Any]:
    """Parse TOML. Raises ValueError, one line."""
    if any(line.count(".") > MAX_DOTS for line in text.splitlines()):
        raise ValueError(f"a line with more than {MAX_DOTS} dots")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def json_value(text: str | bytes) -> Any:
    """Parse JSON. Raises ValueError, one line."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def sealed(values: Mapping[str, Any], default: Callable[[Any], Any] | None = None, indent: int | None = None) -> bytes:
    """Return values as a JSON object that begins with a digest of the rest, so that any damage is detected.

    default: converts types that JSON lacks, as in `json.dumps`.
    """
    body = json.dumps(values, default=default, indent=indent).encode()[1:]
    return b'{"digest": "%s", ' % _digest(body) + body


def unsealed(data: bytes) -> dict[str, Any]:
    """Return the values of `sealed`, without the digest. Raises ValueError, one line, for damage."""
    begun = SEAL.match(data)
    if begun is None:
        raise ValueError("it does not begin with a digest")
    if begun[1] != _digest(data[begun.end() :]):
        raise ValueError("it does not match its digest")
    return json_value(b"{" + data[begun.end() :])


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).hexdigest().encode()


def yaml_value(text: str | bytes, loader_class: Any = None) -> Any:
    """Parse YAML with a SafeLoader: plain values only. Raises ValueError, one line.

    Aliases may repeat values, but may not contain themselves or expand to more than `MAX_NODES` values.
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
    """Return the count under `key`. Raises KeyError if it is missing, ValueError if it is not a count."""
    count = table[key]
    if type(count) is not int or not 0 <= count < MAX_COUNT:
        raise ValueError(f"{key} {shown(count)} is not a count")
    return count


def zstd_size(head: bytes) -> int | None:
    """Return the unpacked size that a zstd frame declares in its first 18 bytes (RFC 8878, 3.1.1).

    None if it declares no size or is not a zstd frame.
    """
    if len(head) < 6 or head[:4] != ZSTD:
        return None
    flags = head[4]
    alone, dictionary, length = flags >> 5 & 1, (0, 1, 2, 4)[flags & 3], (0, 2, 4, 8)[flags >> 6]
    length = length or alone
    start = 5 + (1 - alone) + dictionary
    size = int.from_bytes(head[start : start + length], "little")
    return (size + 256 if length == 2 else size) if length and len(head) >= start + length else None


def shown(value: Any) -> str:
    """Return a short text of any value, for messages."""
    return _SHORT.repr(value)


def read_table(path: Path) -> dict[str, Any]:
    """Return the table in a TOML file. Raises SourceError if it is unreadable or not TOML."""
    try:
        return toml_table(read_text(path))
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a readable TOML file") from None
    except ValueError as error:  # bad TOML, bad UTF-8
        raise SourceError(f"{path}: {error}; correct it") from None


def read_json(path: Path) -> Any:
    """Return the value in a JSON file. Raises SourceError if it is unreadable or not JSON."""
    try:
        return json_value(read_text(path, MAX_LIST))
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    except ValueError as error:  # bad JSON, bad UTF-8
        raise SourceError(f"{path}: not valid JSON ({error}); write it again") from None


def is_number(value: Any) -> bool:
    """Return whether a value is a finite number that a float can hold."""
    return isinstance(value, int | float) and not isinstance(value, bool) and -MAX_NUMBER < value < MAX_NUMBER


def toml_text(value: Any) -> str:
    """Return a string, a number or a list of them as TOML; floats keep all digits."""
    if isinstance(value, str):
        escaped = "".join(f"\\u{ord(c):04x}" if ord(c) < 32 or c in '"\\\x7f' else c for c in value)
        return f'"{escaped}"'
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_text, value))}]"
    return repr(value if isinstance(value, int) else float(value))


def read_arrays(path: str | Path, names: Sequence[str], what: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a `.npz` file that holds exactly those in `names`.

    what: the kind of file, for messages. Raises MapFileError if it holds other arrays; a damaged file may raise any
    exception from zipfile, zlib and NumPy: catch Exception.
    """
    with zipfile.ZipFile(path) as file:
        sizes = {entry.filename: entry.file_size for entry in file.infolist()}
        kinds = {entry.compress_type for entry in file.infolist()}
        if len(file.infolist()) != len(names) or set(sizes) != {f"{name}.npy" for name in names}:
            raise MapFileError(f"{path}: holds no {what}")
        if not kinds <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise ValueError("unknown compression")
        if sum(sizes.values()) > max(SMALL, MAX_PACKING * Path(path).stat().st_size):
            raise ValueError(f"unpacks to {sum(sizes.values())} bytes")
        return {name: _array(file, f"{name}.npy", sizes[f"{name}.npy"]) for name in names}


def short_name(target: Path) -> str:
    """Return a file's name, shortened so that a longer name made from it is still valid."""
    return os.fsdecode(os.fsencode(target.name)[:200])


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError:
        return  # the folder is read-only, so the file was never created


@contextmanager
def _plain_file(path: Path) -> Iterator[tuple[IO[bytes], int]]:
    """Open a file for reading; yield it and its size. Raises OSError if it is not a plain file."""
    with open(path, "rb", opener=_without_waiting) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise OSError(errno.EINVAL, "not a file")
        yield file, status.st_size


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _check_brackets(text: str) -> None:
    """Raise ValueError if brackets nest deeper than `MAX_DEPTH`; PyYAML's time grows with the square of the depth."""
    depth = 0
    for bracket in BRACKETS.findall(text):
        depth = depth + 1 if bracket in "[{" else max(depth - 1, 0)
        if depth > MAX_DEPTH:
            raise ValueError("nested too deeply")


def _unfolded(node: Any, known: dict[int, int]) -> int:
    """Return the number of values in a node. Raises ValueError if there are too many, or it contains itself."""
    if isinstance(node.value, str):
        return 1
    if id(node) not in known:
        known[id(node)] = 0  # while it is being counted
        parts = [part for item in node.value for part in (item if isinstance(item, tuple) else (item,))]
        known[id(node)] = 1 + sum(_unfolded(part, known) for part in parts)
    if not 0 < known[id(node)] <= MAX_NODES:
        raise ValueError("aliases that contain themselves or expand to too many values")
    return known[id(node)]


def _array(file: zipfile.ZipFile, name: str, size: int) -> NDArray[Any]:
    """Return an array from an entry of `size` unpacked bytes; a false shape allocates nothing."""
    with file.open(name) as entry:
        data = entry.read(size)
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    shape, _, dtype = getattr(np.lib.format, f"read_array_header_{version[0]}_{version[1]}")(stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"{name} claims {shape} {dtype} and holds {len(data) - stream.tell()} bytes")
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape)


class _Short(reprlib.Repr):
    """Python's own short texts, also for integers too long for Python to convert."""

    def repr_int(self, x: int, level: int) -> str:
        return repr(x) if x.bit_length() < 256 else f"{x if x.bit_length() < 13_000 else hex(x)}"[:60] + "..."


_SHORT = _Short()
_SHORT.maxlevel, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxdict, _SHORT.maxstring = 4, 16, 16, 4, 80
