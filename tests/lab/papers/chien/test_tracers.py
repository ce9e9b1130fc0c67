# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.evaluate.truth import keys
from stereovox.frame import Frame
from stereovox.integrate import make_integrator
from stereovox.maps.cells.evidence import Evidence
from stereovox_lab.papers.chien.tracers import RIM_CELLS, compare_tracers, near_rim, updated_cells


def test_updated_cells_are_those_that_get_something():
    coords, uniform = np.array([[0, 0, 0], [-1, 2, 0]], np.int32), np.array([[5, 5, 5]], np.int32)
    values = np.zeros((2, 512), np.int16)
    values[0, 0], values[1, 64 * 3 + 8 * 2 + 7] = 5, -9
    cells = {tuple(cell) for cell in updated_cells(Evidence(coords, values, uniform, -100)).tolist()}
    assert {(0, 0, 0), (-5, 18, 7), (40, 40, 40), (47, 47, 47)} <= cells
    assert len(cells) == 2 + 512


def test_the_rim_is_what_lies_a_cell_or_so_inside_the_view():
    camera = PinholeCamera.from_field_of_view(100, 100, 90)  # sees |x| and |y| up to z
    size, z = 0.2, 3.1
    x = np.arange(-20, 20)
    cells = np.column_stack([x, np.zeros_like(x), np.full_like(x, 15)])
    middle = (x + 0.5) * size
    np.testing.assert_array_equal(near_rim(cells, camera, np.eye(4), size), z - np.abs(middle) < RIM_CELLS * size)
    behind = np.array([[0, 0, -5]])
    assert near_rim(behind, camera, np.eye(4), size).all()


@pytest.fixture(scope="module")
def compared():
    return compare_tracers(8, frames=4)


def test_line_drawing_updates_fewer_cells_than_traversal(compared):
    assert 0 < compared.only_line < compared.only_ray < 0.3 * compared.ray
    assert compared.only_ray > compared.at_rim > 0
    assert 0 < compared.occupied_both <= min(compared.occupied_ray, compared.occupied_line)
    assert len(compared.ms["ray"]) == 4
    assert compared.figures()["line_ms"] > 0


def test_what_is_counted_is_the_difference_of_the_cells():
    one = compare_tracers(8, frames=1)
    ray, line = (set(one.updated[name].tolist()) for name in ("ray", "line"))
    assert (one.ray, one.line, one.both) == (len(ray), len(line), len(ray & line))
    assert (one.only_ray, one.only_line) == (len(ray - line), len(line - ray))
    assert 0 < one.at_rim < len(ray - line)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.2, 0.1, 0.1), (0.1, -0.4, 0.6)])
def test_a_camera_where_cells_meet_sees_as_much_as_one_beside(place):
    """Chien's camera starts at the map's origin, a corner of eight cells."""
    camera = PinholeCamera.from_field_of_view(64, 48, 80, 0.05)
    counts = []
    for offset in (0.0, 0.003):
        T = np.eye(4)
        T[:3, 3] = np.add(place, offset)
        config = load_config("chien2020", integrator="ray", **{"depth.downsample": 1})
        frame = Frame(np.full((48, 64), 2.5, np.float32), camera, T)
        evidence = make_integrator(config).evidence(prepare(frame, config))
        counts.append(len(np.unique(keys(updated_cells(evidence)))))
    assert counts[0] > 0.9 * counts[1]
