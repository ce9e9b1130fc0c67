# SPDX-License-Identifier: Apache-2.0
"""Outer faces of cells, and the files that hold them as another program reads them."""

import json

import numpy as np
import pytest
import trimesh

from stereovox.config import load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.formats import export
from stereovox.formats.meshes import cube_faces, surface
from stereovox.maps import VoxelMap
from stereovox.products.floor_axes import upright_axes

SURFACES = (".obj", ".stl")


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


class Glb:
    """A .glb by the words of its standard, not by the library that wrote it."""

    def __init__(self, path):
        content = path.read_bytes()
        assert (content[:8], int.from_bytes(content[8:12], "little")) == (b"glTF\2\0\0\0", len(content))
        size = int.from_bytes(content[12:16], "little")
        self.scene, self.body = json.loads(content[20 : 20 + size]), content[28 + size :]
        (self.primitive,) = self.scene["meshes"][0]["primitives"]
        self.vertices = self.values(self.primitive["attributes"]["POSITION"], "<f4", 3)
        self.colours = self.values(self.primitive["attributes"]["COLOR_0"], np.uint8, 4)
        self.faces = self.values(self.primitive["indices"], "<u4", 1).reshape(-1, 3)

    def values(self, number, kind, columns):
        accessor = self.scene["accessors"][number]
        view = self.scene["bufferViews"][accessor["bufferView"]]
        return np.frombuffer(self.body[view["byteOffset"] :][: view["byteLength"]], kind).reshape(-1, columns)

    @property
    def triangles(self):
        """In the frame of the file: y up."""
        (node,) = [node for node in self.scene["nodes"] if "mesh" in node]
        turn = np.reshape(node["matrix"], (4, 4)).T
        assert (turn[3] == [0, 0, 0, 1]).all()
        return (self.vertices @ turn[:3, :3].T + turn[:3, 3])[self.faces]


def surface_triangles(path):
    """Read .obj or .stl by the words of their descriptions."""
    if path.suffix == ".obj":
        lines = [line.split() for line in path.read_text().splitlines() if line]
        assert {line[0] for line in lines} == {"#", "v", "f"}
        vertices = np.array([line[1:] for line in lines if line[0] == "v"], float)
        return vertices[np.array([line[1:] for line in lines if line[0] == "f"], int) - 1]
    content = path.read_bytes()
    faces = np.frombuffer(content[84:], [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("colour", "<u2")])
    assert len(faces) == int.from_bytes(content[80:84], "little")
    a, b, c = np.moveaxis(faces["corners"], 1, 0)
    across = np.cross(b - a, c - a)
    np.testing.assert_allclose(faces["normal"], across / np.linalg.norm(across, axis=1, keepdims=True), atol=1e-4)
    return faces["corners"]


@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_another_program_sees_the_cells(tmp_path, up):
    cells = np.unique(np.random.default_rng(3).integers(-4, 4, (90, 3)), axis=0)
    export(map_of(cells, up=up), tmp_path / "map.glb")
    file = Glb(tmp_path / "map.glb")
    mesh = trimesh.load(tmp_path / "map.glb", force="scene").to_mesh()
    np.testing.assert_array_equal(mesh.triangles, file.triangles)
    x, y, z = upright_axes(up)
    turn = np.stack([x, z, -y])  # y is up there
    axis = np.eye(3)["xyz".index(up[-1])]
    np.testing.assert_array_equal(turn @ (-axis if up.startswith("-") else axis), [0, 1, 0])
    triangles, normals = mesh.triangles @ turn, mesh.face_normals @ turn
    pairs = {}
    for triangle, normal in zip(triangles / 0.5, np.rint(normals), strict=True):
        low, high = triangle.min(axis=0), triangle.max(axis=0)
        pairs.setdefault((*((low + high) / 2).round(4), *normal), []).append(triangle)
    assert set(pairs) == faces_of(cells)
    assert all(len(pair) == 2 for pair in pairs.values())


@pytest.mark.parametrize("ending", SURFACES)
def test_another_program_sees_the_surface(tmp_path, ending):
    made = map_of([[0, 0, 0], [1, 0, 0], [5, -3, 2]])
    export(made, tmp_path / f"map{ending}")
    path, expected = tmp_path / f"map{ending}", surface(made)
    assert b"metres" in path.read_bytes()[:80]
    mesh = trimesh.load(path)
    triangles = expected.vertices[expected.faces]
    order = [np.lexsort(part.reshape(-1, 9).round(4).T) for part in (mesh.triangles, triangles)]
    np.testing.assert_allclose(mesh.triangles[order[0]], triangles[order[1]], atol=1e-5)
    np.testing.assert_allclose(surface_triangles(path), triangles, atol=1e-6)
    assert mesh.is_watertight
    assert mesh.volume > 0  # it faces outward
    assert len(mesh.split()) == 2


def test_equal_corners_are_one_vertex_and_height_is_colour(tmp_path):
    made = map_of([[0, 0, 0], [0, 0, 1]])
    assert len(cube_faces(made).vertices) == 12
    export(made, tmp_path / "map.glb")
    file = Glb(tmp_path / "map.glb")
    vertices, colours = file.vertices, file.colours
    low, high = vertices[:, 2] == 0, vertices[:, 2] == 1
    assert low.sum() == high.sum() == 4
    assert (colours[low][:, 2] > colours[low][:, 0]).all()  # from blue
    assert (colours[high][:, 0] > colours[high][:, 2]).all()  # to red
    (matt,) = file.scene["materials"]  # metal, which is the standard's default, is black without surroundings to mirror
    assert matt["pbrMetallicRoughness"] == {"metallicFactor": 0, "roughnessFactor": 1}
    assert matt["doubleSided"]
    assert file.primitive["material"] == 0


@pytest.mark.parametrize("ending", [".glb", *SURFACES])
def test_maps_without_a_surface(tmp_path, ending):
    free = VoxelMap.from_cells(load_config(), [[0, 0, 0]], [-3.0])
    for empty in (VoxelMap(load_config()), free):
        with pytest.raises(MapFileError, match="occupied"):
            export(empty, tmp_path / f"map{ending}")
    assert not list(tmp_path.iterdir())


def test_a_map_that_is_too_wide_to_draw(tmp_path):
    with pytest.raises(StereovoxError, match="crop it"):
        export(map_of([[0, 0, 0], [0, 1 << 22, 0]]), tmp_path / "map.glb")
