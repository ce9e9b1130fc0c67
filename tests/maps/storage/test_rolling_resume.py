# SPDX-License-Identifier: Apache-2.0
"""A rolling map that goes on with another, is asked before its first frame, or asked about what lies in its tiles."""

import shutil

import numpy as np
import pytest
from made_manifest import manifest_in, put_manifest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import ConfigError, MapFileError
from stereovox.frame import Viewpoint
from stereovox.mapper import Mapper
from stereovox.maps import State, VoxelMap, load_map, make_map
from stereovox.maps.storage.rolling import RollingMap
from stereovox.maps.storage.window import Window

CAMERA = PinholeCamera.from_field_of_view(64, 48, 90)
CELLS = [[0, 0, 0], [3, 1, -5], [300, 2, 2], [301, 2, 2], [-200, 7, 9]]
LOG_ODDS = [2.0, -1.5, 2.5, -1.0, 0.1]


def settings(size=(3.2, 3.2, 3.2), **more):
    return load_config("default", voxel_size=0.1, window={"size": list(size), "trigger": 0.4, **more})


def at(x, stamp_ns=0):
    T = np.eye(4)
    T[0, 3] = x
    return Viewpoint(CAMERA, T, stamp_ns)


def an_earlier_map():
    return VoxelMap.from_cells(load_config("default", voxel_size=0.1), CELLS, LOG_ODDS)


def same(one, other):
    for a, b in zip(one.storage.blocks(), other.storage.blocks(), strict=True):
        np.testing.assert_array_equal(a, b)


def moved(folder, outside):
    """A saved map whose window has followed a camera."""
    one = make_map(settings(outside=outside, lead_s=1.0))
    one.storage.go_on_with(an_earlier_map().storage)
    for i in range(5):
        one.storage.set_viewpoint(at(0.3 * i, 100_000_000 * i))
    one.frames = 5
    one.save(folder)
    one.close()
    return load_map(folder)


@pytest.mark.parametrize("outside", ["drop", "keep"])
def test_before_the_first_frame_the_earlier_map_is_the_map(tmp_path, outside):
    rolling = make_map(settings(outside=outside), an_earlier_map())
    same(rolling, an_earlier_map())
    assert rolling.counts() == an_earlier_map().counts()
    points = rolling.centers(CELLS)
    np.testing.assert_array_equal(rolling.log_odds(points), an_earlier_map().log_odds(points))
    rolling.save(tmp_path / "m")  # no frame could be used, or Ctrl-C came too early
    same(load_map(tmp_path / "m"), an_earlier_map())
    rolling.close()


@pytest.mark.parametrize("outside", ["drop", "keep"])
def test_the_window_is_remembered_where_no_frame_comes(tmp_path, outside):
    first = moved(tmp_path / "first", outside)
    second = make_map(first.config, first)
    second.save(tmp_path / "second")
    again = load_map(tmp_path / "second")
    assert again.storage.window_state == first.storage.window_state is not None
    same(again, first)
    second.close()


def test_another_window_is_placed_anew_and_the_old_place_forgotten(tmp_path):
    first = moved(tmp_path / "first", "keep")
    wider = settings((4.8, 3.2, 3.2), outside="keep")
    second = make_map(wider, first)
    second.save(tmp_path / "second")
    second.close()
    again = load_map(tmp_path / "second")
    assert again.storage.window_state is None  # or it would be taken for a place of the wider window
    same(again, first)
    third = make_map(wider, again)
    third.storage.set_viewpoint(at(20.0))
    np.testing.assert_allclose(np.diff(third.window, axis=0), [[4.8, 3.2, 3.2]])
    third.close()


def test_cells_in_tiles_are_found_like_all_others():
    rolling = make_map(settings(outside="keep"), an_earlier_map())
    for x in (0.0, 25.0, 1.0, 25.0):  # out and back: a tile on disk that the window touches is out of date
        rolling.storage.set_viewpoint(at(x))
        whole = an_earlier_map()
        random = np.random.default_rng(0)
        points = np.concatenate(
            [rolling.centers(CELLS), random.uniform(-40, 40, (200, 3)), [[np.nan, 0, 0], [9e99] * 3]]
        )
        np.testing.assert_array_equal(rolling.log_odds(points), whole.log_odds(points))
        np.testing.assert_array_equal(rolling.state(points), whole.state(points))
        assert (rolling.state(rolling.occupied()) == State.OCCUPIED).all()
        assert (rolling.state(rolling.free()) == State.FREE).all()
        assert len(rolling.occupied()) == 3
    assert rolling.log_odds(np.zeros((0, 3))).shape == (0,)
    rolling.close()


