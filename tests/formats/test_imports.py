# SPDX-License-Identifier: Apache-2.0
"""What `export` wrote, `import_map` reads back; files of other programs; damaged ones end in one line."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import stereovox as sv
from stereovox.config import load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.formats import export, import_map
from stereovox.formats.bags import read_bag_grid, write_grid_bag
from stereovox.maps import State, VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.projection import project
from stereovox.sources._lzf import unpack
from stereovox.sources.bags import open_bag
from stereovox.sources.bags.robot_messages import read_transforms
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.point_files import read_points

BAGS = (".bag", ".mcap", ".db3")


def random_map(**settings):
    dice = np.random.default_rng(4)
    indices = np.unique(dice.integers(-12, 12, (600, 3)), axis=0)
    config = load_config(voxel_size=0.05, **{"scan.heights": (0, 2), "scan.floor": -1.0, **settings})
    return VoxelMap.from_cells(config, indices, dice.uniform(-4, 3.5, len(indices)))


@pytest.fixture(scope="module")
def voxel_map():
    return random_map()


def in_state(voxel_map, state):
    indices, _ = voxel_map.cells()
    return set(map(tuple, indices[voxel_map.state(voxel_map.centers(indices)) == state].tolist()))


def same_cells(one, other, tolerance=0.0):
    (a, x), (b, y) = one.cells(), other.cells()
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(x, y, atol=tolerance)


@pytest.mark.parametrize("ending", [".bt", ".ot", *BAGS])
def test_every_occupied_and_free_cell_comes_back(tmp_path, voxel_map, ending):
    export(voxel_map, tmp_path / f"map{ending}")
    again = import_map(tmp_path / f"map{ending}")
    assert again.voxel_size == voxel_map.voxel_size
    for state in (State.FREE, State.OCCUPIED):
        assert len(in_state(voxel_map, state)) > 50
        assert in_state(voxel_map, state) <= in_state(again, state)
    if ending != ".bt":  # which has no word for tentative cells
        prior = np.log(0.1 / 0.9)  # OctoMap's is one half
        indices, log_odds = voxel_map.cells()
        np.testing.assert_array_equal(indices, again.cells()[0])
        np.testing.assert_allclose(log_odds - prior, again.cells()[1], atol=1e-3)


@pytest.mark.parametrize("cell", ["int16", "int8", "uint8"])
def test_npz_gives_the_same_map(tmp_path, cell):
    made = random_map(**{"map.cell": cell, "map.prior": 0.5, "up": "-y"})
    export(made, tmp_path / "map.npz")
    again = sv.import_map(tmp_path / "map.npz")
    assert again.config == made.config
    for ours, theirs in zip(made.storage.blocks(), again.storage.blocks(), strict=True):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("ending", [".ply", ".pcd"])
def test_our_points_become_the_same_occupied_cells(tmp_path, voxel_map, ending):
    export(voxel_map, tmp_path / f"map{ending}")
    again = import_map(tmp_path / f"map{ending}")
    assert in_state(again, State.OCCUPIED) == in_state(voxel_map, State.OCCUPIED)
    assert again.counts()["free"] == 0
    coarse = import_map(tmp_path / f"map{ending}", voxel_size=0.5)
    assert in_state(coarse, State.OCCUPIED) == {tuple(cell) for cell in np.floor(voxel_map.occupied() / 0.5)}


POINTS = np.array([[0.01, 0.02, 0.03], [-1.5, 2, 3], [7, 8, -9.25]])
ROWS = "\n".join(f"{x} {y} {z} 0.5" for x, y, z in POINTS)


def packed(form):
    return b"".join(struct.pack(form, *point, 1) for point in POINTS)


PLY = "ply\nformat {} 1.0\nelement vertex 3\n{}end_header\n"
XYZ = "property float x\nproperty float y\nproperty float z\nproperty double w\n"
PCD = "VERSION 0.7\nFIELDS x y z w\nSIZE 4 4 4 8\nTYPE F F F F\nCOUNT 1 1 1 1\nPOINTS 3\nDATA {}\n"


def lzf(data):
    """Pack as LZF does: runs of equal bytes as a piece of what was written before, all else as it is."""
    packed, k = bytearray(), 0
    while k < len(data):
        run = next((n for n in range(k, len(data)) if data[n] != data[k - 1]), len(data)) - k if k else 0
        if run >= 3:
            run = min(run, 200)
            packed += bytes([(run - 2) << 5, 0] if run < 9 else [7 << 5, run - 9, 0])
            k += run
        else:
            packed += bytes([0, data[k]])
            k += 1
    return bytes(packed)


def test_lzf_of_every_kind_of_piece():
    dice, packed, expected = np.random.default_rng(5), bytearray(), bytearray(b"x")
    packed += b"\0x"
    for _ in range(400):
        if dice.random() < 0.5:
            new = dice.bytes(dice.integers(1, 33))
            packed += bytes([len(new) - 1]) + new
            expected += new
        else:
            length, back = int(dice.integers(3, 265)), int(dice.integers(1, min(len(expected), 8192) + 1))
            high, low = divmod(back - 1, 256)
            packed += bytes([(length - 2) << 5 | high, low] if length < 9 else [7 << 5 | high, length - 9, low])
            for _ in range(length):
                expected.append(expected[-back])
    unpacked = np.zeros(len(expected), np.uint8)
    assert unpack(np.frombuffer(packed, np.uint8), unpacked) == len(expected) > 9000
    assert unpacked.tobytes() == expected
    assert unpack(np.frombuffer(packed, np.uint8), unpacked[:-1]) == -1
    for data in ([5, 1], [32, 0], [224], [0, 1, 32], [0, 1, 32, 1]):
        assert unpack(np.array(data, np.uint8), unpacked) == -1


def packed_columns():
    columns = b"".join(np.ascontiguousarray(POINTS[:, axis], "<f4").tobytes() for axis in range(3))
    columns += np.ones(3).tobytes()
    return struct.pack("<II", len(lzf(columns)), len(columns)) + lzf(columns)


SOUND = {
    "text.ply": PLY.format("ascii", XYZ).encode() + ROWS.encode(),
    "little.ply": PLY.format("binary_little_endian", XYZ).encode() + packed("<3fd"),
    "big.ply": PLY.format("binary_big_endian", XYZ).encode() + packed(">3fd"),
    "text.pcd": PCD.format("ascii").encode() + ROWS.encode(),
    "packed.pcd": PCD.format("binary_compressed").encode() + packed_columns(),
    "binary.pcd": PCD.format("binary").encode() + packed("<3fd"),
}


@pytest.mark.parametrize("name", SOUND)
def test_points_of_other_programs(tmp_path, name):
    (tmp_path / name).write_bytes(SOUND[name])
    np.testing.assert_allclose(read_points(tmp_path / name).xyz, POINTS, rtol=1e-6)
    with pytest.raises(MapFileError, match="type: stereovox import "):
        import_map(tmp_path / name)
    made = import_map(tmp_path / name, voxel_size=1.0)
    assert in_state(made, State.OCCUPIED) == {(0, 0, 0), (-2, 2, 3), (7, 8, -10)}
    for length in range(0, len(SOUND[name]) - 8, 7):
        (tmp_path / name).write_bytes(SOUND[name][:length])
        with pytest.raises(MapFileError) as error:
            read_points(tmp_path / name)
        assert str(error.value).startswith(str(tmp_path / name))


@pytest.mark.parametrize("piece", [1, 5, 33])
def test_text_in_pieces(tmp_path, monkeypatch, piece):
    monkeypatch.setattr("stereovox.sources.point_files.TEXT_PIECE", piece)
    (tmp_path / "a.ply").write_bytes(SOUND["text.ply"] + b"3 0 1 2\nnot read any more")
    np.testing.assert_allclose(read_points(tmp_path / "a.ply").xyz, POINTS, rtol=1e-6)


def test_points_that_are_none_count_for_nothing(tmp_path):
    (tmp_path / "a.pcd").write_bytes(SOUND["text.pcd"].replace(b"-9.25", b"nan"))
    assert import_map(tmp_path / "a.pcd", 1.0).counts()["occupied"] == 2
    (tmp_path / "a.pcd").write_bytes(SOUND["text.pcd"].replace(b"-9.25", b"1e30"))
    with pytest.raises(MapFileError, match="give --unit"):
        import_map(tmp_path / "a.pcd", 1.0)


@pytest.mark.parametrize(
    ("name", "old", "new", "what"),
    [
        ("text.ply", b"vertex 3", b"vertex 999999999", "need"),
        ("little.ply", b"vertex 3", b"vertex 99999999999", "are left"),
        ("text.ply", b"vertex 3", b"vertex x", "is not a number of points"),
        ("text.ply", b"float x", b"float u", "x, y and z"),
        ("text.ply", b"float z", b"list uchar int z", "x, y and z"),
        ("text.ply", b"ascii", b"binary_middle", "format"),
        ("text.ply", b"element vertex 3", b"element face 1\nelement vertex 3", "are left"),
        ("text.ply", b"7.0", b"wide", "wide"),
        ("text.pcd", b"TYPE F F F F", b"TYPE F F F", "numbers of fields"),
        ("text.pcd", b"SIZE 4", b"SIZE 3", "SIZE '3'"),
        ("text.pcd", b"COUNT 1 1 1 1", b"COUNT 1 1 1 -1", "not a number"),
        ("binary.pcd", b"DATA binary", b"DATA binary_zipped", "only ascii, binary, binary_compressed"),
        ("binary.pcd", b"DATA binary", b"DATA binary_compressed", "are impossible"),
        ("packed.pcd", b"POINTS 3", b"POINTS 9", "are impossible"),
        ("binary.pcd", b"POINTS 3", b"POINTS 4", "are left"),
    ],
)
def test_damaged_points(tmp_path, name, old, new, what):
    assert old in SOUND[name]
    (tmp_path / name).write_bytes(SOUND[name].replace(old, new, 1))
    with pytest.raises(MapFileError, match=what):
        read_points(tmp_path / name)


def test_damaged_npz(tmp_path, voxel_map):
    path = tmp_path / "map.npz"
    export(voxel_map, path)
    with np.load(path) as file:
        whole = dict(file)
    for name, value in (
        ("indices", whole["indices"].astype(float)),
        ("log_odds", whole["log_odds"][1:]),
        ("log_odds", np.full_like(whole["log_odds"], np.nan)),
        ("settings", np.frombuffer(b'{"voxel": 1}', np.uint8)),
        ("more", whole["indices"]),
    ):
        np.savez(path, **(whole | {name: value}))
        with pytest.raises(MapFileError) as error:
            import_map(path)
        assert str(error.value).startswith(str(path))


@pytest.mark.parametrize("ending", [".npz", ".ply", ".pcd"])
def test_cells_in_too_many_blocks_are_refused(tmp_path, voxel_map, ending, monkeypatch):
    export(voxel_map, tmp_path / f"map{ending}")
    monkeypatch.setattr("stereovox.formats.points.MAX_BLOCKS", 1)
    with pytest.raises(MapFileError, match=r"blocks, more than 1;"):
        import_map(tmp_path / f"map{ending}")


@pytest.mark.parametrize("ending", BAGS)
def test_an_occupancy_grid_through_a_bag(tmp_path, ending):
    cells = np.random.default_rng(2).integers(-1, 101, (7, 11)).astype(np.int8)
    grid = OccupancyGrid(cells, 0.05, (-1.5, 2.25, 0.5))
    write_grid_bag(grid, tmp_path / f"floor{ending}")
    again = read_bag_grid(tmp_path / f"floor{ending}")
    np.testing.assert_array_equal(again.cells, cells)
    assert again.resolution == 0.05
    np.testing.assert_allclose(again.origin, grid.origin, atol=1e-12)


def test_a_map_in_a_bag_is_seen_from_above_as_well(tmp_path):
    made = random_map(up="-y")
    export(made, tmp_path / "map.mcap", (0.1, 0.6), floor=-0.3)
    grid, expected = read_bag_grid(tmp_path / "map.mcap"), project(made, (0.1, 0.6), -0.3)
    np.testing.assert_array_equal(grid.cells, expected.message_cells)
    np.testing.assert_array_equal(grid.states, expected.states)
    cloud = import_map(tmp_path / "map.mcap", voxel_size=0.05, topic="/occupied_cells")
    assert in_state(cloud, State.OCCUPIED) == in_state(made, State.OCCUPIED)


def test_the_cells_stand_in_the_bag_s_map_frame_as_its_grid_does(tmp_path):
    """RViz draws both in `map`: a cell turned there by /tf_static lies in the grid's cell that it marked."""
    made = VoxelMap.from_cells(load_config(voxel_size=0.1, up="-y"), [[3, -8, 5]], [3.0])
    export(made, tmp_path / "map.mcap", floor=0.0)
    bag = open_bag(tmp_path / "map.mcap")
    [told] = read_transforms(bag.read("/tf_static", 0))
    place = Rotation.from_quat(told.numbers[3:]).apply(made.occupied()[0])
    grid = read_bag_grid(tmp_path / "map.mcap")
    [[row, column]] = grid.indices(place[None, :2])
    assert (told.parent, told.child, place[2]) == ("map", "map_cells", pytest.approx(0.75))
    assert grid.cells[row, column] > 90


