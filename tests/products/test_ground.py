# SPDX-License-Identifier: Apache-2.0
"""Ground on floors with ramps, stairs, tables, lintels and pits; whichever way is up."""

import itertools

import numpy as np
import pytest

from stereovox import State, StereovoxError, VoxelMap, ground, load_config
from stereovox.products.ground import Footing, Robot, beside, slopes, write_ground

SIDE = 0.05
HIGH = 30
"""Cells of height that are known above the floor."""
AXES = {"z": "xyz", "-z": "yxz", "y": "zxy", "-y": "xzy", "x": "yzx", "-x": "zyx"}
"""For each axis that may point up: the map's axes along the grid's x and y, and up."""
SMALL = Robot(height=0.5, radius=0.1, max_step=0.1, max_slope_deg=25.0)


class Scene:
    """Columns of cells, x to the right and y away: a height in cells of the floor's upper face, and things on it."""

    def __init__(self, columns=40, rows=20):
        self.floor = np.zeros((rows, columns), int)
        self.obstacles = {}

    def thing(self, columns, rows, heights, log_odds=3.0):
        self.obstacles |= dict.fromkeys(itertools.product(range(*columns), range(*rows), range(*heights)), log_odds)
        return self

    def map(self, up="z", **more):
        cells = {}
        for (row, column), top in np.ndenumerate(self.floor):
            cells |= {(column, row, top - k): 3.0 for k in (1, 2)}
            cells |= {(column, row, k): -3.0 for k in range(top, HIGH)}
        cells |= self.obstacles
        cells = {cell: value for cell, value in cells.items() if value != 0}
        order = ["xyz".index(axis) for axis in AXES[up]]
        indices = np.empty((len(cells), 3), int)
        indices[:, order] = list(cells)
        if up.startswith("-"):
            indices[:, order[2]] = -1 - indices[:, order[2]]
        return VoxelMap.from_cells(load_config(**{"voxel_size": SIDE, "up": up, **more}), indices, list(cells.values()))


def footing(scene, robot=SMALL, **more):
    return ground(scene.map(**more), robot).footing


@pytest.mark.parametrize("up", AXES)
def test_a_floor_with_a_block_whichever_way_is_up(up):
    scene = Scene().thing((10, 14), (5, 8), (0, 6))
    found = ground(scene.map(up), SMALL)
    assert found.footing.shape == (20, 40)
    assert found.resolution == SIDE
    assert found.origin == (0.0, 0.0, 0.0)
    wanted = np.full((20, 40), Footing.DRIVABLE)
    wanted[5:8, 10:14] = Footing.OBSTACLE
    np.testing.assert_array_equal(found.footing, wanted)
    assert np.isnan(found.height[5:8, 10:14]).all()
    assert (found.height[wanted == Footing.DRIVABLE] == 0.0).all()
    grid = found.grid
    assert (grid.states[wanted == Footing.DRIVABLE] == State.FREE).all()
    assert (grid.states[5:8, 10:14] == State.OCCUPIED).all()


@pytest.mark.parametrize(("degrees", "wanted"), [(15, Footing.DRIVABLE), (40, Footing.STEEP)])
def test_a_ramp(degrees, wanted):
    scene = Scene()
    scene.floor[:, 10:] = np.floor(np.arange(30) * np.tan(np.radians(degrees)))[None]
    scene.floor[:, 30:] = scene.floor[:, 29:30]
    found = ground(scene.map(), SMALL)
    assert (found.footing[4:-4, 14:26] == wanted).all()
    np.testing.assert_allclose(found.height, scene.floor * SIDE, atol=1e-6)  # it is ground, steep or not
    assert (found.footing[4:-4, 33:] == Footing.DRIVABLE).all()


def test_stairs_end_at_the_first_riser():
    scene = Scene()
    scene.floor[:] = np.repeat([0, 3, 6, 9], 10)[None]  # risers of 15 cm
    found = footing(scene)
    assert (found[:, :10] == Footing.DRIVABLE).all()
    assert (found[:, 10:] == Footing.OBSTACLE).all()
    climber = Robot(height=0.5, radius=0.1, max_step=0.15, max_slope_deg=60.0)
    assert (footing(scene, climber) == Footing.DRIVABLE).all()


@pytest.mark.parametrize(("height", "wanted"), [(0.4, Footing.DRIVABLE), (0.6, Footing.OBSTACLE)])
def test_a_table_top_is_no_ground(height, wanted):
    scene = Scene().thing((15, 25), (5, 15), (10, 11))  # 50 cm up
    robot = Robot(height=height, radius=0.1)
    found = ground(scene.map(), robot)
    assert (found.footing[5:15, 15:25] == wanted).all()
    assert np.nanmax(found.height) == 0.0


@pytest.mark.parametrize(("height", "wanted"), [(0.9, Footing.DRIVABLE), (1.1, Footing.OBSTACLE)])
def test_a_doorway_with_a_lintel(height, wanted):
    scene = Scene().thing((20, 22), (0, 20), (0, 30)).thing((20, 22), (8, 13), (0, 20), -3.0)
    found = footing(scene, Robot(height=height, radius=0.1))
    assert (found[8:13, 20:22] == wanted).all()
    assert (found[:8, 20:22] == Footing.OBSTACLE).all()
    assert (found[:, 22:] == Footing.DRIVABLE).all()  # behind the lintel: an island that is as high


def test_a_pit_is_a_drop_and_its_rim_is_not():
    scene = Scene()
    scene.floor[5:15, 15:25] = -8
    found = footing(scene)
    assert (found[5:15, 15:25] == Footing.DROP).all()
    assert (found == Footing.DROP).sum() == 100


