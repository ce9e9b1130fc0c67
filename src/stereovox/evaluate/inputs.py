# SPDX-License-Identifier: Apache-2.0
"""Inputs of an evaluation: maps of stereovox or OctoMap, and camera paths."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, SourceError
from stereovox.evaluate.curves import distances
from stereovox.evaluate.truth_cells import TruthCells
from stereovox.files.safe_io import MAX_LIST, read_text
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.files.store import is_map

COLUMNS = {3: (0, 1, 2), 8: (1, 2, 3), 9: (1, 2, 3), 12: (3, 7, 11), 16: (3, 7, 11)}
"""Columns of x, y, z by numbers per line: x y z; TUM, with or without a confidence; 3x4 and 4x4 matrices."""


STRAYING = 1.5
"""A path fits only if surfaces are within this many times the map's range."""


def read_camera_path(path: str | Path) -> NDArray[np.float64]:
    """Read camera positions (P, 3) in metres from a text file with one pose per line; `#` starts a comment.

    A line has x y z, or `stamp x y z qx qy qz qw` (TUM), or the 12 (KITTI) or 16 numbers of a matrix row by row.
    Raises SourceError: one line with the file and what is wrong.
    """
    try:
        with warnings.catch_warnings(action="ignore"):  # an empty file is refused below
            table = np.loadtxt(read_text(Path(path), MAX_LIST).splitlines(), ndmin=2)
    except (OSError, ValueError) as error:
        raise SourceError(f"{path}: cannot be read as poses ({error}); give one pose a line") from None
    if table.shape[1] not in COLUMNS or not np.isfinite(table).all() or not len(table):
        raise SourceError(f"{path}: {len(table)} lines of {table.shape[1]} numbers; give 3, 8, 12 or 16 a line")
    return table[:, COLUMNS[table.shape[1]]]


def path_fits(path: NDArray[np.float64], truth: TruthCells, max_range: float) -> bool:
    """Return whether a path (P, 3) fits the truth: half of the surfaces are within reach of a position.

    max_range: of the map, in metres. A path in another frame than the map's world rarely fits.
    """
    surfaces = truth.centers()[truth.occupied]
    return bool(2 * np.count_nonzero(distances(surfaces, path) > STRAYING * max_range) <= len(surfaces))


def read_map(path: str | Path) -> VoxelMap:
    """Read a map from a stereovox folder or an OctoMap file (`.bt`, `.ot`).

    Raises MapFileError: one line with the file and what is wrong.
    """
    from stereovox.opening import is_recording

    if Path(path).suffix.lower() in (".bt", ".ot") and not Path(path).is_dir():
        from stereovox.formats.octomap import read_octomap

        return read_octomap(path)
    if not is_map(path) and is_recording(path):
        cure = f"make a map of it with 'stereovox map', or the truth with 'stereovox truth {path} --out truth.svox'"
        raise MapFileError(f"{path}: is a recording, no map; {cure}")
    return load_map(path)
