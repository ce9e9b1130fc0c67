# SPDX-License-Identifier: Apache-2.0
"""Arrays in one `.npz` file from strangers: nothing is allocated for a size that lies, nothing is executed."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError

SMALL, PACKED_BEST = 1 << 26, 200
"""A file may unpack to so many bytes, or to so many for each of its own; more is taken for a lie."""


def read_arrays(path: str | Path, names: Sequence[str], what: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of a file that holds those called `names` and no others.

    what: what the file should be, for messages. Raises MapFileError where it holds other arrays; what a damaged file
    can raise in zipfile, zlib and NumPy is not bounded: catch Exception.
    """
    with zipfile.ZipFile(path) as file:
        sizes = {entry.filename: entry.file_size for entry in file.infolist()}
        kinds = {entry.compress_type for entry in file.infolist()}
        if len(file.infolist()) != len(names) or set(sizes) != {f"{name}.npy" for name in names}:
            raise MapFileError(f"{path}: holds no {what}")
        if not kinds <= {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
            raise ValueError("packed in a way that is not used here")
        if sum(sizes.values()) > max(SMALL, PACKED_BEST * Path(path).stat().st_size):
            raise ValueError(f"unpacks to {sum(sizes.values())} bytes")
        return {name: _array(file, f"{name}.npy", sizes[f"{name}.npy"]) for name in names}


def _array(file: zipfile.ZipFile, name: str, size: int) -> NDArray[Any]:
    """Return an array of a file whose entry has `size` bytes unpacked; nothing is allocated for a shape that lies."""
    with file.open(name) as entry:
        data = entry.read(size)
    stream = io.BytesIO(data)
    version = np.lib.format.read_magic(stream)
    shape, _, dtype = getattr(np.lib.format, f"read_array_header_{version[0]}_{version[1]}")(stream)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(data) - stream.tell():
        raise ValueError(f"{name} tells of {shape} {dtype} and holds {len(data) - stream.tell()} bytes")
    return np.frombuffer(data, dtype, offset=stream.tell()).reshape(shape)
