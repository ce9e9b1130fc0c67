# SPDX-License-Identifier: Apache-2.0
"""The rolling window against a dictionary of cells that does the same slowly."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import ConfigError, MapFileError
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap, load_map, make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage import tiles
from stereovox.maps.storage.tiles import TileStore
from stereovox.maps.storage.window import Window, most_touched, without

CAMERA = PinholeCamera.from_field_of_view(64, 48, 90)


def settings(**more):
    window = {"size": [3.3, 1.7, 2.5], "trigger": 0.35, **{k: v for k, v in more.items() if k != "cell"}}
    return load_config("default", voxel_size=0.1, window=window, **{"map.cell": more.get("cell", "int16")})


def at(position, stamp_ns=0):
    T = np.eye(4)
    T[:3, 3] = position
    return Viewpoint(CAMERA, T, stamp_ns)


def evidence_about(random, position, reach=3, uniform=-400):
    """Random values in random blocks about a place, and some `uniform` blocks."""
    centre = np.floor(np.asarray(position) / 0.8).astype(int)
    around = centre + np.array(list(itertools.product(range(-reach, reach + 1), repeat=3)))
    picked = random.permutation(around)[:60].astype(np.int32)
    values = random.integers(-900, 900, (40, 512)).astype(np.int16)
    values[random.random(values.shape) < 0.5] = 0
    return Evidence(picked[:40].copy(), values, picked[40:].copy(), uniform)


class Slow:
    """A rolling map as a dictionary: cell -> stored number, the window recomputed from the thesis's words."""

    def __init__(self, config):
        self.config, self.cells, self.middle = config, {}, None
        self.n = np.round(np.array(config.window.size) / config.voxel_size).astype(int)

    def set_viewpoint(self, position):
        position = np.asarray(position, float)
        if self.middle is None:
            self.middle = np.round(position / 0.1).astype(int)
        for axis in range(3):
            while abs(position[axis] - self.middle[axis] * 0.1) > self.config.window.trigger + 1e-9:
                self.middle[axis] += int(np.sign(position[axis] - self.middle[axis] * 0.1))
        self.low = (self.middle - self.n // 2).tolist()
        self.high = (self.middle - self.n // 2 + self.n).tolist()
        if self.config.window.outside == "drop":
            self.cells = {c: v for c, v in self.cells.items() if self.inside(c)}

    def inside(self, cell):
        return all(low <= x < high for low, x, high in zip(self.low, cell, self.high, strict=True))

    def add(self, evidence):
        blocks = [(b, v) for b, v in zip(evidence.coords, evidence.values, strict=True)]
        blocks += [(b, np.full(512, v)) for b, v in zip(evidence.uniform, evidence.uniform_values, strict=True)]
        for block, values in blocks:
            x, y, z = (block * 8).tolist()
            for c, value in enumerate(values.tolist()):
                cell = x + (c >> 6), y + ((c >> 3) & 7), z + (c & 7)
                if value and self.inside(cell):
                    total = min(max(self.cells.get(cell, -2197) + value, -4000), 3500)  # prior 0.1
                    self.cells[cell] = total or 1


PATH = [(0, 0, 0), (0.3, 0, 0), (0.5, 0.1, 0), (0.9, -0.4, 0.2), (2.9, -0.4, 0.2), (2.9, 3.0, -1.0), (40, 3, -1),
        (2.0, 0.2, 0.1), (0.05, 0.01, 0.0), (-1.2, -0.9, -0.8), (0, 0, 0)]  # fmt: skip


@pytest.mark.parametrize("uniform", [-400, -4000])  # the latter takes whole blocks to the floor
@pytest.mark.parametrize("outside", ["drop", "keep"])
def test_equals_a_dictionary(outside, uniform):
    config = settings(outside=outside)
    fast, slow = make_map(config), Slow(config)
    random = np.random.default_rng(1)
    for position in PATH:
        fast.storage.set_viewpoint(at(position))
        slow.set_viewpoint(position)
        evidence = evidence_about(random, position, uniform=uniform)
        slow.add(evidence)
        fast.add(evidence)
        indices, log_odds = fast.cells()
        thousandths = np.rint(log_odds.astype(float) * 1000).astype(int)
        assert dict(zip(map(tuple, indices.tolist()), thousandths.tolist(), strict=True)) == slow.cells
        here = {tuple(x // 8 for x in cell) for cell in slow.cells if slow.inside(cell)}
        assert outside == "keep" or {tuple(block) for block in fast.storage.blocks()[0].tolist()} == here
    assert len(slow.cells) > 1000


def test_keep_equals_an_unbounded_map_where_the_window_holds_all_evidence(tmp_path):
    config = load_config("default", voxel_size=0.1, window={"size": [8, 8, 8], "trigger": 0.3, "outside": "keep"})
    rolling, unbounded = make_map(config, tiles=tmp_path / "tiles"), VoxelMap(load_config("default", voxel_size=0.1))
    random = np.random.default_rng(2)
    way = np.linspace(0, 30, 60)
    for x in [*way, *way[::-1]]:
        evidence = evidence_about(random, (x, x / 7, 0), uniform=-1800)
        for one in (rolling, unbounded):
            one.storage.set_viewpoint(at((x, x / 7, 0)))
            one.add(evidence)
    assert len(rolling.storage.tile_store.tiles()) > 20
    for a, b in zip(rolling.storage.blocks(), unbounded.storage.blocks(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert rolling.counts() == unbounded.counts()
    rolling.save(tmp_path / "map")
    for a, b in zip(load_map(tmp_path / "map").storage.blocks(), unbounded.storage.blocks(), strict=True):
        np.testing.assert_array_equal(a, b)
    rolling.close()
    assert not (tmp_path / "tiles").exists()


def test_a_saved_rolling_map_goes_on(tmp_path):
    config = settings(outside="keep")
    random = np.random.default_rng(3)
    whole, half = make_map(config), make_map(config)
    evidences = [(x, evidence_about(random, (x, 0, 0))) for x in [0, 2.0, 6, 12, 5.0, 0.5]]
    for number, (x, evidence) in enumerate(evidences):
        if number == 3:
            half.save(tmp_path / "half")
            half = make_map(config, load_map(tmp_path / "half"))
        for one in (whole, half):
            one.storage.set_viewpoint(at((x, 0, 0)))
            one.add(evidence)
    for a, b in zip(whole.storage.blocks(), half.storage.blocks(), strict=True):
        np.testing.assert_array_equal(a, b)


def test_resuming_a_dropping_map_takes_over_only_the_window(tmp_path):
    config = settings()
    old = VoxelMap.from_cells(config, [[0, 0, 0], [16, 0, 0], [17, 0, 0], [18, 0, 0], [900, 0, 0]], [1, 1, 1, 1, 1])
    old.save(tmp_path / "old")
    new = make_map(config, load_map(tmp_path / "old"))
    new.storage.set_viewpoint(at((0, 0, 0)))
    assert new.cells()[0][:, 0].tolist() == [0, 16]  # 33 cells: -16 to 16


def test_memory_is_constant_and_bounded():
    config = settings()
    rolling = make_map(config)
    before = rolling.memory_bytes
    random = np.random.default_rng(4)
    for x in np.linspace(0, 50, 80):
        rolling.storage.set_viewpoint(at((x, 0, 0)))
        rolling.add(evidence_about(random, (x, 0, 0)))
    assert rolling.memory_bytes == rolling.reserved_bytes == before < 100 * 1100 * 2


def test_a_block_on_the_border_goes_with_its_last_known_cell():
    rolling = make_map(settings())
    rolling.storage.set_viewpoint(at((0, 0, 0)))  # the window begins at cell -16
    values = np.zeros((1, 512), np.int16)
    values[0, 0] = 500
    rolling.add(Evidence(np.array([[-2, 0, 0]], np.int32), values, np.empty((0, 3), np.int32), 0))
    assert rolling.cells()[0].tolist() == [[-16, 0, 0]]
    rolling.storage.set_viewpoint(at((0.36, 0, 0)))  # now at -15: half of the block is still in it
    assert len(rolling.storage.blocks()[0]) == 0


def test_bytes_roll_like_thousandths():
    config = settings(cell="uint8")
    rolling = make_map(config)
    random = np.random.default_rng(5)
    for x in [0, 1, 2, 30, 0]:
        rolling.storage.set_viewpoint(at((x, 0, 0)))
        rolling.add(evidence_about(random, (x, 0, 0)))
    assert rolling.storage.blocks()[1].dtype == np.uint8
    low, high = rolling.window
    cells = rolling.centers(rolling.cells()[0])
    assert ((cells > low) & (cells < high)).all()
    assert (rolling.log_odds([[20.0, 0, 0]]) == 0).all()


def window(**more):
    return Window(settings(**more))


def test_the_window_stays_while_the_camera_is_in_the_trigger_box():
    one = window()
    first = one.follow((0.0, 0.0, 0.0), 0)
    assert first == ((-16, -8, -12), (17, 9, 13))
    assert one.follow((0.34, -0.34, 0.3), 1) == first
    assert one.follow((0.36, 0.0, 0.0), 2) == ((-15, -8, -12), (18, 9, 13))


def test_the_window_leads_in_flight_but_keeps_the_camera():
    leading, plain = window(lead_s=1.0), window()
    for i in range(60):
        ahead, behind = (w.follow((i * 0.05, 0.0, 0.0), i * 33_000_000) for w in (leading, plain))
    assert ahead[0][0] - behind[0][0] >= 8
    assert ahead[0][0] * 0.1 < 59 * 0.05 < ahead[1][0] * 0.1


def test_the_window_grows_with_speed_and_shrinks_again():
    one = window(grow_s=2.0, largest=[6.0, 1.7, 2.5])
    extents = []
    for i, x in enumerate([*np.linspace(0, 3, 60), *[3.0] * 120]):
        low, high = one.follow((x, 0.0, 0.0), i * 33_000_000)
        extents.append(high[0] - low[0])
        assert low[0] * 0.1 < x < high[0] * 0.1
    assert extents[0] == 33
    assert 50 < max(extents) <= 60
    assert extents[-1] <= 41


@pytest.mark.parametrize("shift", [(1, 0, 0), (-2, 3, 1), (100, 0, 0), (0, 0, 0), (4, -4, 4)])
def test_what_is_left_is_listed_once(shift):
    box = ((0, 0, 0), (5, 6, 7))
    other = tuple(tuple(a + s for a, s in zip(corner, shift, strict=True)) for corner in box)

    def cells(of):
        return set(itertools.product(*(range(a, b) for a, b in zip(*of, strict=True))))

    listed = [cell for piece in without(box, other) for cell in cells(piece)]
    assert len(listed) == len(set(listed))
    assert set(listed) == cells(box) - cells(other)


def test_most_touched_is_the_most():
    for n in (1, 2, 7, 8, 9, 16, 17, 100):
        seen = max((start + n - 1) // 8 - start // 8 + 1 for start in range(8))
        assert most_touched((n, 1, 1), 8) == seen


def cut(path):
    path.write_bytes(path.read_bytes()[:-20])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("damage", [cut, flip, Path.unlink])
def test_tiles_that_are_not_what_was_written_are_not_believed(damage, tmp_path):
    store = TileStore(make_map(settings()).storage.cell_format, tmp_path / "tiles")
    cells = np.random.default_rng(6).integers(-2000, 3500, (1, 512)).astype(np.int16)
    store.put((0, 0, 0), np.zeros((1, 3), np.int32), cells)
    store._settle((0, 0, 0))
    damage(next(path for path in (tmp_path / "tiles").rglob("c/*/*/*")))
    for ask in (store.get, lambda tile: store.stored_at(tile, np.zeros((1, 3), np.int64))):
        with pytest.raises(MapFileError, match=r"tiles: tile .*damaged"):
            ask((0, 0, 0))


def test_tiles_come_back_as_they_went(tmp_path, monkeypatch):
    monkeypatch.setattr(tiles, "WAITING", 1)  # all but the last one are read from the disk
    config = settings()
    store = TileStore(make_map(config).storage.cell_format, tmp_path / "tiles")
    random = np.random.default_rng(6)
    kept = {}
    for tile in [(0, 0, 0), (-1, 5, 0), (3, -7, 2)]:
        coords = (np.array(tile) * 4 + [[0, 0, 0], [3, 1, 2]]).astype(np.int32)
        kept[tile] = coords, random.integers(-2000, 3500, (2, 512)).astype(np.int16)
        store.put(tile, *kept[tile])
    for tile, (coords, cells) in kept.items():
        assert tile in store
        for got, wanted in zip(store.get(tile), (coords, cells), strict=True):
            np.testing.assert_array_equal(got, wanted)
        column = random.integers(0, 512, 2)
        asked = coords * 8 + np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
        np.testing.assert_array_equal(store.stored_at(tile, asked), cells[[0, 1], column])
    assert len(list((tmp_path / "tiles").rglob("c/*/*/*"))) >= 2
    assert (9, 9, 9) not in store


def test_bad_settings_and_folders(tmp_path):
    with pytest.raises(ConfigError, match="must be less than half"):
        settings(trigger=5.0)
    with pytest.raises(ConfigError, match="largest no smaller"):
        settings(largest=[1, 1, 1])
    (tmp_path / "something").write_text("x")
    with pytest.raises(MapFileError, match="move it away"):
        make_map(settings(outside="keep"), tiles=tmp_path)


def test_a_fixed_box_stays_and_takes_only_what_lies_in_it():
    """The global map of Valenti 2018, 7.1."""
    config = load_config(voxel_size=0.5, **{"window.size": [4.0, 2.0, 1.0], "window.centre": [1.0, 0.0, 0.0]})
    voxel_map = make_map(config)
    coords = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0) for z in (-1, 0)], np.int32)
    for x in (0.0, 30.0, -7.0):
        T = np.eye(4)
        T[0, 3] = x
        voxel_map.storage.set_viewpoint(Viewpoint(PinholeCamera.from_field_of_view(64, 48, 90), T, int(1e9 * abs(x))))
        voxel_map.add(Evidence(coords, np.full((len(coords), 512), 3000, np.int16), np.empty((0, 3), np.int32), 0))
        np.testing.assert_allclose(voxel_map.window, [[-1, -1, -0.5], [3, 1, 0.5]])
    cells, _ = voxel_map.cells()
    assert len(cells) == 8 * 4 * 2
    np.testing.assert_allclose(voxel_map.bounds(), [[-1, -1, -0.5], [3, 1, 0.5]])
