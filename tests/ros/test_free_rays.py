# SPDX-License-Identifier: Apache-2.0
"""Free rays against a slow twin, over random maps and places."""

from __future__ import annotations

import numpy as np
import pytest

from stereovox.geometry import se2
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import State
from stereovox.ros.obstacles import STEP, free_ends


def naive(grid, place, reach, blind):
    """Ray by ray, step by step."""
    cells = round(reach / grid.resolution)
    at = se2.transform(se2.inverse(grid.origin), place[None])[0] / grid.resolution
    states, ends = grid.states, []
    for angle in np.arange(0.0, 2 * np.pi, 1 / cells):
        end = None
        for far in np.arange(STEP, cells, STEP):
            column, row = np.floor(at + far * np.array([np.cos(angle), np.sin(angle)])).astype(int)
            inside = 0 <= row < states.shape[0] and 0 <= column < states.shape[1]
            state = states[row, column] if inside else State.UNKNOWN
            if state == State.FREE:
                end = row, column
            elif not (state == State.UNKNOWN and far <= blind / grid.resolution):
                break
        ends += [] if end is None else [end]
    return grid.centres(*np.array(ends).reshape(-1, 2).T)


@pytest.mark.parametrize("seed", range(6))
def test_rays_are_those_of_the_twin(seed):
    random = np.random.default_rng(seed)
    cells = random.choice(np.array([-1, 0, 50, 100], np.int8), (40, 55), p=[0.1, 0.86, 0.01, 0.03])
    grid = OccupancyGrid(cells, 0.1, (float(random.normal()), 2.0, float(random.uniform(-3, 3))))
    place = grid.centres([random.integers(-3, 43)], [random.integers(-3, 58)])[0] + random.uniform(-0.04, 0.04, 2)
    found, expected = free_ends(grid, place, 2.5, 0.4), naive(grid, place, 2.5, 0.4)
    assert abs(len(found) - len(expected)) <= 1
    away = np.linalg.norm(found[:, None] - expected, axis=2)
    assert len(found) == 0 or (away.min(axis=1) < 1e-6).mean() > 0.97  # single precision, on the edges of cells
