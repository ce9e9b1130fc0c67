# SPDX-License-Identifier: Apache-2.0
"""Floors' maps both ways: raised to maps in space, and copied in their own mode."""

import numpy as np
import pytest

from stereovox.cli import main
from stereovox.errors import StereovoxError
from stereovox.formats import import_map
from stereovox.formats.cell_size import raised
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.maps import State
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.projection import project


def floor(origin=(-1.0, 2.0, 0.0)):
    dice = np.random.default_rng(3)
    cells = dice.choice(np.array([-1, 0, 0, 0, 100], np.int8), (30, 41))
    return OccupancyGrid(cells, 0.05, origin)


def test_each_cell_becomes_a_column(tmp_path):
    grid = floor()
    write_map_server(grid, tmp_path / "map.yaml")
    made = import_map(tmp_path / "map.yaml", heights=(0.0, 0.3))
    assert made.voxel_size == 0.05
    rows, columns = np.indices(grid.cells.shape).reshape(2, -1)
    places = grid.centres(rows, columns)
    for height in (0.01, 0.16, 0.29):
        states = made.state(np.column_stack([places, np.full(len(places), height)]))
        np.testing.assert_array_equal(states, grid.states.ravel())
    for height in (-0.01, 0.31):
        assert not made.state(np.column_stack([places, np.full(len(places), height)])).any()
    again = project(made, (0.0, 0.3), floor=0.0)
    assert (again.states == State.OCCUPIED).sum() == (grid.states == State.OCCUPIED).sum()
    assert "41 x 30 cells" in made.history.imported.holds
    assert "columns from 0 to 0.3 m" in made.history.imported.notes[0]


@pytest.mark.parametrize("origin", [(0.02, -0.01, 0.0), (-1.0, 2.0, 0.7), (3.0, 1.0, -2.4)])
def test_a_turned_floor_never_frees_what_is_not_free(origin):
    grid = floor(origin)
    made = raised(grid, (0, 0.05))
    dice = np.random.default_rng(9)
    corners = grid.centres([0, 0, 29, 29], [0, 40, 0, 40])
    points = dice.uniform(corners.min(axis=0) - 0.1, corners.max(axis=0) + 0.1, (20_000, 2))
    rows = grid.indices(points)
    inside = ((rows >= 0) & (rows < grid.cells.shape)).all(axis=1)
    states = np.where(inside, grid.states[tuple(np.where(inside[:, None], rows, 0).T)], State.UNKNOWN)
    found = made.state(np.column_stack([points, np.full(len(points), 0.02)]))
    free = found == State.FREE
    assert free.sum() > 300
    assert (states[free] == State.FREE).mean() > 0.97  # a corner of a cell may lie between the places looked at
    assert (found[states == State.OCCUPIED] == State.OCCUPIED).mean() > 0.9


def test_a_floor_without_heights_says_what_takes_it(tmp_path):
    write_map_server(floor(), tmp_path / "map.yaml")
    with pytest.raises(StereovoxError, match="info, picture, eval, localize and path read it") as error:
        import_map(tmp_path / "map.yaml")
    assert len(str(error.value)) - len(str(tmp_path)) <= 250
    for heights in ((1, 0), (0, 1e6)):
        with pytest.raises(StereovoxError, match="heights"):
            import_map(tmp_path / "map.yaml", heights=heights)


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_a_floor_is_copied_in_its_own_mode(tmp_path, mode):
    grid = floor()
    cells = np.where(grid.cells == 0, 37, grid.cells).astype(np.int8) if mode != "trinary" else grid.cells
    write_map_server(OccupancyGrid(cells, 0.05, (1, 2, 0.5)), tmp_path / "in.yaml", mode)
    assert main(["import", str(tmp_path / "in.yaml"), str(tmp_path / "out.yaml")]) == 0
    before, after = read_map_server(tmp_path / "in.yaml"), read_map_server(tmp_path / "out.yaml")
    np.testing.assert_array_equal(after.cells, before.cells)
    np.testing.assert_array_equal(after.states, before.states)
    assert (after.resolution, after.origin) == (before.resolution, before.origin)


def test_a_floor_is_not_copied_onto_itself(tmp_path, capsys):
    write_map_server(floor(), tmp_path / "in.yaml")
    before = (tmp_path / "in.pgm").read_bytes()
    assert main(["import", str(tmp_path / "in.yaml"), str(tmp_path / "in.pgm")]) == 2
    assert "would overwrite its own input" in capsys.readouterr().err
    assert (tmp_path / "in.pgm").read_bytes() == before
    assert main(["import", str(tmp_path / "in.pgm"), str(tmp_path / "m.svox"), "--heights", "0:1"]) == 0