def test_a_cell_that_changed_since_its_tile_came_back_is_told_as_it_is_now():
    rolling = make_map(settings(outside="keep"), an_earlier_map())
    rolling.storage.set_viewpoint(at(25.0))
    rolling.storage.set_viewpoint(at(0.0))
    rolling.storage.insert(np.zeros((1, 3), np.int32), np.zeros((1, 512), np.int16))
    assert rolling.state(rolling.centers([[0, 0, 0]]))[0] == State.UNKNOWN
    rolling.close()


@pytest.mark.parametrize("placed", [True, False])
def test_a_rolling_map_goes_on_without_a_window(placed):
    rolling = make_map(settings(outside="keep"), an_earlier_map())
    rolling.frames, rolling.recording = 7, "kitchen"
    if placed:
        rolling.storage.set_viewpoint(at(25.0))
    mapper = Mapper("default", voxel_size=0.1, resume=rolling)
    assert type(mapper.map) is VoxelMap
    assert (mapper.map.frames, mapper.map.recording, mapper.map.config.window.size) == (7, "kitchen", None)
    same(mapper.map, an_earlier_map())
    rolling.close()
    with pytest.raises(ConfigError, match="voxel_size"):
        Mapper("default", voxel_size=0.2, resume=mapper.map)


def damaged(**keys):
    return lambda state: {**state, **keys}


@pytest.mark.parametrize(
    "damage",
    [
        damaged(position=[1.0, 2.0]),
        damaged(position=[1.0, 2.0, float("inf")]),
        damaged(box=[[0, 0, 0], [4000, 4000, 4000]]),
        damaged(box=[[0, 0, 0], [0, 0, 0]]),
        damaged(box=[[0, 0, 0]]),
        damaged(box=[[float("inf")] * 3] * 2),
        damaged(box=[[10**30] * 3, [10**30 + 32] * 3]),
        damaged(velocity=[0.0, float("nan"), 0.0]),
        damaged(stamp_ns=float("inf")),
        lambda state: [],
        lambda state: {},
    ],
)
def test_a_damaged_window_is_one_line_and_leaves_no_tiles(tmp_path, damage):
    earlier = moved(tmp_path / "m", "keep")
    manifest = manifest_in(tmp_path / "m" / "manifest.json")
    manifest["window"] = damage(manifest["window"])
    put_manifest(tmp_path / "m" / "manifest.json", manifest)
    with pytest.raises(ConfigError, match="the map's window is damaged") as caught:
        make_map(earlier.config, load_map(tmp_path / "m"), tmp_path / "tiles")
    assert "\n" not in str(caught.value)
    assert not (tmp_path / "tiles").exists()


@pytest.mark.parametrize("changes", [{"voxel_size": 0.2}, {"integrator": "projectiv"}, {"sensor.model": "no"}])
def test_settings_that_are_refused_leave_no_tiles(tmp_path, changes):
    with pytest.raises(ConfigError):
        Mapper(settings(outside="keep"), resume=an_earlier_map(), tiles=tmp_path / "tiles", **changes)
    assert not (tmp_path / "tiles").exists()


def test_tiles_belong_to_one_map_and_what_a_dead_run_left_is_removed(tmp_path):
    living = RollingMap(settings(outside="keep"), tmp_path / "tiles")
    with pytest.raises(MapFileError, match=r"tiles: is being written by another run"):
        RollingMap(settings(outside="keep"), tmp_path / "tiles")
    assert (tmp_path / "tiles" / "zarr.json").is_file()
    shutil.copytree(tmp_path / "tiles", tmp_path / "dead")  # a copy of the lock that nobody holds
    living.close()
    assert not (tmp_path / "tiles").exists()
    (tmp_path / "dead" / "c" / "33554432").mkdir(parents=True)
    (tmp_path / "dead" / "c" / "33554432" / "0.partial").write_text("half a tile")
    RollingMap(settings(outside="keep"), tmp_path / "dead").close()
    assert not (tmp_path / "dead").exists()


@pytest.mark.parametrize("trigger", [0.0, 0.04, 0.05])
def test_a_camera_that_stands_has_a_window_that_stands(trigger):
    config = load_config("default", voxel_size=0.1, window={"size": [3.2, 3.3, 0.1 if trigger == 0 else 3.2],
                                                            "trigger": trigger})  # fmt: skip
    for position in ((0.07, 1.06, 0.0), (0.05, -0.05, 0.15), (0.049, 0.051, -0.999)):
        one = Window(config)
        first = one.follow(position, 0)
        assert {one.follow(position, i) for i in range(1, 6)} == {first}


@pytest.mark.parametrize("size", [[1e308, 4, 4], [1e7, 4, 4]])
def test_a_window_beyond_all_bounds_is_one_line(size):
    with pytest.raises(ConfigError, match="at most 1e"):
        load_config("default", window={"size": size})
    tiny = {"voxel_size": 1e-200, "max_range": 1e-198, "min_range": 0}
    with pytest.raises(ConfigError, match="of memory, more than 8 GB"):
        make_map(load_config("default", **tiny, window={"size": [1e6, 4, 4]}))
