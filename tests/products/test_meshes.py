# SPDX-License-Identifier: Apache-2.0
"""Outer faces of cells, and the files that hold them as another program reads them."""

import json

import numpy as np
import pytest
import trimesh

from stereovox.config import load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.maps import VoxelMap
from stereovox.products import export
from stereovox.products.cube_faces import cube_faces
from stereovox.products.floor_axes import upright_axes

ENDINGS = (".glb", ".obj", ".stl")


def map_of(cells, **settings):
    return VoxelMap.from_cells(load_config(voxel_size=0.5, **settings), cells, np.full(len(cells), 3.0))


def faces_of(cells):
    """Each outer face of cells, one by one: its middle and the direction it faces, in cells."""
    cells = set(map(tuple, cells))
    found = set()
    for cell in cells:
        for axis in range(3):
            for side in (-1, 1):
                step = np.eye(3, dtype=int)[axis] * side
                if tuple(np.add(cell, step)) not in cells:
                    found.add((*(np.add(cell, 0.5) + step / 2), *step))
    return found


def buffers(path):
    """Places and colours of the vertices in a .glb (trimesh leaves colours out where there is a material)."""
    content = path.read_bytes()
    size = int.from_bytes(content[12:16], "little")
    scene, body = json.loads(content[20 : 20 + size]), content[28 + size :]
    views = [body[view["byteOffset"] :][: view["byteLength"]] for view in scene["bufferViews"]]
    return np.frombuffer(views[0], "<f4").reshape(-1, 3), np.frombuffer(views[1], np.uint8).reshape(-1, 4)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_another_program_sees_the_cells(tmp_path, ending, up):
    cells = np.unique(np.random.default_rng(3).integers(-4, 4, (90, 3)), axis=0)
    export(map_of(cells, up=up), tmp_path / f"map{ending}")
    scene = trimesh.load(tmp_path / f"map{ending}", force="scene")
    mesh = scene.to_mesh()
    middles = mesh.triangles.mean(axis=1)
    turn = np.eye(3)
    if ending == ".glb":  # y is up there
        x, y, z = upright_axes(up)
        turn = np.stack([x, z, -y])
        axis = np.eye(3)["xyz".index(up[-1])]
        np.testing.assert_array_equal(turn @ (-axis if up.startswith("-") else axis), [0, 1, 0])
    triangles, normals = mesh.triangles @ turn, mesh.face_normals @ turn
    pairs = {}
    for triangle, normal in zip(triangles / 0.5, np.rint(normals), strict=True):
        low, high = triangle.min(axis=0), triangle.max(axis=0)
        pairs.setdefault((*((low + high) / 2).round(4), *normal), []).append(triangle)
    assert set(pairs) == faces_of(cells)
    assert all(len(pair) == 2 for pair in pairs.values())
    assert middles.shape == (2 * len(pairs), 3)


def test_equal_corners_are_one_vertex_and_height_is_colour(tmp_path):
    made = map_of([[0, 0, 0], [0, 0, 1]])
    assert len(cube_faces(made).vertices) == 12
    export(made, tmp_path / "map.glb")
    vertices, colours = buffers(tmp_path / "map.glb")
    low, high = vertices[:, 2] == 0, vertices[:, 2] == 1
    assert low.sum() == high.sum() == 4
    assert (colours[low][:, 2] > colours[low][:, 0]).all()  # from blue
    assert (colours[high][:, 0] > colours[high][:, 2]).all()  # to red


@pytest.mark.parametrize("ending", ENDINGS)
def test_maps_without_a_surface(tmp_path, ending):
    free = VoxelMap.from_cells(load_config(), [[0, 0, 0]], [-3.0])
    for empty in (VoxelMap(load_config()), free):
        with pytest.raises(MapFileError, match="holds no occupied cell"):
            export(empty, tmp_path / f"map{ending}")
    with pytest.raises(StereovoxError, match="crop it"):
        export(map_of([[0, 0, 0], [0, 1 << 22, 0]]), tmp_path / f"map{ending}")
    assert not list(tmp_path.iterdir())
