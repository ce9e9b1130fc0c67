# SPDX-License-Identifier: Apache-2.0
"""OctoMap files: what we write is what OctoMap and we ourselves read; damaged files end with one line."""

import re
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from stereovox.config import load_config
from stereovox.errors import MapFileError
from stereovox.formats import export, read_octomap
from stereovox.maps import VoxelMap

VOXEL_SIZE = 0.1
CONFIG = load_config(voxel_size=VOXEL_SIZE, **{"map.prior": 0.5})
REAL_FILE = Path(__file__).resolve().parents[2] / "../shared/data/octomap/geb079.bt"
FREE, TENTATIVE_LOW, TENTATIVE_HIGH, OCCUPIED = -1.5, -0.4, 0.4, 2.5
FULL_CUBE = np.argwhere(np.ones((4, 4, 4)))

index = st.integers(-32768, 32767)
near = st.integers(-3, 3)
cell_sets = st.dictionaries(
    st.one_of(st.tuples(near, near, near), st.tuples(index, index, index)),
    st.sampled_from([FREE, TENTATIVE_LOW, TENTATIVE_HIGH, OCCUPIED, -2.0, 0.123]),
    max_size=60,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("octomap")


def map_of(cells):
    return VoxelMap.from_cells(CONFIG, np.array(list(cells), int).reshape(-1, 3), list(cells.values()))


def cells_of(voxel_map):
    indices, log_odds = voxel_map.cells()
    return dict(zip(map(tuple, indices.tolist()), np.round(log_odds.astype(float), 3).tolist(), strict=True))


def as_dict(indices, log_odds):
    values = np.broadcast_to(log_odds, len(indices))
    return dict(zip(map(tuple, np.asarray(indices).tolist()), values.tolist(), strict=True))


def room(seed=0):
    """Walls, free blocks of many sizes and odd cells around the origin."""
    rng = np.random.default_rng(seed)
    shape = (48, 40, 24)
    values = np.full(shape, FREE)
    values[0] = values[:, 0] = values[:, :, :2] = OCCUPIED
    values[30:40, 10:20, 5:15] = 0
    odd = rng.random(shape) < 0.02
    values[odd] = rng.uniform(-2, 3.5, odd.sum()).round(2)
    known = np.argwhere(values != 0)
    return VoxelMap.from_cells(CONFIG, known - [21, 17, 9], values[values != 0])


def size_in(path):
    return int(re.search(rb"^size (\d+)$", path.read_bytes(), re.MULTILINE)[1])


@given(cell_sets)
@settings(deadline=None, max_examples=60)
def test_ot_keeps_every_cell(folder, cells):
    assume(cells)
    export(map_of(cells), folder / "some.ot")
    assert cells_of(read_octomap(folder / "some.ot")) == cells


@given(cell_sets)
@settings(deadline=None, max_examples=60)
def test_bt_keeps_free_and_what_is_likely_occupied(folder, cells):
    """Of the tentative cells the likely ones become occupied, the others unknown."""
    expected = {cell: 3.5 if value > 0 else -2.0 for cell, value in cells.items() if value != TENTATIVE_LOW}
    assume(expected)
    export(map_of(cells), folder / "some.bt")
    assert cells_of(read_octomap(folder / "some.bt")) == expected


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_an_empty_map_is_neither_written_nor_read(tmp_path, ending):
    """A file that loads as empty says that nothing is known, which nobody notices."""
    path = tmp_path / f"empty{ending}"
    with pytest.raises(MapFileError, match="holds no cell that this format can store, there is nothing to write"):
        export(VoxelMap(CONFIG), path)
    assert not path.exists()
    export(map_of({(0, 0, 0): OCCUPIED}), path)
    head, _, _ = path.read_bytes().partition(b"data\n")
    path.write_bytes(head.replace(b"size 17", b"size 0") + b"data\n")
    with pytest.raises(MapFileError, match=r"empty\..*it holds no cell: the map was empty when it was saved"):
        read_octomap(path)


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_equal_cubes_become_one_node(tmp_path, ending):
    path = tmp_path / f"cube{ending}"
    export(map_of(as_dict(FULL_CUBE - 4, OCCUPIED)), path)
    assert size_in(path) == 15  # one chain of nodes, from the root to a cube of 4 cells a side
    export(map_of(as_dict(FULL_CUBE - 4, OCCUPIED) | {(-1, -1, -1): FREE}), path)
    assert size_in(path) == 15 + 8 + 8
    assert cells_of(read_octomap(path))[-1, -1, -1] < 0


def test_pruning_takes_equal_classes_in_bt_and_equal_values_in_ot(tmp_path):
    shades = map_of(as_dict(FULL_CUBE, np.linspace(2, 3, 64)))
    export(shades, tmp_path / "shades.bt")
    export(shades, tmp_path / "shades.ot")
    assert size_in(tmp_path / "shades.bt") == 15
    assert size_in(tmp_path / "shades.ot") == 15 + 8 + 64


def test_states_keep_their_class_under_unusual_thresholds(tmp_path):
    config = load_config(CONFIG, **{"map.free_below": 0.2, "map.occupied_above": 0.35})
    export(VoxelMap.from_cells(config, [[0, 0, 0], [0, 0, 1]], [-0.5, -1.9]), tmp_path / "low.bt")
    assert read_octomap(tmp_path / "low.bt").counts() == {"free": 1, "tentative": 0, "occupied": 1}


def test_programs_that_take_all_above_one_half_as_occupied_meet_every_occupied_cell(tmp_path):
    """By default a cell is occupied from p = 0.286 on; OctoMap's own threshold is a log-odds of 0."""
    config = load_config(voxel_size=0.1)
    occupied = VoxelMap.from_cells(config, [[0, 0, 0]], [-0.9])
    assert occupied.counts()["occupied"] == 1
    for ending in (".bt", ".ot"):
        export(occupied, tmp_path / f"one{ending}")
        again = read_octomap(tmp_path / f"one{ending}")
        assert cells_of(again)[0, 0, 0] > 0
        assert again.counts()["occupied"] == 1


@pytest.mark.parametrize("cell", [(32768, 0, 0), (0, -32769, 0)])
def test_cells_beyond_octomaps_reach(tmp_path, cell):
    (tmp_path / "far.bt").write_text("old")
    with pytest.raises(MapFileError, match=r"cell \(.*327.*use larger cells"):
        export(map_of({cell: OCCUPIED}), tmp_path / "far.bt")
    assert (tmp_path / "far.bt").read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


# --- OctoMap itself


def opened(octomap, path):
    """Open a file as OctoMap's users do. For .ot the tree must come from `read`, which returns a new one."""
    if path.suffix == ".ot":
        return octomap.OcTree.read(str(path).encode())
    tree = octomap.OcTree(VOXEL_SIZE)
    assert tree.readBinary(str(path).encode())
    return tree


def unfolded(tree):
    """Return {cell index: probability} of all leaves, large ones cut into cells."""
    cells = {}
    for leaf in tree.begin_leafs():
        side = 1 << (16 - leaf.getDepth())
        corner = np.array([leaf.getIndexKey()[axis] for axis in range(3)]) - 32768
        for low in (np.argwhere(np.ones((side,) * 3)) + corner).tolist():
            cells[tuple(low)] = leaf.getOccupancy()
    return cells


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_octomap_reads_the_same_cells(tmp_path, ending):
    octomap = pytest.importorskip("octomap")
    voxel_map, path = room(), tmp_path / f"room{ending}"
    export(voxel_map, path)
    tree, again = opened(octomap, path), read_octomap(path)
    assert tree.getResolution() == VOXEL_SIZE
    assert tree.size() == size_in(path)
    theirs = unfolded(tree)
    indices, _ = again.cells()
    assert theirs.keys() == set(map(tuple, indices.tolist()))
    ours = again.probability(again.centers(indices))
    tolerance = 1e-6 if ending == ".ot" else 4e-4  # OctoMap's clamping limits are 0.1192 and 0.971
    np.testing.assert_allclose([theirs[tuple(cell)] for cell in indices.tolist()], ours, atol=tolerance)


def test_octomap_counts_and_classifies_as_the_map_does(tmp_path):
    octomap = pytest.importorskip("octomap")
    voxel_map = room()
    export(voxel_map, tmp_path / "room.bt")
    tree = opened(octomap, tmp_path / "room.bt")
    _, log_odds = voxel_map.cells()
    occupied = [p >= 0.5 for p in unfolded(tree).values()]
    assert sum(occupied) == np.count_nonzero(log_odds >= 0)
    assert len(occupied) - sum(occupied) == voxel_map.counts()["free"]
    points = np.random.default_rng(1).uniform(-3, 3, (2000, 3))
    states = voxel_map.state(points)
    theirs = tree.getLabels(points)
    expected = np.where(states == 1, 0, np.where((states > 1) & (voxel_map.log_odds(points) > 0), 1, -1))
    np.testing.assert_array_equal(theirs, expected)
    assert set(expected) == {-1, 0, 1}


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_we_read_what_octomap_wrote(tmp_path, ending):
    octomap = pytest.importorskip("octomap")
    tree = octomap.OcTree(0.25)
    rng = np.random.default_rng(2)
    tree.insertPointCloud(rng.uniform(-4, 4, (500, 3)), np.zeros(3))
    path = tmp_path / f"theirs{ending}"
    assert tree.writeBinary(str(path).encode()) if ending == ".bt" else tree.write(str(path).encode())
    theirs, ours = unfolded(opened(octomap, path)), read_octomap(path)
    indices, _ = ours.cells()
    assert ours.voxel_size == 0.25
    assert theirs.keys() == set(map(tuple, indices.tolist()))
    expected = [theirs[tuple(cell)] for cell in indices.tolist()]
    np.testing.assert_allclose(ours.probability(ours.centers(indices)), expected, atol=4e-4)


def test_a_real_building_comes_back_byte_for_byte(tmp_path):
    if not REAL_FILE.is_file():
        pytest.skip("shared/data/octomap/geb079.bt is not here")
    voxel_map = read_octomap(REAL_FILE)
    assert voxel_map.counts() == {"free": 950759, "tentative": 0, "occupied": 185673}
    export(voxel_map, tmp_path / "again.bt")
    assert (tmp_path / "again.bt").read_bytes() == REAL_FILE.read_bytes()


# --- damaged files


def one_line(path, content, what=""):
    path.write_bytes(content)
    with pytest.raises(MapFileError) as error:
        read_octomap(path)
    message = str(error.value)
    assert message.startswith(str(path)), message
    assert what in message, message
    assert "\n" not in message


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_a_file_cut_anywhere(tmp_path, ending):
    path = tmp_path / f"cut{ending}"
    export(room(), path)
    whole = path.read_bytes()
    start = whole.index(b"data\n") + 5
    for length in [*range(start + 40), *np.linspace(start, len(whole) - 1, 60).astype(int)]:
        one_line(path, whole[:length])
    one_line(path, whole + b"\0", "node")
    one_line(path, whole + b"\0" * 10, "node")


@pytest.mark.parametrize("ending", [".bt", ".ot"])
@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        (b"id OcTree", b"id CountingOcTree", "CountingOcTree"),
        (b"id OcTree\n", b"", "tree type"),
        (b"res 0.1", b"res 0", "voxel_size"),
        (b"res 0.1", b"res nan", "voxel_size"),
        (b"res 0.1", b"res -1", "voxel_size"),
        (b"res 0.1", b"res wide", "wide"),
        (b"res 0.1\n", b"", "res"),
        (b"size ", b"size 1", "nodes"),
        (b"size ", b"size 999999999999", "size"),
        (b"size ", b"size -", "size"),
        (b"size ", b"size x", "size"),
        (b"# Octomap", b"# Rectomap", "first line"),
        (b"\ndata\n", b"\ndada\n", "data"),
    ],
)
def test_a_wrong_header(tmp_path, ending, old, new, what):
    path = tmp_path / f"wrong{ending}"
    export(room(), path)
    whole = path.read_bytes()
    assert old in whole
    one_line(path, whole.replace(old, new, 1), what)


