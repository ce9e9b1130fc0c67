# SPDX-License-Identifier: Apache-2.0
"""The surface of what is occupied: closed, with the right cells inside, the same however the map is cut."""

import builtins

import numpy as np
import pytest
import trimesh
from made_maps import KINDS, random_map

from stereovox import State, StereovoxError, VoxelMap, load_config, surface
from stereovox.errors import MissingExtra
from stereovox.formats import meshes


def solid_of(voxel_map):
    found = surface(voxel_map)
    assert (found.vertices.dtype, found.faces.dtype) == (np.float32, np.int32)
    return trimesh.Trimesh(found.vertices, found.faces, process=False)


@pytest.mark.parametrize("kind", KINDS)
def test_closed_about_the_middles_of_the_occupied_cells(kind, monkeypatch):
    """Random cells, so that every case of the tables comes up; blocks are looked at one by one, so that all cross."""
    monkeypatch.setattr(meshes, "GROUP", 1)
    voxel_map = random_map(8, kind, 2500, low=-9, high=10)
    solid = solid_of(voxel_map)
    assert solid.is_watertight
    assert solid.is_winding_consistent
    assert solid.volume > 0
    cells, _ = voxel_map.cells()
    around = np.unique((cells[:, None] + [[0, 0, 0], [1, 0, 0], [0, -1, 0]]).reshape(-1, 3), axis=0)[::5]
    points = voxel_map.centers(around)
    np.testing.assert_array_equal(solid.contains(points), voxel_map.state(points) == State.OCCUPIED)


def test_cuts_change_nothing(monkeypatch):
    voxel_map = random_map(9)
    whole = surface(voxel_map)
    monkeypatch.setattr(meshes, "GROUP", 1)
    cut = surface(voxel_map)
    assert len(whole.faces) == len(cut.faces)
    assert len(whole.vertices) == len(cut.vertices)
    in_order = [np.sort(one.vertices.round(5).view("f4,f4,f4").ravel()) for one in (whole, cut)]
    np.testing.assert_array_equal(*in_order)


def box(outside):
    """A hollow box of occupied cells from -0.3 to 0.7 m, free inside."""
    cells = np.argwhere(np.ones((10, 10, 10)))
    wall = ((cells == 0) | (cells == 9)).any(axis=1)
    around = np.argwhere(np.ones((12, 12, 12))) - 1
    around = around[((around < 0) | (around > 9)).any(axis=1)]
    indices, log_odds = (
        np.concatenate([cells, around]),
        np.concatenate([np.where(wall, 3.5, -4), np.full(len(around), -4.0)]),
    )
    known = slice(None) if outside else slice(len(cells))
    return VoxelMap.from_cells(load_config(voxel_size=0.1), indices[known] - 3, log_odds[known])


def test_a_box_has_an_outer_and_an_inner_surface():
    seen = solid_of(box(outside=True))
    assert seen.is_watertight
    assert seen.body_count == 2
    assert np.ptp(seen.vertices, axis=0).max() < 1.0 + 2 * 0.02  # p = 0.29 lies a little outside the cells' faces
    unseen = solid_of(box(outside=False))
    assert unseen.is_watertight
    assert unseen.bounds.min() >= -0.3 - 1e-6  # towards the unknown never beyond the cells' own faces
    assert unseen.bounds.max() <= 0.7 + 1e-6


def test_nothing_occupied_and_no_library(monkeypatch):
    with pytest.raises(StereovoxError, match="nothing is occupied"):
        surface(VoxelMap(load_config()))
    load = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", lambda name, *rest: no_library(name) or load(name, *rest))
    with pytest.raises(MissingExtra, match=r"stereovox\[mesh\]"):
        surface(random_map())


def no_library(name):
    if name.startswith("skimage"):
        raise ImportError(name)
