# SPDX-License-Identifier: Apache-2.0
"""Ambient occlusion against a count cell by cell."""

import itertools

import numpy as np
import pytest

from stereovox.view.render import BURIED, Occlusion

RADII = ((1, 0.3), (3, 0.9))


def slow(cells, cell, axis, side):
    """Brightness of one face: 0 where a cell covers it, else less the more cells stand before it."""
    known = set(map(tuple, cells.tolist()))
    step = np.zeros(3, int)
    step[axis] = side
    if tuple(cell + step) in known:
        return 0.0
    shade = 0.0
    for radius, weight in RADII:
        reach = [range(-radius, radius + 1)] * 3
        reach[axis] = range(1, radius + 1) if side > 0 else range(-radius, 0)
        box = list(itertools.product(*reach))
        shade += weight * sum(tuple(cell + np.array(at)) in known for at in box) / len(box)
    return np.exp(-shade)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1, 1])
def test_faces_are_as_bright_as_a_count_says(axis, side):
    cells = np.argwhere(np.random.default_rng(axis).random((7, 6, 5)) < 0.3) - [3, 3, 2]
    found = Occlusion(cells, RADII).brightness(axis, side)
    np.testing.assert_allclose(found, [slow(cells, cell, axis, side) for cell in cells], atol=1e-6)
    assert 0 < (found == 0).sum() < len(cells)


def test_a_cell_alone_is_bright_and_a_buried_one_is_not():
    alone = Occlusion(np.array([[5, -7, 9]]))
    assert alone.brightness(2, 1).tolist() == alone.mean().tolist() == [1.0]
    cube = np.argwhere(np.ones((3, 3, 3)))
    middle = np.flatnonzero((cube == 1).all(axis=1))
    assert Occlusion(cube).mean()[middle] == pytest.approx(BURIED)
    assert (Occlusion(cube).mean() > 0.99).sum() == 26


def test_without_radii_all_exposed_faces_are_equally_bright():
    corner = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]])
    assert Occlusion(corner, ()).brightness(0, 1).tolist() == [0.0, 1.0, 1.0]