@pytest.mark.parametrize("ending", [".bt", ".ot"])
def test_turned_bits_never_crash(tmp_path, ending):
    path = tmp_path / f"bits{ending}"
    export(map_of(as_dict(FULL_CUBE, OCCUPIED) | {(9, 9, 9): FREE, (-70, 3, 2): OCCUPIED}), path)
    whole = path.read_bytes()
    start = whole.index(b"data\n") + 5
    for place in range(start, len(whole)):
        for bit in range(8):
            content = bytearray(whole)
            content[place] ^= 1 << bit
            path.write_bytes(content)
            with suppress(MapFileError):  # or the bit gives another whole tree
                read_octomap(path)


def header(title, size):
    return f"# Octomap OcTree {title}\nid OcTree\nsize {size}\nres 0.1\ndata\n".encode()


def test_trees_that_cannot_be(tmp_path):
    path, binary, full = tmp_path / "odd", "binary file", "file"
    branch, leaf = np.array([3], "<u2").tobytes(), np.array([2], "<u2").tobytes()
    one_line(path, header(binary, 17 + 1) + branch * 16 + leaf, "16 levels")
    one_line(path, header(binary, 1) + b"\0\0", "without children")
    one_line(path, header(binary, 2) + branch, "too early")
    one_line(path, header(binary, 3) + leaf * 2, "after the last node")
    one_line(path, header(binary, 2) + leaf, "expand to")  # one node that claims an eighth of all there is
    value = np.array([1], "<f4").tobytes()
    one_line(path, header(full, 18) + (value + b"\1") * 17 + value + b"\0", "16 levels")
    one_line(path, header(full, 1) + value + b"\0", "expand to")
    one_line(path, header(full, 2) + (value + b"\3") * 2, "too early")
    one_line(path, header(full, 2) + (value + b"\0") * 2, "after the last node")
    nan = np.array([np.nan], "<f4").tobytes()
    one_line(path, header(full, 17) + (value + b"\1") * 16 + nan + b"\0", "not a number")
    path.write_bytes(header(full, 17) + (value + b"\1") * 16 + np.array([99], "<f4").tobytes() + b"\0")
    assert cells_of(read_octomap(path)) == {(-32768, -32768, -32768): 30.0}


