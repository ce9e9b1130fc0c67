# SPDX-License-Identifier: Apache-2.0
"""Maps as meshes, written by trimesh: `.glb` for browsers and phones, `.obj` and `.stl` for modelling programs.

A `.glb` (Khronos glTF 2.0) shows the outer faces of the cells, the others the smooth surface of `surface`. Cell faces
are found here, because trimesh would keep the invisible ones between two occupied cells.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, MissingExtra, StereovoxError
from stereovox.files.safe_io import replacing
from stereovox.formats.points import height_colours
from stereovox.kernels.threads import one_state
from stereovox.maps import State, VoxelMap
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.storage.blocks import SIDE
from stereovox.products.blocks import cells_at, in_memory
from stereovox.products.floor_axes import upright_axes

if TYPE_CHECKING:
    from trimesh import Trimesh
    from trimesh.visual import TextureVisuals

GROUP = 8
"""Blocks along each side of the cubes in which the map is processed."""
MIN_OFFSET = 0.05
"""Smallest distance of a vertex from a cell centre, as a share of the distance to the next centre."""
SPAN = 1 << 21
"""Most corners of cells on an axis, so that three coordinates fit into one int64."""
TRIANGLES = ((0, 1, 2), (0, 2, 3))
TITLE = "stereovox: surface of occupied cells, metres"
STL_TITLE_BYTES = 80
OBJ_DIGITS = 6
"""Decimals of a coordinate in an `.obj`: a micrometre."""


@one_state
def surface(voxel_map: VoxelMap) -> Mesh:
    """Extract the closed surface around the occupied cells: every occupied centre is inside, every other outside.

    Marching cubes (Lorensen and Cline 1987, by the tables of Lewiner et al. 2003): the surface is where the log-odds,
    linear between neighbouring cell centres, cross the threshold of occupied cells. Unknown cells count as certainly
    free, so that nothing is invented: towards them the surface reaches no farther than the occupied cell's own face. A
    wall seen from one side still has two sides: it is as thick as its cells.

    Args:
        voxel_map: The map.

    Returns:
        The mesh.

    Raises:
        StereovoxError: Nothing is occupied.
        MissingExtra: scikit-image is not installed.
    """
    voxel_map = in_memory(voxel_map)
    parts = [part for part in _parts(voxel_map) if len(part[1])]
    if not parts:
        raise StereovoxError("nothing is occupied in the map: it has no surface")
    first = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + start for start, (_, faces) in zip(first[:-1], parts, strict=True)])
    _, kept, same = np.unique(_names(vertices), axis=0, return_index=True, return_inverse=True)
    metres = (vertices[kept] + 0.5) * voxel_map.config.cell
    return Mesh(metres.astype(np.float32), same.ravel()[faces].astype(np.int32))


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (N, 3) float32 metres, world frame.
        faces: (M, 3) int32, anticlockwise seen from outside.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]


def write_glb(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the outer faces of the occupied cells, coloured by height; glTF's y is the map's `up`, units are metres.

    Vertices are in the map's own frame; a node rotates them. Raises MapFileError if the map has no occupied cells or
    the file cannot be written.
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
    """Write the surface around the occupied cells (`surface`) as text: metres, in the map's own frame.

    Raises MapFileError if no cell is occupied or the file cannot be written, MissingExtra without scikit-image.
    """
    from trimesh.exchange.obj import export_obj

    text = export_obj(_surface(voxel_map, path), include_normals=False, digits=OBJ_DIGITS, header=TITLE)
    with replacing(path) as file:
        file.write(f"{text}\n".encode())


def write_stl(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the surface around the occupied cells (`surface`) as binary STL: metres, in the map's own frame.

    Raises as `write_obj` does.
    """
    from trimesh.exchange.stl import export_stl

    content = export_stl(_surface(voxel_map, path))
    with replacing(path) as file:
        file.write(TITLE.encode().ljust(STL_TITLE_BYTES))
        file.write(memoryview(content)[STL_TITLE_BYTES:])


