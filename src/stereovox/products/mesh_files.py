# SPDX-License-Identifier: Apache-2.0
"""A map's surface as `.obj` and `.stl`, for modellers, simulators and printers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError
from stereovox.files import replacing
from stereovox.maps import VoxelMap
from stereovox.products.cube_faces import Faces, cube_faces

STL_FACE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])


def write_obj(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the outer faces of the occupied cells as text: metres, in the map's own frame.

    Raises MapFileError for a map without occupied cells and for a place that cannot be written.
    """
    mesh = _mesh(voxel_map, path)
    with replacing(path) as file:
        file.write(b"# stereovox: outer faces of occupied cells, metres\n")
        np.savetxt(file, mesh.vertices, "v %.7g %.7g %.7g")
        np.savetxt(file, mesh.faces + 1, "f %d %d %d")


def write_stl(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the outer faces of the occupied cells as binary STL: metres, in the map's own frame.

    Raises MapFileError for a map without occupied cells and for a place that cannot be written.
    """
    mesh = _mesh(voxel_map, path)
    triangles = np.zeros(len(mesh.faces), STL_FACE)
    triangles["corners"] = mesh.vertices[mesh.faces]
    triangles["normal"] = _normals(triangles["corners"])
    with replacing(path) as file:
        file.write(b"stereovox: outer faces of occupied cells, metres".ljust(80))
        file.write(np.uint32(len(triangles)).astype("<u4").tobytes())
        file.write(triangles.tobytes())


def _mesh(voxel_map: VoxelMap, path: str | Path) -> Faces:
    mesh = cube_faces(voxel_map)
    if not len(mesh.faces):
        raise MapFileError(f"{path}: the map holds no occupied cell, there is no surface to write")
    return mesh


def _normals(corners: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the (N, 3) directions, of length 1, that triangles (N, 3, 3) face."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
