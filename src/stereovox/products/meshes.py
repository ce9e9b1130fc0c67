# SPDX-License-Identifier: Apache-2.0
"""A map as a mesh file, written by trimesh: `.glb` for browsers and phones, `.obj` and `.stl` for modellers.

A `.glb` (Khronos glTF 2.0) shows the outer faces of the cells, the others the smoothed surface of `mesh.surface`. The
faces of the cells are found here: trimesh would keep those between two occupied cells, which nobody sees.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, MissingExtra, StereovoxError
from stereovox.files import replacing
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import upright_axes
from stereovox.products.mesh import Mesh, surface
from stereovox.products.points import height_colours

if TYPE_CHECKING:
    from trimesh import Trimesh
    from trimesh.visual import TextureVisuals

SPAN = 1 << 21
"""Corners of cells on each axis that three of them fit into one int64."""
TRIANGLES = ((0, 1, 2), (0, 2, 3))
TITLE = "stereovox: surface of occupied cells, metres"
STL_TITLE_BYTES = 80
OBJ_DIGITS = 6
"""Decimals of a coordinate in an `.obj`: a micrometre."""


def write_glb(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the outer faces of the occupied cells, coloured by height; glTF's y is the map's `up`, units are metres.

    Vertices are in the map's own frame, a node turns them. Raises MapFileError for a map without occupied cells and
    for a place that cannot be written.
    """
    from trimesh import Scene
    from trimesh.exchange.gltf import export_glb
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    mesh = cube_faces(voxel_map)
    if not len(mesh.faces):
        raise MapFileError(f"{path}: the map holds no occupied cell, there is nothing to show")
    across, along, up = upright_axes(voxel_map.config.up)
    turn = np.eye(4)
    turn[:3, :3] = [across, up, -along]
    matt = TextureVisuals(material=PBRMaterial(metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True))
    matt.vertex_attributes["color"] = _linear_colours(mesh.vertices @ up)
    scene = Scene()
    scene.add_geometry(_trimesh(mesh, matt), node_name="map", geom_name="map", transform=turn)
    content = export_glb(scene, include_normals=False)
    with replacing(path) as file:
        file.write(content)


def write_obj(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the surface about the occupied cells (`mesh.surface`) as text: metres, in the map's own frame.

    Raises MapFileError for a map without occupied cells and a place that cannot be written, MissingExtra without
    scikit-image.
    """
    from trimesh.exchange.obj import export_obj

    text = export_obj(_surface(voxel_map, path), include_normals=False, digits=OBJ_DIGITS, header=TITLE)
    with replacing(path) as file:
        file.write(f"{text}\n".encode())


def write_stl(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the surface about the occupied cells (`mesh.surface`) as binary STL: metres, in the map's own frame.

    Raises as `write_obj` does.
    """
    from trimesh.exchange.stl import export_stl

    content = export_stl(_surface(voxel_map, path))
    with replacing(path) as file:
        file.write(TITLE.encode().ljust(STL_TITLE_BYTES))
        file.write(memoryview(content)[STL_TITLE_BYTES:])


def cube_faces(voxel_map: VoxelMap) -> Mesh:
    """Return each face between an occupied cell and one that is not, as two triangles; equal corners are one vertex.

    Raises StereovoxError for a map that is too wide.
    """
    cells = voxel_map.cells_in(State.OCCUPIED).astype(np.int64)
    lowest = cells.min(axis=0) - 1 if len(cells) else np.zeros(3, np.int64)
    cells = cells - lowest
    if len(cells) and cells.max() + 1 >= SPAN:
        raise StereovoxError(f"a map of more than {SPAN - 2} cells in a row has no picture; crop it")
    present = np.sort(_codes(cells))
    quads = [_quads(cells, present, axis, side) for axis in range(3) for side in (0, 1)]
    corners = np.concatenate([np.zeros((0, 4, 3), np.int64), *quads])
    codes, of_corner = np.unique(_codes(corners.reshape(-1, 3)), return_inverse=True)
    faces = of_corner.reshape(-1, 4)[:, TRIANGLES].reshape(-1, 3)
    vertices = (_places(codes) + lowest) * np.array(voxel_map.config.cell)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))


def _quads(cells: NDArray[np.int64], present: NDArray[np.int64], axis: int, side: int) -> NDArray[np.int64]:
    """Return the corners (n, 4, 3) of all outer faces on one side (0 below, 1 above) of an axis."""
    step = np.eye(3, dtype=np.int64)
    neighbours = _codes(cells + (2 * side - 1) * step[axis])
    at = np.searchsorted(present, neighbours).clip(max=max(len(present) - 1, 0))
    outer = cells[present[at] != neighbours] if len(present) else cells
    u, v = step[(axis + 1) % 3], step[(axis + 2) % 3]
    square = np.stack([0 * u, u, u + v, v])
    return outer[:, None] + side * step[axis] + (square if side else square[::-1])


def _codes(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return one number for each place (n, 3); `_places` is the inverse."""
    x, y, z = places.T
    return (x * SPAN + y) * SPAN + z


def _places(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.stack([codes // (SPAN * SPAN), codes // SPAN % SPAN, codes % SPAN], axis=1)


def _linear_colours(heights: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return (N, 4) red, green, blue and opacity; glTF's numbers are linear, those of screens (sRGB) are not."""
    screen = height_colours(heights) / 255
    linear = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    return np.column_stack([np.rint(255 * linear), np.full(len(heights), 255)]).astype(np.uint8)


def _surface(voxel_map: VoxelMap, path: str | Path) -> Trimesh:
    try:
        return _trimesh(surface(voxel_map))
    except MissingExtra:
        raise
    except StereovoxError as error:
        raise MapFileError(f"{path}: {error}") from None


def _trimesh(mesh: Mesh, visual: TextureVisuals | None = None) -> Trimesh:
    """Return the mesh as trimesh's, with the same vertices and faces in the same order."""
    from trimesh import Trimesh

    return Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