def test_a_ledge_beside_a_ramp_is_a_step():
    """Both are ground, since a ramp leads up; where they lie next to one another, nobody drives across."""
    scene = Scene()
    scene.floor[10:, 10:] = np.minimum(np.arange(30) // 4, 5)[None]
    found = footing(scene)
    assert (found[9:11, 30:] == Footing.STEP).all()
    assert (found[12:, 30:] == Footing.DRIVABLE).all()
    assert (found[:8, 30:] == Footing.DRIVABLE).all()


@pytest.mark.parametrize(
    ("heights", "log_odds", "wanted"),
    [
        ((4, 5), 0.0, Footing.UNKNOWN),
        ((4, 5), -1.5, Footing.TENTATIVE),
        ((1, 2), -1.5, Footing.DRIVABLE),  # lower than a step: never mind
        ((0, 2), 3.0, Footing.DRIVABLE),  # the robot climbs it
        ((12, 13), 3.0, Footing.DRIVABLE),  # above its head
        ((9, 10), 3.0, Footing.OBSTACLE),
        ((-2, 0), 0.0, Footing.UNKNOWN),  # no floor was seen
    ],
)
def test_what_is_above_the_floor(heights, log_odds, wanted):
    found = footing(Scene().thing((12, 30), (6, 14), heights, log_odds))
    assert (found[8:12, 15:27] == wanted).all()
    assert (found[:4] == Footing.DRIVABLE).all()


def test_an_island_beyond_what_was_not_seen():
    scene = Scene().thing((15, 20), (0, 20), (-2, HIGH), 0.0)
    assert (footing(scene)[:, 20:] == Footing.DRIVABLE).all()
    scene.floor[:, 20:] = 5
    found = footing(scene)
    assert (found[:, 15:20] == Footing.UNKNOWN).all()
    assert (found[:, 20:] == Footing.OBSTACLE).all()


def test_where_the_robot_is_tells_which_floor():
    scene = Scene(60).thing((10, 50), (0, 20), (18, 20))  # an upper floor over a part of the lower one
    robot = Robot(height=0.5, radius=0.1)
    below, above = ground(scene.map(), robot), ground(scene.map(), robot, start=[1.5, 0.5, 1.2])
    assert (below.height == 0).all()
    assert (above.height[:, 10:50] == np.float32(1.0)).all()
    assert np.isnan(above.height[:, :10]).all()
    assert (above.footing[:, :10] == Footing.DROP).all()
    assert (above.footing[:, 10:50] == Footing.DRIVABLE).all()


@pytest.mark.parametrize("more", [{"map.cell": "uint8"}, {"map.cell": "int8"}, {"steps": [0.05, 0.05, 0.025]}])
def test_other_cells(more):
    found = ground(Scene().thing((10, 14), (5, 8), (0, 9)).map(**more), Robot(height=0.4, radius=0.1))
    assert (found.footing[5:8, 10:14] == Footing.OBSTACLE).all()
    assert (found.footing == Footing.DRIVABLE).sum() == 800 - 12


def test_slopes_are_those_of_the_plane_that_fits_best():
    random = np.random.default_rng(0)
    height = random.normal(size=(9, 12))
    height[random.random(height.shape) < 0.3] = np.nan
    found, reach = slopes(height, 0.5, 1.0), 2
    for row, column in np.ndindex(*height.shape):
        rows, columns = (slice(max(i - reach, 0), i + reach + 1) for i in (row, column))
        y, x = np.nonzero(~np.isnan(height[rows, columns]))
        z = height[rows, columns][y, x]
        plane = np.linalg.lstsq(np.column_stack([x * 0.5, y * 0.5, np.ones(len(x))]), z, rcond=None)[0]
        wanted = 0.0 if np.isnan(height[row, column]) else np.hypot(*plane[:2])
        assert found[row, column] == pytest.approx(wanted)
    assert slopes(np.array([[0.0, 1.0, 2.0]]), 1.0, 1.0).tolist() == [[0, 0, 0]]
    np.testing.assert_allclose(slopes(np.array([[0.0, 1.0, 2.0]] * 2), 1.0, 1e9), 1)  # no wider than all there is


def test_steps_beside():
    height = np.array([[0.0, 0.5, np.nan], [0.0, 0.0, np.nan], [np.nan, np.nan, 3.0]])
    assert beside(height).tolist() == [[0.5, 0.5, 0.0], [0.5, 3.0, 0.0], [0.0, 0.0, 3.0]]


def test_saved_for_numpy(tmp_path):
    found = ground(Scene().map(), SMALL)
    write_ground(found, tmp_path / "ground.npz")
    saved = np.load(tmp_path / "ground.npz")
    np.testing.assert_array_equal(saved["height"], found.height)
    np.testing.assert_array_equal(saved["footing"], found.footing)
    assert (saved["resolution"], saved["origin"].tolist()) == (SIDE, [0, 0, 0])


def test_nonsense():
    for bad in ({"height": 0.1}, {"max_step": -1}, {"radius": 0}, {"max_slope_deg": 90}, {"height": np.inf}):
        with pytest.raises(StereovoxError):
            Robot(**bad)
    with pytest.raises(StereovoxError, match="empty"):
        ground(VoxelMap(load_config()))
    with pytest.raises(StereovoxError, match="no ground"):
        ground(VoxelMap.from_cells(load_config(), [(0, 0, 0)], [-3.0]))
    with pytest.raises(StereovoxError, match="start"):
        ground(Scene().map(), SMALL, start=[0, 0])
    far = VoxelMap.from_cells(load_config(), [(-(2**24), 0, 0), (2**24, 2**24, 0)], [3.0, 3.0])
    with pytest.raises(StereovoxError, match="too large"):
        ground(far)