def test_files_that_are_not_there(tmp_path):
    for path in (tmp_path, tmp_path / "none.bt"):
        with pytest.raises(MapFileError, match="cannot be read") as error:
            read_octomap(path)
        assert "\n" not in str(error.value)
    one_line(tmp_path / "noise.bt", np.random.default_rng(0).bytes(5000), "first line")
    one_line(tmp_path / "nothing.bt", b"", "first line")


def test_the_cells_of_a_tree_with_colours(tmp_path):
    """As ColorOcTreeNode.writeData has it: the value, three bytes of colour, then the byte of the children."""
    export(room(), tmp_path / "a.ot")
    head, _, body = (tmp_path / "a.ot").read_bytes().partition(b"data\n")
    nodes = [body[k : k + 4] + b"\x10\x80\xff" + body[k + 4 : k + 5] for k in range(0, len(body), 5)]
    coloured = head.replace(b"id OcTree", b"id ColorOcTree") + b"data\n" + b"".join(nodes)
    (tmp_path / "b.ot").write_bytes(coloured)
    for one, other in zip(
        read_octomap(tmp_path / "a.ot").cells(), read_octomap(tmp_path / "b.ot").cells(), strict=True
    ):
        np.testing.assert_array_equal(one, other)
    (tmp_path / "b.ot").write_bytes(coloured[:-3])
    with pytest.raises(MapFileError, match="ends inside a node"):
        read_octomap(tmp_path / "b.ot")
