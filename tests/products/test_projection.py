# SPDX-License-Identifier: Apache-2.0
"""Maps seen from above: against loops over cells, and what marks, clears and stays unknown."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.cli import main
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_scores import score_grids
from stereovox.formats import export
from stereovox.formats.map_server import read_map_server
from stereovox.mapper import Mapper
from stereovox.maps import State, VoxelMap
from stereovox.maps.cubes import in_cubes
from stereovox.maps.storage import Storage
from stereovox.products.projection import project
from stereovox.simulate.floors.floor import Floor

SIZE = 0.1
FREE, PERHAPS, WALL = -3.0, 0.2, 3.0
"""Log-odds of cells that are free, tentative and occupied."""
AXES = {"z": "xyz", "+z": "xyz", "-z": "yxz", "y": "zxy", "-y": "xzy", "x": "yzx", "-x": "zyx"}
"""For each axis that may point up: the map's axes along the grid's x and y, and up."""


def settings(**more):
    return load_config(voxel_size=SIZE, **{"map.prior": 0.4, "scan.heights": [0.1, 1.0], **more})


def column(cells, **more):
    """A map of one column at x = y = 0: {height of a cell's middle: log-odds}; the next column is occupied."""
    layers = [round(height / SIZE - 0.5) for height in cells]
    indices = [(0, 0, k) for k in layers] + [(1, 0, 5)]
    return VoxelMap.from_cells(settings(**more), indices, [*cells.values(), WALL])


def percent(log_odds):
    return round(100 / (1 + np.exp(-log_odds)))


def random_map(config, seed=0):
    random = np.random.default_rng(seed)
    indices = np.unique(random.integers([-13, -9, -20], [12, 30, 21], (3000, 3)), axis=0)
    return VoxelMap.from_cells(config, indices, random.choice([-4, -2.5, -0.2, 0.3, 1.2, 3.5], len(indices)))


def slow(voxel_map, heights):
    """{(column, row): (probability, state)} of all columns of which something is known."""
    up = voxel_map.config.up
    x, y, z = ("xyz".index(axis) for axis in AXES[up])
    cells, log_odds = voxel_map.cells()
    state = voxel_map.state(voxel_map.centers(cells))
    within, free = {}, {}
    for cell, value, what in zip(cells.tolist(), log_odds.tolist(), state.tolist(), strict=True):
        height = (cell[z] + 0.5) * voxel_map.config.cell[z] * (-1 if up.startswith("-") else 1)
        place = cell[x], cell[y]
        if heights[0] + 1e-6 < height <= heights[1] + 1e-6:
            within[place] = max(within.get(place, (-9, 0)), (value, what))
        if what == State.FREE:
            free[place] = max(free.get(place, (-9, 0)), (value, what))
    return {place: within.get(place) or free[place] for place in {*within, *free}}


def compare(grid, voxel_map, heights):
    wanted = slow(voxel_map, heights)
    x, y, _ = ("xyz".index(axis) for axis in AXES[voxel_map.config.up])
    low, high = np.min(list(wanted), axis=0), np.max(list(wanted), axis=0)
    assert grid.cells.shape == (high[1] - low[1] + 1, high[0] - low[0] + 1)
    assert grid.origin == pytest.approx((low[0] * grid.resolution, low[1] * grid.resolution, 0))
    assert voxel_map.config.cell[x] == voxel_map.config.cell[y] == grid.resolution
    states = grid.states
    for row, line in enumerate(grid.cells.tolist()):
        for at, cell in enumerate(line):
            value, state = wanted.get((at + low[0], row + low[1]), (None, State.UNKNOWN))
            assert states[row, at] == state
            if value is None:
                assert cell == -1
            elif abs(value) < 2:  # the surest are 0 and 100
                assert abs(cell - percent(value)) <= 1


@pytest.mark.parametrize("up", AXES)
@pytest.mark.parametrize("heights", [(0.1, 1.0), (-1.25, -0.35)])
def test_equals_the_slow_one(up, heights):
    voxel_map = random_map(settings(up=up))
    compare(project(voxel_map, heights), voxel_map, heights)


@pytest.mark.parametrize("more", [{"map.cell": "uint8"}, {"map.prior": 0.05}, {"steps": [0.1, 0.1, 0.25]}])
def test_other_cells_equal_the_slow_ones(more):
    voxel_map = random_map(settings(**more), seed=1)
    compare(project(voxel_map), voxel_map, (0.1, 1.0))


def test_uneven_cells_are_made_cubes():
    voxel_map = random_map(settings(steps=[0.1, 0.2, 0.1]))
    compare(project(voxel_map), in_cubes(voxel_map), (0.1, 1.0))


class InPieces(Storage):
    """As a map whose far tiles lie on disk: blocks come piece by piece, and columns are cut."""

    def slabs(self):
        for coords, cells in super().slabs():
            for piece in np.array_split(np.arange(len(coords)), 5):
                yield coords[piece], cells[piece]


@pytest.mark.parametrize("up", ["z", "x", "-y"])
def test_a_map_that_comes_in_pieces_is_seen_whole(up):
    whole, pieces = random_map(settings(up=up)), VoxelMap(settings(up=up), storage=InPieces(settings(up=up)))
    pieces.storage.insert(*whole.storage.blocks())
    compare(project(pieces), whole, (0.1, 1.0))


@pytest.mark.parametrize(
    ("cells", "wanted", "state"),
    [
        ({0.55: FREE}, percent(FREE), State.FREE),
        ({0.55: WALL, 0.65: FREE}, percent(WALL), State.OCCUPIED),
        ({0.55: PERHAPS, 0.65: FREE}, percent(PERHAPS), State.TENTATIVE),
        ({0.05: WALL, 0.55: FREE}, percent(FREE), State.FREE),  # the floor marks nothing
        ({0.55: FREE, 1.85: WALL}, percent(FREE), State.FREE),  # nor does the ceiling
        ({0.05: WALL, 1.85: WALL}, -1, State.UNKNOWN),
        ({0.05: PERHAPS}, -1, State.UNKNOWN),
        ({1.45: FREE}, percent(FREE), State.FREE),  # what is free at another height clears
        ({-0.55: FREE, 1.45: -2.0}, percent(-2.0), State.FREE),
        ({0.55: WALL, 1.45: FREE}, percent(WALL), State.OCCUPIED),  # but not what is marked
        ({0.55: PERHAPS, 1.45: FREE}, percent(PERHAPS), State.TENTATIVE),
        ({0.15: WALL}, percent(WALL), State.OCCUPIED),  # the lowest and the highest layer that count
        ({0.95: WALL}, percent(WALL), State.OCCUPIED),
        ({1.05: WALL}, -1, State.UNKNOWN),
    ],
)
def test_a_column(cells, wanted, state):
    grid = project(column(cells))
    assert grid.states[0, -1] == State.OCCUPIED
    assert grid.cells.shape == (1, 1 if wanted == -1 else 2)  # what is unknown at the border is no part of the grid
    if wanted != -1:
        assert (grid.cells[0, 0], grid.states[0, 0]) == (wanted, state)


def test_heights_that_cannot_be():
    voxel_map = column({0.55: FREE})
    for heights, words in {
        (0.5, 0.5): "rise",
        (1.0, 0.5): "rise",
        (0.1, np.inf): "rise",
        (0.56, 0.6): "widen",
        (3.0, 4.0): "0.50 to 0.60 m; choose others",
    }.items():
        with pytest.raises(StereovoxError, match=words) as error:
            project(voxel_map, heights)
        assert "\n" not in str(error.value)
    with pytest.raises(StereovoxError, match="empty"):
        project(VoxelMap(settings()))
    with pytest.raises(StereovoxError, match=r"-0\.60 to -0\.50 m"):
        project(VoxelMap.from_cells(settings(up="-z"), [(0, 0, 5)], [WALL]))


def test_a_grid_that_would_be_too_large():
    voxel_map = VoxelMap.from_cells(settings(), [(-(2**20), 0, 5), (2**20, 2**20, 5)], [WALL, WALL])
    with pytest.raises(StereovoxError, match="too large"):
        project(voxel_map)


@pytest.mark.parametrize("name", ["floor.pgm", "floor.png", "floor.yaml"])
def test_exported_for_map_server(tmp_path, name):
    voxel_map = random_map(settings())
    export(voxel_map, tmp_path / name, (0.1, 0.6))
    grid, found = project(voxel_map, (0.1, 0.6)), read_map_server(tmp_path / "floor.yaml")
    known = np.isin(grid.states, [State.FREE, State.OCCUPIED])
    np.testing.assert_array_equal(found.states[known], grid.states[known])
    assert (found.cells[~known] == -1).all()
    assert found.origin == pytest.approx(grid.origin)
    assert (project(voxel_map).cells.shape != grid.cells.shape) or (project(voxel_map).cells != grid.cells).any()


def test_heights_are_for_grids_alone(tmp_path):
    with pytest.raises(StereovoxError, match=r"heights.*\.pgm"):
        export(random_map(settings()), tmp_path / "map.ply", (0.1, 1.0))
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path, capsys):
    random_map(settings()).save(tmp_path / "map.svox")
    where = str(tmp_path / "map.svox")
    assert main(["export", where, str(tmp_path / "a.pgm"), "--json"]) == 0
    assert '"heights": [0.1, 1.0]' in capsys.readouterr().out
    assert main(["export", where, str(tmp_path / "b.yaml"), "--heights=-1:-0.5"]) == 0
    assert "-1 to -0.5 m" in capsys.readouterr().err
    first, second = (read_map_server(tmp_path / name) for name in ("a.yaml", "b.yaml"))
    assert first.cells.shape != second.cells.shape or (first.cells != second.cells).any()
    for heights, words in {"1": "LO:HI", "a:b": "LO:HI", "2:1": "higher", "8:9": "--heights=LO:HI"}.items():
        assert main(["export", where, str(tmp_path / "c.pgm"), f"--heights={heights}"]) == 2
        assert words in capsys.readouterr().err
    assert not (tmp_path / "c.pgm").exists()


