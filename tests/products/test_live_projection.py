# SPDX-License-Identifier: Apache-2.0
"""A map kept from above block by block is the map seen from above as a whole, after every frame."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.maps import State
from stereovox.maps.storage.storage import Storage
from stereovox.maps.voxel_map import VoxelMap
from stereovox.products.projection import STEP, LiveProjection, project
from stereovox.simulate.simulation import Simulation

CAMERA = PinholeCamera.from_field_of_view(24, 18, 80.0)


def frames(number: int, seed: int):
    """A camera that turns and moves; boxes come and go before it."""
    random = np.random.default_rng(seed)
    for k in range(number):
        yaw = 0.9 * k
        forward, left = np.array([np.cos(yaw), np.sin(yaw), 0]), np.array([-np.sin(yaw), np.cos(yaw), 0])
        T = np.eye(4)
        T[:3, :3] = np.stack([-left, [0, 0, -1.0], forward], axis=1)
        T[:3, 3] = 0.7 * k * np.array([1, -0.5, 0]) + [0, 0, 0.8]
        depth = np.full((18, 24), random.uniform(1.5, 3.5), np.float32)
        depth[:, random.integers(0, 20) :][:, :4] = random.uniform(0.8, 1.4)
        yield Frame(depth, CAMERA, T, k * 10**9)


def assert_same(shown, expected):
    rows, columns = shown.known_span
    np.testing.assert_array_equal(shown.cells[rows, columns], expected.cells)
    left, bottom = shown.origin[0] + columns.start * shown.resolution, shown.origin[1] + rows.start * shown.resolution
    assert (left, bottom) == pytest.approx(expected.origin[:2], abs=1e-6)
    assert (shown.free_below, shown.occupied_above) == (expected.free_below, expected.occupied_above)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"map.cell": "uint8"},
        {"map.cell": "int8", "up": "-z", "scan.floor": -1.9},
        {"window.size": (6.0, 6.0, 4.0), "window.trigger": 0.2},
        {"map.keep_times": True, "map.forget_s": 2.5},
        {"steps": (0.2, 0.2, 0.1)},
    ],
)
def test_after_every_frame_it_is_the_map_from_above(settings):
    mapper = Mapper("default", **{"voxel_size": 0.2, "max_range": 3.0, "scan.floor": 0.0, **settings})
    live = LiveProjection(mapper.map)
    assert live.grid() is None
    for k, frame in enumerate(frames(7, seed=1)):
        assert mapper.add(frame).refused is None
        if k % 3 != 1:  # some frames are looked at together
            assert_same(live.grid(), project(mapper.map))
    assert (np.array(live.grid().cells.shape) % STEP == 0).all()


def room_below_the_origin(number: int):
    """A furnished room whose floor lies 1.3 m below where the camera began."""
    simulation = Simulation("sim:room?image_width=96", frames=120)
    start = simulation.true_pose(0)[:3, 3]
    for k in range(number):
        T = simulation.true_pose(k).copy()
        T[:3, 3] -= start
        yield replace(simulation.frame(k), T_world_sensor=T)


def test_a_floor_that_is_found_moves_with_the_map():
    mapper = Mapper("default", voxel_size=0.1)
    live, free = LiveProjection(mapper.map, floor_s=0.0, clock=lambda: 0.0), []
    for k, frame in enumerate(room_below_the_origin(12)):
        mapper.add(frame)
        if k in (4, 7, 11):
            grid = live.grid()
            assert_same(grid, project(mapper.map))
            free.append(np.count_nonzero(grid.states == State.FREE))
            assert live.floor.height.min() == pytest.approx(-1.3, abs=0.11)
    assert free[-1] > free[0] > 0


def test_between_two_searches_the_floor_stays_and_new_places_wait():
    now = [0.0]
    mapper = Mapper("default", voxel_size=0.1)
    live = LiveProjection(mapper.map, floor_s=1.0, clock=lambda: now[0])
    frames = room_below_the_origin(8)
    for _ in range(4):
        mapper.add(next(frames))
    live.grid()
    floor = live.floor
    mapper.add(next(frames))
    live.grid()
    assert live.floor is floor
    now[0] = 1.5
    assert_same(live.grid(), project(mapper.map))
    assert live.floor is not floor


def test_without_a_floor_nothing_is_free_and_it_is_told_once():
    mapper, lines = Mapper("default", voxel_size=0.2, max_range=3.0), []
    live = LiveProjection(mapper.map, notify=lines.append, floor_s=0.0, clock=lambda: 0.0)
    for frame in frames(8, seed=5):
        mapper.add(frame)
        grid = live.grid()
        assert (grid.states == State.UNKNOWN).all()
    assert len(lines) == 1
    assert "scan.floor" in lines[0]


def test_it_looks_at_what_changed_alone(monkeypatch):
    mapper = Mapper("default", voxel_size=0.2, max_range=3.0, **{"scan.floor": 0.0})
    live, looked = LiveProjection(mapper.map), []
    within = Storage.blocks_within
    monkeypatch.setattr(Storage, "blocks_within", lambda *a: looked.append(within(*a)) or looked[-1])
    for frame in frames(6, seed=2):
        mapper.add(frame)
        live.grid()
    assert len(looked[-1][0]) < 0.6 * len(mapper.map.storage.blocks()[0])
    assert live.grid().cells.size
    assert len(looked[-1][0]) == 0  # nothing changed since


def test_cells_that_were_handed_out_do_not_change():
    mapper = Mapper("default", voxel_size=0.2)
    live = LiveProjection(mapper.map, floor=0.0)
    first, second, *_ = frames(3, seed=3)
    mapper.add(first)
    before = live.grid()
    copy = before.cells.copy()
    mapper.add(second)
    live.grid()
    np.testing.assert_array_equal(before.cells, copy)


def test_heights_and_steps_that_cannot_be_are_told():
    with pytest.raises(StereovoxError, match="heights"):
        LiveProjection(VoxelMap(load_config(voxel_size=0.2)), (1.0, 0.0))
    with pytest.raises(StereovoxError, match="as long as wide"):
        LiveProjection(VoxelMap(load_config(steps=(0.1, 0.2, 0.1))))


def test_a_grid_that_were_too_large_is_told_and_the_map_goes_on():
    mapper = Mapper("default", voxel_size=0.2, **{"trust.ordered": False})
    live = LiveProjection(mapper.map, floor=0.0)
    near = next(frames(1, seed=4))
    mapper.add(near)
    shown = live.grid()
    T = near.T_world_sensor.copy()
    T[:2, 3] += 50_000.0
    assert mapper.add(replace(near, T_world_sensor=T, sensor="far")).refused is None
    with pytest.raises(StereovoxError, match=r"window\.size"):
        live.grid()
    assert shown.cells.size
