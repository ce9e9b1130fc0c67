# SPDX-License-Identifier: Apache-2.0
"""Cells in view and cells on rays, against slow loops."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.evaluate.lidar_truth import blocks_in, project, view_volume
from stereovox.frame import Viewpoint
from stereovox.geometry.se3 import look_at

CAMERA = PinholeCamera(40, 24, 30.0, 33.0, 17.0, 13.5)


def sees(viewpoint: Viewpoint, point: np.ndarray, max_range: float) -> bool:
    x, y, z, _ = np.linalg.inv(viewpoint.T_world_camera) @ [*point, 1]
    if not 0 < z <= max_range:
        return False
    camera = viewpoint.camera
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    return -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5


@pytest.mark.parametrize("target", [(5, 0.3, 0.1), (-2, -3, 1), (0.1, 0.2, 4)])
def test_the_cells_in_view_are_those_whose_centre_is(target):
    viewpoint = Viewpoint(CAMERA, look_at([0.31, -0.22, 0.13], target, up=[0, 0.1, 1]))
    size, max_range = 0.25, 3.0
    found = set()
    for blocks, cells in blocks_in(view_volume(viewpoint, max_range, size)):
        assert cells.any(axis=1).all()
        for block, of_block in zip(blocks, cells, strict=True):
            for column in np.flatnonzero(of_block):
                cell = tuple(int(c) for c in block * 8 + [column >> 6, column >> 3 & 7, column & 7])
                assert cell not in found
                found.add(cell)
    around = range(-16, 17)
    expected = {
        cell
        for cell in itertools.product(around, around, around)
        if sees(viewpoint, (np.array(cell) + 0.5) * size, max_range)
    }
    assert len(expected) > 500
    assert found == expected


def test_blocks_wholly_in_view_are_whole():
    viewpoint = Viewpoint(CAMERA, look_at([0.0, 0, 0], [1, 0, 0]))
    parts = [cells for _, cells in blocks_in(view_volume(viewpoint, 20.0, 0.1))]
    assert sum(cells.all(axis=1).sum() for cells in parts) > 50
    share = sum(cells.sum() for cells in parts) * 0.1**3
    assert share == pytest.approx(20.0**3 / 3 * (40 / 30) * (24 / 33), rel=0.01)


def test_project_knows_the_borders_of_the_image():
    z = 2.0
    edges = [(-0.5, 0, True), (-0.51, 0, False), (39.49, 23.49, True), (39.5, 0, False), (0, 23.5, False)]
    points = [[(u - 17) / 30 * z, (v - 13.5) / 33 * z, z] for u, v, _ in edges] + [[0, 0, -1.0], [0, 0, 0]]
    pixels, shown = project(CAMERA, np.array(points))
    np.testing.assert_array_equal(shown, [*(inside for *_, inside in edges), False, False])
    np.testing.assert_allclose(pixels[2], [39.49, 23.49])
    assert np.isnan(pixels[-2:]).all()
