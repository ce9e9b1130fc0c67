"""The voxel map against a plain dict of cells."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereovox.config import load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.maps import State, VoxelMap, load_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import blocks_of_cells

CONFIG = load_config(voxel_size=0.1)
LOWEST, HIGHEST = -4000, 3500


def evidence_of(coords, values, uniform=(), uniform_value=-405):
    return Evidence(
        np.array(coords, np.int32).reshape(-1, 3),
        np.array(values, np.int16).reshape(-1, 512),
        np.array(uniform, np.int32).reshape(-1, 3),
        np.full(len(uniform), uniform_value, np.int16),
    )


def cells_of(voxel_map):
    indices, log_odds = voxel_map.cells()
    return dict(zip(map(tuple, indices.tolist()), np.rint(log_odds * 1000).astype(int).tolist(), strict=True))


@pytest.mark.parametrize(("prior", "first"), [(0.1, -2197), (0.5, 0), (0.6, 405)])
def test_adding_evidence_equals_a_dict(prior, first):
    """`first`: the prior's log-odds in thousandths, from which a cell leaves "unknown"."""
    rng = np.random.default_rng(1)
    voxel_map, plain = VoxelMap(load_config(CONFIG, **{"map.prior": prior})), {}
    for _ in range(30):
        coords = np.unique(rng.integers(-2, 3, (12, 3)), axis=0)
        half = len(coords) // 2
        values = rng.integers(-1500, 1500, (half, 512)) * (rng.random((half, 512)) < 0.3)
        changed = voxel_map.add(evidence_of(coords[:half], values, coords[half:]))
        before = dict(plain)
        everything = np.concatenate([values, np.full((len(coords) - half, 512), -405)])
        for block, row in zip(coords, everything, strict=True):
            for c in np.flatnonzero(row):
                cell = tuple((block * 8 + [c >> 6, (c >> 3) & 7, c & 7]).tolist())
                total = min(max(plain.get(cell, first) + int(row[c]), LOWEST), HIGHEST)
                plain[cell] = total or 1
        assert changed == sum(plain[cell] != before.get(cell) for cell in plain)
    assert cells_of(voxel_map) == plain


def test_the_prior_counts_once_and_says_nothing_of_unknown_cells():
    """Valenti 2018, Eq 6.2: l = l0 + sum of evidence."""
    voxel_map = VoxelMap(load_config(CONFIG, **{"map.prior": 0.2}))
    values = np.zeros(512)
    values[0] = 500
    for _ in range(3):
        voxel_map.add(evidence_of([[0, 0, 0]], [values], [[1, 0, 0]], -300))
    hit, beside, free, elsewhere = [0.05] * 3, [0.05, 0.05, 0.15], [0.85, 0.05, 0.05], [5.0, 5.0, 5.0]
    l0 = np.log(0.2 / 0.8)
    assert voxel_map.log_odds([hit, beside, free, elsewhere]) == pytest.approx([l0 + 1.5, 0, l0 - 0.9, 0], abs=1e-3)
    assert voxel_map.probability([beside, elsewhere]).tolist() == [0.5, 0.5]
    assert voxel_map.state([beside, elsewhere]).tolist() == [State.UNKNOWN, State.UNKNOWN]


def test_evidence_that_just_undoes_the_prior_is_known():
    voxel_map = VoxelMap(load_config(CONFIG, **{"map.prior": 0.1}))
    voxel_map.add(evidence_of([[0, 0, 0]], [np.full(512, 2197)]))
    assert set(cells_of(voxel_map).values()) == {1}
    voxel_map = VoxelMap(load_config(CONFIG, **{"map.prior": 0.6}))
    voxel_map.add(evidence_of([], [], [[0, 0, 0]], -405))
    assert set(cells_of(voxel_map).values()) == {1}


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
def test_limits_near_zero_still_tell_known_from_unknown(cell):
    """Limits that round to "unknown" itself are moved one beyond it: every clamped cell stays known, on its side."""
    narrow = {
        "map.cell": cell,
        "map.log_odds_min": -1e-5,
        "map.log_odds_max": 1e-5,
        "map.prior": 0.5,
        "map.free_below": 0.3,
        "map.occupied_above": 0.7,
    }
    voxel_map = VoxelMap(load_config(CONFIG, **narrow))
    voxel_map.add(evidence_of([[0, 0, 0]], [np.tile([-900, 900], 256)], [[1, 0, 0]], -900))
    low = voxel_map.log_odds([[0.05, 0.05, 0.05], [0.05, 0.05, 0.15], [0.85, 0.05, 0.05]])
    assert (np.sign(low) == [-1, 1, -1]).all()
    assert voxel_map.counts()["tentative"] == 1024


