# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import along_ray, layer

CELLS = {(0, 0, 0): 2.0, (3, 0, 1): -1.5, (-2, 4, 1): 0.3, (1, 2, 1): 2.5}


def made_map():
    return VoxelMap.from_cells(load_config(voxel_size=0.5), list(CELLS), list(CELLS.values()))


@pytest.mark.parametrize(("across", "at_m"), [("x", 0.6), ("y", 0.2), ("z", 0.7), ("z", 40.0)])
def test_a_layer_holds_the_cells_of_its_plane_and_no_other(across, at_m):
    one = layer(made_map(), across, at_m)
    normal = "xyz".index(across)
    columns, rows = ("xyz".index(name) for name in one.axes)
    found = {}
    for row, column in zip(*np.nonzero(~np.isnan(one.log_odds)), strict=True):
        cell = [0, 0, 0]
        cell[normal] = int(np.floor(at_m / 0.5))
        cell[columns] = round(one.extent[0] / 0.5) + int(column)
        cell[rows] = round(one.extent[2] / 0.5) + int(row)
        found[tuple(cell)] = float(one.log_odds[row, column])
    wanted = {cell: value for cell, value in CELLS.items() if cell[normal] == int(np.floor(at_m / 0.5))}
    assert found == pytest.approx(wanted)
    assert ((one.state == State.UNKNOWN) == np.isnan(one.log_odds)).all()
    assert one.extent[1] - one.extent[0] == one.state.shape[1] * 0.5


def test_along_a_ray_each_cell_is_met_once_where_it_is_entered():
    one = VoxelMap.from_cells(load_config(voxel_size=0.5), [[0, 0, 0], [2, 0, 0], [1, 1, 0]], [-1.0, 2.0, 3.0])
    distance, log_odds = along_ray(one, (0.25, 0.25, 0.25), (2, 0, 0), 1.5)
    np.testing.assert_allclose(distance, [0, 0.25, 0.75, 1.25, 1.5])
    np.testing.assert_allclose(log_odds, [-1, 0, 2, 0])
    distance, log_odds = along_ray(one, (0.25, 0.25, 0.25), (1, 1, 0), 0.9)
    np.testing.assert_allclose(distance, [0, 0.25 * np.sqrt(2), 0.9])
    np.testing.assert_allclose(log_odds, [-1, 3])


@pytest.mark.parametrize("cell", ["int16", "uint8"])
def test_layers_of_random_maps_say_what_each_cell_says(cell):
    numbers = np.random.default_rng(3)
    indices = np.unique(numbers.integers(-21, 13, (4000, 3)), axis=0)
    config = load_config(voxel_size=0.25, **{"map.cell": cell})
    one = VoxelMap.from_cells(config, indices, numbers.uniform(-2, 3, len(indices)))
    for across in "xyz":
        at_m = numbers.uniform(-21, 13) * 0.25
        found = layer(one, across, at_m, one.bounds())
        left, right, bottom, top = found.extent
        assert found.state.shape == (round((top - bottom) / 0.25), round((right - left) / 0.25))
        for row, column in np.ndindex(found.state.shape):
            place = {
                across: at_m,
                found.axes[0]: left + 0.25 * (column + 0.5),
                found.axes[1]: bottom + 0.25 * (row + 0.5),
            }
            point = [[place[name] for name in "xyz"]]
            assert found.state[row, column] == one.state(point)[0]
            assert np.nan_to_num(found.log_odds[row, column]) == one.log_odds(point)[0]
        assert found.at_m == pytest.approx((np.floor(at_m / 0.25) + 0.5) * 0.25)


def test_rays_of_random_maps_say_what_fine_steps_say():
    numbers = np.random.default_rng(4)
    indices = np.argwhere(np.ones((12, 12, 12))) - 6
    one = VoxelMap.from_cells(load_config(voxel_size=0.3), indices, numbers.uniform(-2, 3, len(indices)))
    for _ in range(20):
        start, towards = numbers.uniform(-1, 1, 3), numbers.normal(size=3)
        distance, log_odds = along_ray(one, start, towards, 3.0)
        assert (np.diff(distance) > 0).all()
        assert (distance[0], distance[-1]) == (0, 3)
        at = (np.arange(3000) + 0.5) / 1000
        fine = one.log_odds(start + at[:, None] * towards / np.linalg.norm(towards))
        coarse = log_odds[np.searchsorted(distance, at) - 1]
        assert (fine != coarse).mean() < 0.001
        assert len(distance) - 1 <= 3 * 3 / 0.3 + 1, "each cell once"


def test_wrong_use_ends_in_one_line():
    with pytest.raises(StereovoxError, match="name one of x, y, z"):
        layer(made_map(), "up", 0)
    with pytest.raises(StereovoxError, match="map is empty"):
        layer(VoxelMap(load_config()), "z", 0)
    with pytest.raises(StereovoxError, match="layer at nan"):
        layer(made_map(), "z", np.nan)
    with pytest.raises(StereovoxError, match="points nowhere"):
        along_ray(made_map(), (0, 0, 0), (0, 0, 0), 1)
