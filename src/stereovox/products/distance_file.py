# SPDX-License-Identifier: Apache-2.0
"""A distance field as a file of NumPy arrays."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereovox.errors import StereovoxError
from stereovox.files import replacing
from stereovox.products.distance import DistanceField


def write_distance(field: DistanceField, path: str | Path) -> None:
    """Write a field for `numpy.load`.

    Arrays: `distance` (x, y, z) float32 metres, infinite where no obstacle is near enough; `origin` (3,) metres, lowest
    corner of cell [0, 0, 0]; `cell` (3,) metres, its sides. Cell (i, j, k) has its middle at origin + (i + 0.5, ...)
    times cell. Raises StereovoxError for another ending than .npz, MapFileError where it cannot be written.
    """
    if Path(path).suffix.lower() != ".npz":
        raise StereovoxError(f"{path}: distances are written as .npz; name the file so")
    with replacing(path) as file:
        np.savez_compressed(file, distance=field.metres, origin=field.origin, cell=field.cell)
