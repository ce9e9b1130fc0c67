# SPDX-License-Identifier: Apache-2.0
"""Measuring: the first cell that a click meets, and how far two are apart."""

from contextlib import closing

import numpy as np

from stereovox import VoxelMap, load_config
from stereovox.viewer.panel import FIRST, HOW, first_hit
from stereovox.viewer.viewer import open_viewer

SIZE = 0.2


def slow_first_hit(cells, origin, direction):
    """Walk along the ray in steps much smaller than a cell."""
    solid = {tuple(cell) for cell in cells}
    for step in np.arange(0, 12, 0.002):
        cell = tuple(np.floor((origin + step * direction) / SIZE).astype(int))
        if cell in solid:
            return cell
    return None


def test_a_click_meets_the_first_cell_on_its_ray():
    random = np.random.default_rng(0)
    cells = np.unique(random.integers(0, 12, (60, 3)), axis=0).astype(np.int32)
    hits = 0
    for _ in range(40):
        origin, toward = random.uniform(-2, 4, 3), random.uniform(0, 2.4, 3)
        direction = (toward - origin) / np.linalg.norm(toward - origin)
        want, found = slow_first_hit(cells, origin, direction), first_hit(cells, SIZE, origin, 3 * direction)
        assert (found is None) == (want is None)
        if want is not None:
            assert tuple(found) == want
            hits += 1
    assert 5 < hits < 40


def test_a_ray_along_an_axis_and_one_that_leaves():
    cells = np.array([[5, 0, 0], [7, 0, 0]], np.int32)
    assert first_hit(cells, SIZE, [0, 0.1, 0.1], [1, 0, 0]).tolist() == [5, 0, 0]
    assert first_hit(cells, SIZE, [0, 0.1, 0.1], [-1, 0, 0]) is None
    assert first_hit(cells[:0], SIZE, [0, 0.1, 0.1], [1, 0, 0]) is None


def test_two_clicks_tell_a_distance_and_what_is_cut_off_is_not_met():
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=SIZE), [[0, 0, 0], [15, 0, 20], [15, 0, 30]], [2.0] * 3)
    with closing(open_viewer(voxel_map, port=0)) as viewer:
        measure = viewer.measure
        assert measure.text.content == HOW
        viewer.cells.below.value = 5.0
        measure.pick([0.1, -1, 0.1], [0, 1, 0])
        measure.pick([0.1, -1, 5.1], [0, 1, 0])
        assert measure.text.content == FIRST
        measure.pick([3.1, 0.1, 9], [0, 0, -1])
        assert measure.text.content == "**5.00 m** from centre to centre (x +3.00, y +0.00, z +4.00)"
        assert viewer.server.scene.get_handle_by_name("/measure/line") is not None
        measure.pick([3.1, 0.1, 9], [0, 0, -1])
        assert len(measure.picked) == 1
        measure.on.value = True
        assert not measure.picked