def test_saturated_free_blocks_still_take_hits():
    voxel_map = VoxelMap(CONFIG)
    free = evidence_of([], [], [[0, 0, 0]])
    assert voxel_map.add(free) == 512
    assert voxel_map.log_odds([[0.05, 0.05, 0.75]])[0] == pytest.approx(-2.197 - 0.405)
    for _ in range(10):
        voxel_map.add(free)
    assert voxel_map.add(free) == 0
    hit = np.zeros(512)
    hit[7] = 847
    assert voxel_map.add(evidence_of([[0, 0, 0]], [hit])) == 1
    assert voxel_map.log_odds([[0.05, 0.05, 0.75]])[0] == pytest.approx(-4 + 0.847)
    assert voxel_map.add(free) == 1, "the hit cell must be cleared again, the flag is gone"


def test_blocks_without_evidence_are_not_made():
    voxel_map = VoxelMap(CONFIG)
    before = voxel_map.memory_bytes
    voxel_map.add(evidence_of([[5, 5, 5]], [np.zeros(512)]))
    assert voxel_map.memory_bytes == before
    assert voxel_map.bounds() is None


def test_states_and_probabilities():
    cells = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]
    voxel_map = VoxelMap.from_cells(CONFIG, cells, [-3.0, -1.5, 1.0, 0.0])
    points = voxel_map.centers([*cells, [9, 9, 9]])
    states = [State.FREE, State.TENTATIVE, State.OCCUPIED, State.OCCUPIED, State.UNKNOWN]
    assert voxel_map.state(points).tolist() == states
    assert voxel_map.probability(points)[:3] == pytest.approx(1 / (1 + np.exp([3.0, 1.5, -1.0])), abs=1e-3)
    assert voxel_map.probability(points)[4] == 0.5
    assert voxel_map.counts() == {"free": 1, "tentative": 1, "occupied": 2}
    assert voxel_map.occupied() == pytest.approx(np.array([[0.25, 0.05, 0.05], [0.35, 0.05, 0.05]]))
    assert voxel_map.free() == pytest.approx(np.array([[0.05, 0.05, 0.05]]))
    assert voxel_map.bounds() == pytest.approx(np.array([[0, 0, 0], [0.4, 0.1, 0.1]]))


def test_strange_points_are_unknown():
    voxel_map = VoxelMap.from_cells(CONFIG, [[-1, -1, -1]], [3.0])
    points = [[np.nan, 0, 0], [np.inf, 0, 0], [1e300, 0, 0], [-1e12, 0, 0], [-0.05, -0.05, -0.05]]
    assert voxel_map.state(points).tolist() == [0, 0, 0, 0, State.OCCUPIED]
    assert voxel_map.log_odds(np.empty((0, 3))).shape == (0,)


cell_lists = st.lists(st.tuples(*[st.integers(-300, 300)] * 3), min_size=0, max_size=60, unique=True).flatmap(
    lambda cells: st.tuples(
        st.just(cells), st.lists(st.integers(-1999, 3499), min_size=len(cells), max_size=len(cells))
    )
)


@settings(max_examples=60, deadline=None)
@given(cell_lists)
def test_cells_come_back_as_they_went_in(case):
    cells, units = case
    voxel_map = VoxelMap.from_cells(CONFIG, cells, np.array(units) / 1000)
    assert cells_of(voxel_map) == {cell: unit or 1 for cell, unit in zip(cells, units, strict=True)}
    shuffled = VoxelMap.from_cells(CONFIG, cells[::-1], np.array(units[::-1]) / 1000)
    assert [a.tolist() for a in shuffled.storage.blocks()] == [a.tolist() for a in voxel_map.storage.blocks()]


def random_map(seed=0, number=4000):
    rng = np.random.default_rng(seed)
    voxel_map = VoxelMap.from_cells(CONFIG, rng.integers(-90, 90, (number, 3)), rng.normal(0, 2, number))
    voxel_map.frames = 17
    return voxel_map


def test_save_load_save(tmp_path):
    first = random_map()
    first.save(tmp_path / "a.svox")
    second = load_map(tmp_path / "a.svox")
    second.save(tmp_path / "b.svox")
    third = load_map(tmp_path / "b.svox")
    for other in (second, third):
        assert all((a == b).all() for a, b in zip(first.storage.blocks(), other.storage.blocks(), strict=True))
        assert other.frames == 17
        assert other.config == CONFIG
    second.add(evidence_of([], [], [[0, 0, 0]]))  # a loaded map goes on