def test_the_last_map_of_a_topic_counts_and_no_per_cent_is_unknown(tmp_path):
    with BagWriter(tmp_path / "two.mcap") as bag:
        for n, cells in enumerate(([[1, 2]], [[101, -2]], [[100, 127]])):
            bag.occupancy(n, OccupancyGrid(np.array(cells, np.int8), 0.1))
    assert read_bag_grid(tmp_path / "two.mcap").cells.tolist() == [[100, -1]]


def test_bags_without_such_a_map(tmp_path, voxel_map):
    write_grid_bag(OccupancyGrid(np.zeros((2, 2), np.int8), 0.1), tmp_path / "floor.bag")
    with pytest.raises(MapFileError, match=r"has no octomap_msgs/Octomap; name a topic .* /map_mapping "):
        import_map(tmp_path / "floor.bag")
    with pytest.raises(MapFileError, match="holds no octomap_msgs/Octomap or sensor_msgs/PointCloud2"):
        import_map(tmp_path / "floor.bag", topic="/map_mapping")
    with BagWriter(tmp_path / "two.mcap") as bag:
        for topic in ("/a", "/b"):
            bag.octomap(0, b"\0", 0.1, topic)
    with pytest.raises(MapFileError, match=r"2 topics .*/a .*, /b "):
        import_map(tmp_path / "two.mcap")
    with pytest.raises(MapFileError, match="node"):
        import_map(tmp_path / "two.mcap", topic="/a")


def test_options_and_endings_that_say_nothing(tmp_path):
    for path, more, what in (
        ("a.bt", {"voxel_size": 0.1}, "--voxel-size does not apply"),
        ("a.ply", {"topic": "/a"}, "--topic does not apply"),
        ("a.xzy", {}, r"did you mean '\.xyz'"),
        ("none.ply", {"voxel_size": 0.0}, "cannot be read"),
        ("none.npz", {}, "cannot be read"),
        ("none.mcap", {}, "none.mcap"),
    ):
        with pytest.raises(StereovoxError, match=what):
            import_map(tmp_path / path, **more)


def test_other_packages_read_their_own(tmp_path, voxel_map, monkeypatch):
    class Entry:
        name = ".cells"

        @staticmethod
        def load():
            return lambda path: voxel_map

    monkeypatch.setattr("stereovox.registry.entry_points", lambda group: [Entry] if group == "stereovox.import" else [])
    assert import_map(tmp_path / "map.cells") is voxel_map
