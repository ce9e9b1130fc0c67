# SPDX-License-Identifier: Apache-2.0
"""A map's surface as `.obj` and `.stl`, for modellers, simulators and printers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, MissingExtra, StereovoxError
from stereovox.files import replacing
from stereovox.maps import VoxelMap
from stereovox.products.mesh import Mesh, surface

STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])


def write_obj(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the surface about the occupied cells (`mesh.surface`) as text: metres, in the map's own frame.

    Raises MapFileError for a map without occupied cells and a place that cannot be written, MissingExtra without
    scikit-image.
    """
    mesh = _mesh(voxel_map, path)
    with replacing(path) as file:
        file.write(b"# stereovox: surface of occupied cells, metres\n")
        np.savetxt(file, mesh.vertices, "v %.7g %.7g %.7g")
        np.savetxt(file, mesh.faces + 1, "f %d %d %d")


def write_stl(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the surface about the occupied cells (`mesh.surface`) as binary STL: metres, in the map's own frame.

    Raises as `write_obj` does.
    """
    mesh = _mesh(voxel_map, path)
    triangles = np.zeros(len(mesh.faces), STL_FACE)
    triangles["corners"] = mesh.vertices[mesh.faces]
    triangles["normal"] = _normals(triangles["corners"])
    with replacing(path) as file:
        file.write(b"stereovox: surface of occupied cells, metres".ljust(80))
        file.write(np.uint32(len(triangles)).astype("<u4").tobytes())
        file.write(triangles.tobytes())


def _mesh(voxel_map: VoxelMap, path: str | Path) -> Mesh:
    try:
        return surface(voxel_map)
    except MissingExtra:
        raise
    except StereovoxError as error:
        raise MapFileError(f"{path}: {error}") from None


def _normals(corners: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the (N, 3) directions, of length 1, that triangles (N, 3, 3) face."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
