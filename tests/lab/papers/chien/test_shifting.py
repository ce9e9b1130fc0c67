# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox_lab.papers.chien.shifting import OUTSIDE, fly


@pytest.fixture(scope="module")
def flights():
    made = {outside: fly(outside, length_m=40.0) for outside in OUTSIDE}
    yield made
    for flight in made.values():
        flight.voxel_map.close()


@pytest.mark.parametrize("outside", OUTSIDE)
def test_the_window_follows_by_whole_cells_in_constant_memory(flights, outside):
    flight = flights[outside]
    assert flight.way.shape == (241, 3)
    assert np.ptp(flight.memory) == 0
    assert flight.most_off_m <= 1.001
    size = np.diff(flight.windows, axis=1)[:, 0]
    np.testing.assert_allclose(size, np.tile([20, 6, 20], (241, 1)), atol=1e-9)
    moved = np.abs(np.diff(flight.windows[:, 0], axis=0)).sum(axis=1) / 0.2
    assert len(flight.shift_ms) == (moved > 0.5).sum() > 50
    np.testing.assert_array_equal(flight.shift_cells, np.rint(moved[moved > 0.5]))
    assert len(flight.shift_ms) + len(flight.stay_ms) == 240


def test_only_kept_cells_come_back(flights):
    kept, dropped = flights["keep"], flights["drop"]
    assert len(dropped.tiles) == 0
    assert len(kept.tiles) > 3
    np.testing.assert_allclose(np.diff(kept.tiles, axis=1), 6.4)
    assert kept.voxel_map.counts()["occupied"] > dropped.voxel_map.counts()["occupied"]
    assert kept.figures()["tiles"] == len(kept.tiles)
