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
from stereovox.maps.storage.cubes import in_cubes
from stereovox.maps.storage.storage import Storage
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
    indices = np.unique(random.integers([-13, -9, -20], [12, 30, 21], (20000, 3)), axis=0)
    return VoxelMap.from_cells(config, indices, random.choice([-4, -2.5, -0.2, 0.3, 1.2, 3.5], len(indices)))


def slow(voxel_map, heights, floor):
    """{(column, row): (probability, state)} of all columns of which something is known in the band above a floor."""
    up = voxel_map.config.up
    x, y, z = ("xyz".index(axis) for axis in AXES[up])
    side = voxel_map.config.cell[z]
    band = [k for k in range(-200, 200) if k > np.floor(floor / side + 1e-6)
            and (k + 1) * side > floor + heights[0] + 1e-6 and k * side < floor + heights[1] - 1e-6]  # fmt: skip
    cells, log_odds = voxel_map.cells()
    state = voxel_map.state(voxel_map.centers(cells))
    within = {}
    for cell, value, what in zip(cells.tolist(), log_odds.tolist(), state.tolist(), strict=True):
        if (-1 - cell[z] if up.startswith("-") else cell[z]) in band:
            within.setdefault((cell[x], cell[y]), []).append((value, what))
    found = {place: (*max(column), len(column)) for place, column in within.items()}
    return {
        place: (value, state)
        for place, (value, state, number) in found.items()
        if state != State.FREE or number == len(band)
    }


def compare(grid, voxel_map, heights, floor=0.0):
    wanted = slow(voxel_map, heights, floor)
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
@pytest.mark.parametrize(("heights", "floor"), [((0.1, 1.0), 0.0), ((0.15, 0.25), -1.0), ((0.0, 0.2), 0.45)])
def test_equals_the_slow_one(up, heights, floor):
    voxel_map = random_map(settings(up=up))
    grid = project(voxel_map, heights, floor)
    compare(grid, voxel_map, heights, floor)
    assert (grid.states == State.FREE).any() == (heights[1] < 0.5)  # few columns are known so high up


@pytest.mark.parametrize("more", [{"map.cell": "uint8"}, {"map.prior": 0.05}, {"steps": [0.1, 0.1, 0.25]}])
def test_other_cells_equal_the_slow_ones(more):
    voxel_map = random_map(settings(**more), seed=1)
    compare(project(voxel_map, floor=0.0), voxel_map, (0.1, 1.0))


def test_uneven_cells_are_made_cubes():
    voxel_map = random_map(settings(steps=[0.1, 0.2, 0.1]))
    compare(project(voxel_map, floor=0.0), in_cubes(voxel_map), (0.1, 1.0))


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
    compare(project(pieces, floor=0.0), whole, (0.1, 1.0))


OPEN = {0.05 + 0.1 * k: FREE for k in range(1, 10)}
"""All of the band above a floor at 0 is free."""


@pytest.mark.parametrize(
    ("cells", "wanted", "state"),
    [
        (OPEN, percent(FREE), State.FREE),
        ({**OPEN, 0.55: WALL}, percent(WALL), State.OCCUPIED),
        ({**OPEN, 0.55: PERHAPS}, percent(PERHAPS), State.TENTATIVE),
        ({**OPEN, 0.05: WALL, 1.05: WALL}, percent(FREE), State.FREE),  # floor and ceiling mark nothing
        ({**OPEN, 0.15: WALL}, percent(WALL), State.OCCUPIED),  # the lowest and the highest layer that count
        ({**OPEN, 0.95: WALL}, percent(WALL), State.OCCUPIED),
        (dict.fromkeys(list(OPEN)[1:], FREE), -1, State.UNKNOWN),  # a low box may stand there
        (dict.fromkeys(list(OPEN)[:-1], FREE), -1, State.UNKNOWN),  # a lamp may hang there
        ({0.05: WALL, 1.05: FREE, -0.55: FREE}, -1, State.UNKNOWN),  # what is free elsewhere clears nothing
        ({0.55: WALL}, percent(WALL), State.OCCUPIED),
        ({0.55: PERHAPS}, percent(PERHAPS), State.TENTATIVE),
    ],
)
def test_a_column(cells, wanted, state):
    grid = project(column(cells), floor=0.0)
    assert grid.states[0, -1] == State.OCCUPIED
    here = grid.cells[0, 0] if grid.cells.shape[1] == 2 else -1  # what is unknown at the border is no part of the grid
    assert here == wanted
    if wanted != -1:
        assert grid.states[0, 0] == state