def cube_faces(voxel_map: VoxelMap) -> Mesh:
    """Return each face between an occupied cell and any other, as two triangles; equal corners are one vertex.

    Raises StereovoxError for a map that is too wide.
    """
    cells = voxel_map.cells_in(State.OCCUPIED).astype(np.int64)
    lowest = cells.min(axis=0) - 1 if len(cells) else np.zeros(3, np.int64)
    cells = cells - lowest
    if len(cells) and cells.max() + 1 >= SPAN:
        raise StereovoxError(f"a map of more than {SPAN - 2} cells in a row cannot be drawn; crop it")
    present = np.sort(_codes(cells))
    quads = [_quads(cells, present, axis, side) for axis in range(3) for side in (0, 1)]
    corners = np.concatenate([np.zeros((0, 4, 3), np.int64), *quads])
    codes, of_corner = np.unique(_codes(corners.reshape(-1, 3)), return_inverse=True)
    faces = of_corner.reshape(-1, 4)[:, TRIANGLES].reshape(-1, 3)
    vertices = (_places(codes) + lowest) * np.array(voxel_map.config.cell)
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32))


def _parts(voxel_map: VoxelMap) -> Iterator[tuple[NDArray[np.float64], NDArray[np.int64]]]:
    """Yield vertices (n, 3) in cells, with 0 at the centre of cell 0, and faces (m, 3) of each cube of blocks."""
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        raise MissingExtra("scikit-image", "mesh") from None
    for corner in _groups(voxel_map):
        field = _field(voxel_map, corner)
        if field.min() < 0 < field.max():
            vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="ascent")
            yield vertices.astype(float) + corner * SIDE, faces.astype(np.int64)


def _groups(voxel_map: VoxelMap) -> NDArray[np.int32]:
    """Return the lowest blocks (n, 3) of all cubes of blocks that the surface may cross."""
    rules, found = CellRules(voxel_map.config.map), [np.empty((0, 3), np.int32)]
    for coords, cells in voxel_map.storage.slabs():
        found.append(coords[(rules.states(cells) == State.OCCUPIED).any(axis=1)])
    blocks = np.concatenate(found)
    beside = np.concatenate([blocks - step for step in np.ndindex(2, 2, 2)])  # the cubes below end in its first layer
    return (np.unique(beside // GROUP, axis=0) * GROUP).astype(np.int32)


def _field(voxel_map: VoxelMap, corner: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return how far above the threshold each cell is, (n, n, n), negative below; one layer more than the cube has."""
    rules, side = CellRules(voxel_map.config.map), GROUP + 1
    coords = corner + np.argwhere(np.ones((side,) * 3)).astype(np.int32)
    cells = cells_at(voxel_map, coords)
    level = int(rules.thresholds.occupied_least) - 0.5
    span = max(float(rules.highest) - level, level - float(rules.lowest))
    field = np.where(cells == rules.format.unknown, -span, cells - level)
    field = np.sign(field) * np.maximum(np.abs(field), MIN_OFFSET * span)
    whole = field.reshape(side, side, side, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5).reshape((side * SIDE,) * 3)
    return whole[(slice(0, GROUP * SIDE + 1),) * 3].astype(np.float32)


def _names(vertices: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the edge between cell centres that each vertex is on, (N, 3): the same whichever cube it comes from.

    It is twice the edge's midpoint. So a vertex on no edge, of which a cube has at most one, gets its own name.
    """
    whole = np.rint(vertices)
    return (np.where(np.abs(vertices - whole) < MIN_OFFSET / 2, 2 * whole, 2 * np.floor(vertices) + 1)).astype(np.int64)


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
    """Return (N, 4) red, green, blue and opacity; glTF's colours are linear, those of screens (sRGB) are not."""
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
    """Return the mesh as trimesh's type, with the same vertices and faces in the same order."""
    from trimesh import Trimesh

    return Trimesh(mesh.vertices, mesh.faces, visual=visual, process=False)