def test_saving_again_replaces_and_leaves_nothing_behind(tmp_path):
    random_map(1).save(tmp_path / "m")
    random_map(2).save(tmp_path / "m")
    assert (load_map(tmp_path / "m").storage.blocks()[1] == random_map(2).storage.blocks()[1]).all()
    assert len(list((tmp_path / "m").glob("cells-*"))) == 1


def test_a_save_that_dies_leaves_the_old_map(tmp_path, monkeypatch):
    random_map(1).save(tmp_path / "m")
    monkeypatch.setattr(
        "pathlib.Path.replace", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    with pytest.raises(MapFileError, match="No space left"):
        random_map(2).save(tmp_path / "m")
    assert (load_map(tmp_path / "m").storage.blocks()[1] == random_map(1).storage.blocks()[1]).all()


def test_empty_map(tmp_path):
    empty = VoxelMap(CONFIG)
    assert empty.cells()[0].shape == (0, 3)
    assert empty.occupied().shape == (0, 3)
    empty.save(tmp_path / "e")
    assert load_map(tmp_path / "e").counts() == {"free": 0, "tentative": 0, "occupied": 0}


def test_damaged_maps_end_in_one_line(tmp_path):
    with pytest.raises(MapFileError, match="no stereovox map here"):
        load_map(tmp_path / "nothing")
    random_map().save(tmp_path / "m")
    manifest = tmp_path / "m" / "manifest.json"
    good = manifest.read_text()
    # fmt: off
    for bad in ["", "[]", "{}", good[: len(good) // 2], good.replace("stereovox-map", "x"),
                good.replace('"version": 4', '"version": 9'),
                good.replace('"blocks": ', '"blocks": 9'), good.replace('"data": "', '"data": "../'),
                good.replace('"voxel_size": 0.1', '"voxel_size": -1')]:
    # fmt: on
        manifest.write_text(bad)
        with pytest.raises(MapFileError) as caught:
            load_map(tmp_path / "m")
        assert "\n" not in str(caught.value)
        assert str(tmp_path / "m") in str(caught.value)
    manifest.write_text(good)
    chunk = max((tmp_path / "m").rglob("c/0/0"), key=lambda path: path.stat().st_size)
    chunk.write_bytes(chunk.read_bytes()[:50])
    with pytest.raises(MapFileError):
        load_map(tmp_path / "m")
    chunk.unlink()
    with pytest.raises(MapFileError, match="checksum"):
        load_map(tmp_path / "m")


def test_refuses_to_overwrite_what_is_no_map(tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    with pytest.raises(MapFileError, match="not a stereovox map"):
        random_map().save(tmp_path)
    with pytest.raises(MapFileError, match="not a stereovox map"):
        random_map().save(tmp_path / "thesis.txt")
    assert (tmp_path / "thesis.txt").read_text() == "years of work"


@pytest.mark.parametrize("reach", [0, 20, 2**30, 2**62])
def test_the_blocks_of_cells_are_those_of_plain_rows(reach):
    cells = np.random.default_rng(0).integers(-reach - 1, reach, (300, 3))
    blocks, of_cell = blocks_of_cells(cells)
    wanted, of_row = np.unique(cells // 8, axis=0, return_inverse=True)
    np.testing.assert_array_equal(blocks, wanted)
    np.testing.assert_array_equal(of_cell, of_row.ravel())
    assert [part.shape for part in blocks_of_cells(cells[:0])] == [(0, 3), (0,)]


@pytest.mark.parametrize(
    "indices",
    [
        [[np.nan, 0, 0]],
        [[0.5, 0, 0]],
        [[2**30 + 1, 0, 0]],
        [[-(2**40), 0, 0]],
        [[1j, 0, 0]],
        [["a", 0, 0]],
        [[0], [1, 2]],
    ],
)
def test_cells_that_are_none_are_refused(indices):
    with pytest.raises(StereovoxError, match="indices"):
        VoxelMap.from_cells(load_config(), indices, [1.0])


@pytest.mark.parametrize("log_odds", [[np.nan], ["a"], None])
def test_log_odds_that_are_none_are_refused(log_odds):
    with pytest.raises(StereovoxError, match="log_odds"):
        VoxelMap.from_cells(load_config(), [[0, 0, 0]], log_odds)


def test_blocks_of_another_shape_are_refused():
    voxel_map = VoxelMap(load_config())
    with pytest.raises(StereovoxError, match=r"cells \(1, 5\)"):
        voxel_map.storage.insert(np.zeros((1, 3), np.int32), np.zeros((1, 5), np.int16))
    assert voxel_map.counts() == {"free": 0, "tentative": 0, "occupied": 0}


def test_listeners_can_be_replaced():
    voxel_map, seen = VoxelMap(load_config()), []
    voxel_map.listeners = [seen.append]
    assert voxel_map.storage.listeners == [seen.append]