def test_heights_that_cannot_be():
    voxel_map = column({0.55: FREE})
    for heights, words in {
        (0.5, 0.5): "rise",
        (1.0, 0.5): "rise",
        (0.1, np.inf): "rise",
        (-0.5, 1.0): "0 or more",
    }.items():
        with pytest.raises(StereovoxError, match=words) as error:
            project(voxel_map, heights, 0.0)
        assert "\n" not in str(error.value)
    with pytest.raises(StereovoxError, match="3 to 4 m above the floor no place"):
        project(voxel_map, (3.0, 4.0), 0.0)
    with pytest.raises(StereovoxError, match="floor inf"):
        project(voxel_map, (0.1, 1.0), np.inf)


@pytest.mark.parametrize("cells", [{}, {0.55: FREE}])
def test_a_map_without_a_floor_is_refused_with_the_cure(cells):
    voxel_map = column(cells) if cells else VoxelMap(settings())
    with pytest.raises(StereovoxError, match=r"shows no floor.*scan\.floor"):
        project(voxel_map)
    stated = VoxelMap.from_cells(settings(**{"scan.floor": 0.0}), *voxel_map.cells())
    if cells:
        np.testing.assert_array_equal(project(stated).cells, project(voxel_map, floor=0.0).cells)


def test_a_grid_that_would_be_too_large():
    voxel_map = VoxelMap.from_cells(settings(), [(-(2**20), 0, 5), (2**20, 2**20, 5)], [WALL, WALL])
    with pytest.raises(StereovoxError, match="too large"):
        project(voxel_map, floor=0.0)


@pytest.mark.parametrize("name", ["floor.pgm", "floor.png", "floor.yaml"])
def test_exported_for_map_server(tmp_path, name):
    voxel_map = random_map(settings())
    export(voxel_map, tmp_path / name, (0.1, 0.6), floor=-1.0)
    grid, found = project(voxel_map, (0.1, 0.6), -1.0), read_map_server(tmp_path / "floor.yaml")
    known = np.isin(grid.states, [State.FREE, State.OCCUPIED])
    np.testing.assert_array_equal(found.states[known], grid.states[known])
    assert (found.cells[~known] == -1).all()
    assert found.origin == pytest.approx(grid.origin)
    other = project(voxel_map, floor=-1.0)
    assert other.cells.shape != grid.cells.shape or (other.cells != grid.cells).any()


@pytest.mark.parametrize("option", [{"heights": (0.1, 1.0)}, {"floor": 0.0}, {"start": (0, 0, 0)}])
def test_heights_are_for_grids_alone(tmp_path, option):
    with pytest.raises(StereovoxError, match=rf"{next(iter(option))} is for 2-D maps.*\.pgm"):
        export(random_map(settings()), tmp_path / "map.ply", **option)
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path, capsys):
    random_map(settings()).save(tmp_path / "map.svox")
    where = str(tmp_path / "map.svox")
    assert main(["export", where, str(tmp_path / "a.pgm"), "--json", "--floor", "0"]) == 0
    shown = capsys.readouterr()
    assert '"heights": [0.1, 1.0]' in shown.out
    assert "stated to be at 0 m" in shown.err
    assert main(["export", where, str(tmp_path / "b.yaml"), "--heights=0.2:0.5", "--floor=-1"]) == 0
    assert "0.2 to 0.5 m above the floor" in capsys.readouterr().err
    first, second = (read_map_server(tmp_path / name) for name in ("a.yaml", "b.yaml"))
    assert first.cells.shape != second.cells.shape or (first.cells != second.cells).any()
    for heights, words in {
        "1": "LO:HI",
        "a:b": "LO:HI",
        "2:1": "higher",
        "8:9": "other heights",
        "-1:1": "0 or more",
    }.items():
        assert main(["export", where, str(tmp_path / "c.pgm"), f"--heights={heights}", "--floor=0"]) == 2
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
    grid = project(mapper.map, heights)  # its floor is found
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
