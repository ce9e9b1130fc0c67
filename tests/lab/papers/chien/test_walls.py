# SPDX-License-Identifier: Apache-2.0
"""Walls of known thickness, place and angle are measured as what they are."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.evaluate.truth import keys
from stereovox.maps import VoxelMap
from stereovox.simulate.scene import box, cylinder
from stereovox_lab.papers.chien.walls import Wall, corner_deg, fit_plane, measure_wall, thickness_figures

SIZE = 0.05
SOLID = box("walls", "front", (2.02, -1.0, 0.0), (2.3, 1.0, 2.0))
WALL = Wall.of(SOLID, (-1, 0, 0))
FACE = 40
"""Index along x of the cells that hold the face at 2.02 m."""


def layers(first, last, y=(-20, 20), z=(0, 40)):
    grid = np.meshgrid(np.arange(first, last + 1), np.arange(*y), np.arange(*z), indexing="ij")
    return np.stack(grid, axis=-1).reshape(-1, 3)


def map_of(*cells):
    indices = np.concatenate(cells)
    return VoxelMap.from_cells(load_config(voxel_size=SIZE), indices, np.full(len(indices), 3.0))


def test_the_face_that_is_looked_for():
    np.testing.assert_allclose(WALL.normal, [-1, 0, 0], atol=1e-9)
    assert WALL.corner[0] == pytest.approx(2.02)
    assert sorted(np.linalg.norm(WALL.along, axis=1).round(6)) == [2.0, 2.0]
    assert Wall.of(SOLID, (0.1, 0, 1)).corner[2] == pytest.approx(2.0)


@pytest.mark.parametrize("cells", [1, 2, 5])
def test_thickness_is_counted_through_the_wall(cells):
    found = measure_wall(map_of(layers(FACE, FACE + cells - 1)), WALL)
    assert set(found.thickness) == {cells}
    assert found.columns == len(found.thickness) == 38 * 38  # one cell less at each rim
    assert found.straightness == pytest.approx(0, abs=1e-9)
    assert found.offset == pytest.approx(2.02 - (FACE + cells / 2) * SIZE)
    np.testing.assert_allclose(found.normal, [-1, 0, 0], atol=1e-9)


def test_bumps_make_it_thick_and_crooked():
    found = measure_wall(map_of(layers(FACE, FACE), layers(FACE - 2, FACE - 1, y=(0, 8))), WALL)
    assert sorted(set(found.thickness)) == [1, 3]
    figures = thickness_figures([found])
    assert figures["thickness_median"] == 1
    assert figures["thickness_p95"] == 3
    assert figures["thin_share"] == pytest.approx(1 - 8 / 38)
    assert 0.01 < found.straightness < SIZE
    assert figures["thin_share"] == found.figures()["thin_share"]


def test_cells_far_from_the_face_are_another_thing():
    found = measure_wall(map_of(layers(FACE, FACE), layers(FACE - 12, FACE - 10)), WALL)
    assert set(found.thickness) == {1}
    assert set(measure_wall(map_of(layers(FACE, FACE), layers(FACE - 12, FACE - 10)), WALL, reach=1.0).thickness) == {4}


def test_columns_without_a_cell_count_as_not_found():
    figures = thickness_figures([measure_wall(map_of(layers(FACE, FACE, y=(-20, 0))), WALL)])
    assert figures["found"] == pytest.approx(0.5)
    assert figures["columns"] == 38 * 38


def test_columns_that_were_not_seen_or_hold_something_else_are_left_out():
    voxel_map = map_of(layers(FACE, FACE), layers(FACE - 3, FACE - 1, y=(5, 10)))
    seen = measure_wall(voxel_map, WALL, only=keys(layers(FACE, FACE, y=(-20, 12))))
    assert seen.columns == 31 * 38
    assert set(seen.thickness) == {1, 4}
    cabinet = keys(layers(FACE - 3, FACE - 1, y=(5, 10)))
    assert set(measure_wall(voxel_map, WALL, others=cabinet).thickness) == {1}


@pytest.mark.parametrize("degrees", [80, 90, 100])
def test_the_angle_between_two_walls(degrees):
    turn = np.radians(degrees)
    side = np.array([np.sin(turn), -np.cos(turn), 0])  # normal of the second wall
    wall = Wall("side", np.zeros(3), np.array([[2 * np.cos(turn), 2 * np.sin(turn), 0], [0, 0, 2.0]]), side)
    base = Wall("base", np.zeros(3), np.array([[2.0, 0, 0], [0, 0, 2.0]]), np.array([0, 1.0, 0]))
    found = []
    for each in (base, wall):
        a, b = (grid.ravel()[:, None] for grid in np.meshgrid(*2 * [np.arange(0, 1, 0.004)]))
        points = each.corner + a * each.along[0] + b * each.along[1]
        cells = np.unique(np.floor(points / SIZE).astype(int), axis=0)
        found.append(measure_wall(map_of(cells), each))
        assert found[-1].straightness < SIZE / 2
        assert np.percentile(found[-1].thickness, 95) <= 2
    assert corner_deg(*found) == pytest.approx(degrees, abs=0.5)


def test_a_plane_is_fitted_with_its_normal_towards_the_viewer():
    random = np.random.default_rng(0)
    flat = random.random((50, 2)) @ np.array([[1, 0, 0.5], [0, 1, 0]]) + np.array([0, 0, 3])
    normal, residual = fit_plane(flat, (0, 0, -1))
    np.testing.assert_allclose(normal, np.array([1, 0, -2]) / np.sqrt(5), atol=1e-9)
    np.testing.assert_allclose(residual, 0, atol=1e-9)


def test_what_cannot_be_measured_is_said_in_one_line():
    with pytest.raises(StereovoxError, match="front: stands in 0 columns"):
        measure_wall(map_of(layers(0, 0)), WALL)
    with pytest.raises(StereovoxError, match="pole: has no rectangular face"):
        Wall.of(cylinder("poles", "pole", (0, 0, 0), (0, 0, 2), 0.1), (0, 0, 1))
