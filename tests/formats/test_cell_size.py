# SPDX-License-Identifier: Apache-2.0
"""Cell sizes suggested for points: no holes in surfaces, steps of 1, 2 and 5, nothing if nothing can be known."""

import numpy as np
import pytest

from stereovox.formats.cell_size import rounded_up, suggested_cell, suggested_for_mesh, typical_spacing


def wall(spacing, width=2.0, jitter=0.0):
    steps = np.arange(0, width, spacing)
    points = np.stack(np.meshgrid(steps, steps, [0.37], indexing="ij"), axis=-1).reshape(-1, 3)
    return points + np.random.default_rng(1).uniform(-jitter, jitter, points.shape)


@pytest.mark.parametrize("spacing", [0.008, 0.02, 0.05])
@pytest.mark.parametrize("scale", [1.0, 1000.0])
def test_a_wall_has_no_holes_and_no_more_detail_than_points(spacing, scale):
    points = wall(spacing * scale, 4 * scale, 0.2 * spacing * scale)
    size = suggested_cell(points).voxel_size
    assert 2 * spacing * scale <= size * 1.25 <= 7 * spacing * scale
    cells = np.unique(np.floor(points[:, :2] / size).astype(int), axis=0)
    inner = ((cells > cells.min(axis=0)) & (cells < cells.max(axis=0))).all(axis=1)
    assert inner.sum() == np.prod(np.ptp(cells, axis=0) - 1) > 100


def test_a_part_of_a_large_cloud_tells_the_same(monkeypatch):
    points = wall(0.01, 2.0, 0.004)
    whole = typical_spacing(points)
    monkeypatch.setattr("stereovox.formats.cell_size.SAMPLE", 4000)
    assert typical_spacing(points) == pytest.approx(whole, rel=0.25)


def test_a_long_cloud_gets_larger_cells():
    points = np.concatenate([wall(0.001, 0.1) + np.array([along, 0, 0]) for along in (0, 10, 20, 30, 40)])
    suggested = suggested_cell(points)
    assert suggested.voxel_size == 0.05
    assert "40.1 m long" in suggested.why


def test_nothing_is_suggested_where_nothing_is_known():
    assert suggested_cell(np.zeros((0, 3))) is None
    assert suggested_cell(np.ones((1000, 3))) is None
    assert suggested_cell(np.arange(27.0).reshape(9, 3)) is None
    assert suggested_for_mesh(np.ones((5, 3))) is None
    assert suggested_cell(np.arange(300.0).reshape(100, 3) * 1e4).voxel_size == 100  # the largest that there is


def test_points_that_are_there_twice_count_once():
    points = wall(0.02)
    assert typical_spacing(np.concatenate([points] * 6)[:50_000]) == pytest.approx(typical_spacing(points), rel=0.01)


@pytest.mark.parametrize(
    ("number", "rounded"), [(0.04, 0.05), (0.05, 0.05), (0.051, 0.1), (1, 1), (1.1, 2), (0.0021, 0.005), (7e3, 1e4)]
)
def test_rounding(number, rounded):
    assert rounded_up(number) == rounded