def test_a_floor_seen_by_a_kinect():
    """With true poses occupied cells are where walls, things, and tops and undersides are, or right beside."""
    floor = Floor("sim:floor?plan=testbed&scan_hz=0&depth_hz=0.5&image_width=160")
    mapper = Mapper("default", voxel_size=0.05, max_range=5.0)
    for frame in floor.frames:
        T = floor.truth.at(frame.stamp_ns) @ floor.T_base_camera
        assert mapper.add(replace(frame, T_world_sensor=T)).refused in (None, "no_valid_depth")
    heights = (0.1, 1.8)
    grid = project(mapper.map, heights)
    scores = score_grids(grid, floor.true_grid(0.05, heights, lids=True), align=False)
    assert scores.occupied.tolerance_precision > 0.97
    assert scores.to_reference.p95 <= 0.051
    for thing in floor.plan.obstacles:
        if thing.name in ("table 2: top", "table 3: top", "hung panel"):  # one cell thick, and free below
            low, high = thing.corners.min(axis=0) + 0.025, thing.corners.max(axis=0)
            inside = np.stack(np.mgrid[low[0] : high[0] : 0.05, low[1] : high[1] : 0.05], axis=-1).reshape(-1, 2)
            states = grid.states[tuple(grid.indices(inside).T)]
            assert (states == State.OCCUPIED).mean() > 0.3, thing.name
            assert (states == State.FREE).mean() < 0.25, thing.name
