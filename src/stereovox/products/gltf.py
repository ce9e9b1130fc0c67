# SPDX-License-Identifier: Apache-2.0
"""A map as one binary glTF file (`.glb`), which browsers, Blender and phones show (Khronos glTF 2.0)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError
from stereovox.files import replacing
from stereovox.maps import VoxelMap
from stereovox.products.cube_faces import Faces, cube_faces
from stereovox.products.floor_axes import upright_axes
from stereovox.products.points import height_colours

FLOAT, UINT32, UINT8 = 5126, 5125, 5121
VERTICES, INDICES = 34962, 34963
"""Numbers that glTF has for the types of components and of buffers."""


def write_glb(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the outer faces of the occupied cells, coloured by height; glTF's y is the map's `up`, units are metres.

    Vertices are in the map's own frame, a node turns them. Raises MapFileError for a map without occupied cells and
    for a place that cannot be written.
    """
    mesh = cube_faces(voxel_map)
    if not len(mesh.faces):
        raise MapFileError(f"{path}: the map holds no occupied cell, there is nothing to show")
    across, along, up = upright_axes(voxel_map.config.up)
    parts = [
        np.ascontiguousarray(mesh.vertices, "<f4"),
        _colours(mesh.vertices @ up),
        np.ascontiguousarray(mesh.faces, "<u4"),
    ]
    turn = np.eye(4)
    turn[:3, :3] = [across, up, -along]
    scene = json.dumps(_scene(mesh, [part.nbytes for part in parts], turn), separators=(",", ":")).encode()
    body = b"".join(part.tobytes() for part in parts)  # each a multiple of four bytes, as it must be
    scene += b" " * (-len(scene) % 4)
    with replacing(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(scene) + 8 + len(body)))
        file.write(struct.pack("<I4s", len(scene), b"JSON") + scene)
        file.write(struct.pack("<I4s", len(body), b"BIN\0") + body)


def _scene(mesh: Faces, sizes: list[int], turn: NDArray[np.float64]) -> dict[str, Any]:
    starts = np.cumsum([0, *sizes]).tolist()
    count, corners = len(mesh.vertices), mesh.faces.size
    targets = (VERTICES, VERTICES, INDICES)
    spread = {"min": mesh.vertices.min(axis=0).tolist(), "max": mesh.vertices.max(axis=0).tolist()}
    return {
        "asset": {"version": "2.0", "generator": "stereovox"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "map", "mesh": 0, "matrix": turn.T.ravel().tolist()}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True}],
        "accessors": [
            {"bufferView": 0, "componentType": FLOAT, "count": count, "type": "VEC3", **spread},
            {"bufferView": 1, "componentType": UINT8, "normalized": True, "count": count, "type": "VEC4"},
            {"bufferView": 2, "componentType": UINT32, "count": corners, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": start, "byteLength": size, "target": target}
            for start, size, target in zip(starts, sizes, targets, strict=False)
        ],
        "buffers": [{"byteLength": starts[-1]}],
    }


def _colours(heights: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return (N, 4) red, green, blue and opacity; glTF's numbers are linear, those of screens (sRGB) are not."""
    screen = height_colours(heights) / 255
    linear = np.where(screen <= 0.04045, screen / 12.92, ((screen + 0.055) / 1.055) ** 2.4)
    return np.column_stack([np.rint(255 * linear), np.full(len(heights), 255)]).astype(np.uint8)
