"""The 2-D grid: grows anywhere, means what a voxel map means, and shows itself as per cent."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereovox.config import load_config
from stereovox.errors import ConfigError, MapFileError, StereovoxError
from stereovox.geometry import se2
from stereovox.maps import State
from stereovox.maps.cells.evidence import CELLS, GridEvidence
from stereovox.maps.grid_map import GridMap, load_grid
from stereovox.maps.occupancy import OccupancyGrid

EVEN = {"grid.prior": 0.5, "map.log_odds_min": -4.0, "map.log_odds_max": 4.0, "voxel_size": 0.1}


def evidence_of(cells):
    """Evidence of {(column, row): thousandths}."""
    tiles = {}
    for (i, j), value in cells.items():
        tiles.setdefault((i >> 6, j >> 6, 0), np.zeros(CELLS, np.int32))[((j & 63) << 6) | (i & 63)] += value
    return GridEvidence(
        np.array(list(tiles), np.int32).reshape(-1, 3), np.array(list(tiles.values())).reshape(-1, CELLS)
    )


def complaint_about(path, data):
    path.write_bytes(data)
    try:
        load_grid(path)
    except MapFileError as error:
        return str(error)
    return ""


def known(grid_map):
    indices, log_odds = grid_map.cells()
    return dict(zip(map(tuple, indices.tolist()), np.rint(1000 * log_odds).astype(int).tolist(), strict=True))


cells = st.dictionaries(
    st.tuples(st.integers(-300, 300), st.integers(-300, 300)), st.integers(-3000, 3000).filter(bool), max_size=8
)


@settings(max_examples=60, deadline=None)
@given(scans=st.lists(cells, max_size=5), prior=st.sampled_from([0.1, 0.5]))
def test_any_sequence_of_evidence_equals_a_dict(scans, prior):
    grid_map = GridMap(load_config(**{**EVEN, "grid.prior": prior}))
    start = round(1000 * np.log(prior / (1 - prior)))
    wanted = {}
    for scan in scans:
        before = dict(wanted)
        for cell, value in scan.items():
            wanted[cell] = min(max(wanted.get(cell, start) + value, -4000), 4000) or 1
        assert grid_map.add(evidence_of(scan)) == sum(before.get(cell, 0) != wanted[cell] for cell in scan)
    assert known(grid_map) == wanted


def test_it_grows_in_every_direction_and_keeps_its_cells():
    grid_map = GridMap(load_config(**EVEN))
    placed = {}
    for k, step in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1), (-1, 1), (1, -1), (1, 1), (-1, -1)] * 3):
        cell = (step[0] * 97 * (k + 1), step[1] * 131 * (k + 1))
        placed[cell] = 500 + k
        grid_map.add(evidence_of({cell: 500 + k}))
        assert known(grid_map) == placed
    far = 2**29
    grid_map.add(evidence_of({(far, -far): 2000}))
    assert grid_map.state([[(far + 0.5) * 0.1, (-far + 0.5) * 0.1]]).tolist() == [State.OCCUPIED]
    assert grid_map.memory_bytes < 1e6


def test_the_order_of_scans_does_not_matter_before_clamping():
    rng = np.random.default_rng(0)
    places, values = rng.integers(-90, 90, (6, 50, 2)), rng.integers(1, 99, (6, 50)) * rng.choice([-1, 1], (6, 50))
    scans = [dict(zip(map(tuple, p.tolist()), v.tolist(), strict=True)) for p, v in zip(places, values, strict=True)]
    maps = [GridMap(load_config(**EVEN)) for _ in range(2)]
    for scan in scans:
        maps[0].add(evidence_of(scan))
    for scan in reversed(scans):
        maps[1].add(evidence_of(scan))
    there, back = (known(grid_map) for grid_map in maps)
    assert there.keys() == back.keys()
    assert all(abs(there[cell] - back[cell]) <= 1 for cell in there)  # a sum of 0 on the way is stored as 1


def test_states_probabilities_and_counts():
    grid_map = GridMap(load_config(**EVEN))
    grid_map.add(evidence_of({(0, 0): -2000, (1, 0): 2000, (2, 0): 300, (-1, -1): 2000}))
    points = [[0.05, 0.05], [0.15, 0.05], [0.25, 0.05], [-0.05, -0.05], [5, 5], [np.nan, 0], [1e300, 0]]
    free, occupied, between, unknown = State.FREE, State.OCCUPIED, State.TENTATIVE, State.UNKNOWN
    assert grid_map.state(points).tolist() == [free, occupied, between, occupied, unknown, unknown, unknown]
    wanted = 1 / (1 + np.exp(-np.array([-2, 2, 0.3, 2, 0, 0, 0])))
    np.testing.assert_allclose(grid_map.probability(points), wanted, atol=1e-6)
    assert grid_map.counts() == {"free": 1, "tentative": 1, "occupied": 2}
    np.testing.assert_allclose(grid_map.occupied(), [[-0.05, -0.05], [0.15, 0.05]])
    np.testing.assert_allclose(grid_map.free(), [[0.05, 0.05]])
    np.testing.assert_allclose(grid_map.bounds(), [[-0.1, -0.1], [0.3, 0.1]])


def test_the_picture_is_just_large_enough_and_stands_where_the_cells_are():
    grid_map = GridMap(load_config(**EVEN), (3.0, -1.0, 0.5))
    grid_map.add(evidence_of({(-70, 3): -2000, (5, 130): 2000, (0, 64): 300}))
    grid = grid_map.occupancy()
    assert grid.cells.shape == (128, 76)
    assert np.argwhere(grid.cells >= 0).tolist() == [[0, 0], [61, 70], [127, 75]]
    assert grid.cells[[0, 61, 127], [0, 70, 75]].tolist() == [12, 57, 88]
    np.testing.assert_allclose(grid.centres([127], [75]), grid_map.occupied())
    np.testing.assert_allclose(se2.transform(grid_map.origin, [[0.55, 13.05]]), grid_map.occupied())
    assert grid_map.state(grid.centres([0, 127, 61], [0, 75, 70])).tolist() == [1, 3, 2]


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
@pytest.mark.parametrize("prior", [0.03, 0.1, 0.5, 0.9])
@pytest.mark.parametrize("thresholds", [(0.3, 0.7), (0.196, 0.65), (0.005, 0.995)])
def test_a_cell_has_one_state_in_the_map_and_in_the_picture(cell, prior, thresholds):
    free, occupied = thresholds
    config = load_config(
        **{
            "map.cell": cell,
            "grid.prior": prior,
            "map.free_below": free,
            "map.occupied_above": occupied,
            "voxel_size": 0.1,
        }
    )
    grid_map = GridMap(config)
    grid_map.add(evidence_of({(i, i % 7): 20 * i - 8000 or 1 for i in range(800)}))
    indices, _ = grid_map.cells()
    assert len(indices) >= 799  # a byte has no room for the smallest evidence
    grid = grid_map.occupancy()
    points = (indices + 0.5) * 0.1
    rows, columns = grid.indices(points).T
    assert grid.states[rows, columns].tolist() == grid_map.state(points).tolist()
    percent, log_odds = grid.cells[rows, columns], grid_map.log_odds(points)
    inner = (log_odds > log_odds.min()) & (log_odds < log_odds.max())
    assert np.abs(percent / 100 - grid_map.probability(points))[inner].max() < 0.0101  # rounding gives way
    surest = [grid_map.state(points[at : at + 1])[0] for at in (log_odds.argmin(), log_odds.argmax())]
    assert percent.min() == 0 or surest[0] != State.FREE
    assert percent.max() == 100 or surest[1] != State.OCCUPIED


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-3.2, 7.1, 0.6)])
def test_a_picture_can_be_gone_on_with(origin):
    cells = np.random.default_rng(1).integers(-1, 101, (130, 201)).astype(np.int8)
    cells[cells == 1], cells[cells > 98] = 0, 100
    cells[0, 0] = cells[-1, -1] = 50
    grid = OccupancyGrid(cells, 0.1, origin)
    grid_map = GridMap.from_occupancy(grid, load_config(**EVEN))
    again = grid_map.occupancy()
    np.testing.assert_array_equal(again.cells, cells)
    np.testing.assert_allclose(again.origin, origin)
    at = grid.centres(*np.argwhere(cells == 100)[:1].T)
    assert grid_map.state(at).tolist() == [State.OCCUPIED]
    assert grid_map.add(evidence_of({(-1, -1): 2000})) == 1
    grown = grid_map.occupancy()
    assert grown.cells.shape == (131, 202)
    np.testing.assert_array_equal(grown.cells[1:, 1:], cells)
    np.testing.assert_allclose(grown.centres([1], [1]), grid.centres([0], [0]))


def test_other_cells_cannot_be_gone_on_with():
    grid = OccupancyGrid(np.zeros((2, 2), np.int8), 0.05)
    with pytest.raises(ConfigError, match=r"cells of 0\.05 m, not 0\.1; set voxel_size to 0\.05"):
        GridMap.from_occupancy(grid, load_config(**EVEN))
    with pytest.raises(ConfigError, match="cannot continue"):
        GridMap(load_config(**EVEN)).storage.continue_with(load_config(**{**EVEN, "grid.prior": 0.2}))
    ros = OccupancyGrid(np.zeros((2, 2), np.int8), float(np.float32(0.1)))  # messages hold 32 bits
    assert GridMap.from_occupancy(ros, load_config(**EVEN)).counts()["free"] == 4


def test_an_empty_map_says_so():
    grid_map = GridMap(load_config(**EVEN))
    assert grid_map.bounds() is None
    assert grid_map.occupancy().cells.shape == (0, 0)
    assert grid_map.counts() == {"free": 0, "tentative": 0, "occupied": 0}
    assert grid_map.add(GridEvidence.nothing()) == 0
    assert grid_map.add(evidence_of({(3, 3): 0})) == 0
    assert grid_map.bounds() is None
    assert GridMap.from_occupancy(grid_map.occupancy(), load_config(**EVEN)).bounds() is None


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
def test_saved_and_loaded_it_is_the_same(tmp_path, cell):
    grid_map = GridMap(load_config(**{**EVEN, "map.cell": cell}), (1.0, 2.0, 3.0))
    grid_map.add(evidence_of({(i * 7, -i * 31): 10 * i + 100 for i in range(40)}))
    grid_map.frames, grid_map.recording = 5, "floor"
    grid_map.history.refused.update({"no_pose": 2})
    grid_map.save(tmp_path / "floor.npz")
    loaded = load_grid(tmp_path / "floor.npz")
    assert known(loaded) == known(grid_map)
    assert loaded.config == grid_map.config
    assert loaded.origin.tolist() == [1.0, 2.0, 3.0]
    assert (loaded.frames, loaded.frames_refused, loaded.recording) == (5, 2, "floor")
    assert [path.name for path in tmp_path.iterdir()] == ["floor.npz"]


def test_a_failed_save_leaves_the_older_file_whole(tmp_path, monkeypatch):
    path = tmp_path / "floor.npz"
    GridMap(load_config(**EVEN)).save(path)
    before = path.read_bytes()
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(MapFileError, match=r"floor\.npz: cannot be written \(No space left"):
        GridMap(load_config(**EVEN)).save(path)
    assert path.read_bytes() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["floor.npz"]
    with pytest.raises(MapFileError, match="cannot be written"):
        GridMap(load_config(**EVEN)).save(tmp_path / "no" / "floor.npz")


def test_damaged_files_end_in_one_line(tmp_path):
    grid_map = GridMap(load_config(**EVEN))
    grid_map.add(evidence_of({(i, i): 1000 for i in range(200)}))
    path = tmp_path / "floor.npz"
    grid_map.save(path)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    bad = [b"", b"PK", whole[: len(whole) // 2], b"\x93NUMPY" + whole]
    for _ in range(60):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 3):
            data[place] ^= 1 << rng.integers(8)
        bad.append(bytes(data))
    complaints = [complaint for data in bad if (complaint := complaint_about(path, data))]
    assert len(complaints) > 50
    assert all(line.startswith(f"{path}: ") and "\n" not in line for line in complaints)
    np.savez(path, about=np.zeros(3, np.uint8))
    with pytest.raises(MapFileError, match="holds no grid"):
        load_grid(path)
    with pytest.raises(MapFileError, match="No such file"):
        load_grid(tmp_path / "none.npz")


def test_a_map_too_large_for_a_picture_says_so():
    grid_map = GridMap(load_config(**EVEN))
    tile = np.full((1, CELLS), 500, np.int16)
    for x in (0, 40_000):
        grid_map.add(GridEvidence(np.array([[x, x, 0]], np.int32), tile))
    with pytest.raises(StereovoxError, match=r"256006 x 256006 m .* does the odometry jump"):
        grid_map.occupancy()
    assert grid_map.memory_bytes < 3e6


@pytest.mark.parametrize(
    "thresholds", [(0.3, 0.7), (1 / 18, 0.4 / 1.4), (9 / 26, 18 / 23), (0.004, 0.996), (0.5, 0.501)]
)
def test_messages_say_free_below_30_and_occupied_above_70_whatever_the_thresholds(thresholds):
    """So a navigation program with thresholds of its own takes each cell as the map does."""
    percent = np.arange(-1, 101, dtype=np.int8)
    grid = OccupancyGrid(percent.reshape(6, 17), 0.1, free_below=thresholds[0], occupied_above=thresholds[1])
    sent, states = grid.message_cells.ravel(), grid.states.ravel()
    assert sent.dtype == np.int8
    expected = np.select(
        [percent < 0, sent < 30, sent <= 70], [State.UNKNOWN, State.FREE, State.TENTATIVE], State.OCCUPIED
    )
    np.testing.assert_array_equal(states, expected)
    assert (np.diff(sent.astype(int)) >= 0).all()
    if thresholds == (0.3, 0.7):
        np.testing.assert_array_equal(sent, percent)
