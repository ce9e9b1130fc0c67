# SPDX-License-Identifier: Apache-2.0
"""Maps in boxes answer as maps in memory do, whatever the cache holds, from folders and from object stores."""

from concurrent.futures import ThreadPoolExecutor
from functools import cache
from uuid import uuid4

import numpy as np
import pytest
from made_manifest import manifest_in, put_manifest

import stereovox as sv
from stereovox.errors import MapFileError, StereovoxError
from stereovox.files.places import Place, is_url
from stereovox.maps import boxed_map
from stereovox.maps.boxed_map import BoxedMap
from stereovox.maps.cells.cell_format import State
from stereovox.maps.files import boxed_manifest
from stereovox.maps.files.boxed_manifest import only_writer_at, read_boxed_manifest
from stereovox.maps.storage.boxes import read_box
from stereovox.products.edit import coarsen

BOX_M = 1.6
STOPS = [(State.OCCUPIED,), (State.OCCUPIED, State.TENTATIVE), (State.UNKNOWN, State.OCCUPIED), (State.UNKNOWN,)]


@cache
def flight(**settings):
    """Return a map in memory; it must not be changed."""
    mapper = sv.Mapper(**{"voxel_size": 0.1, **settings})
    for frame in sv.open_source("sim:apartment?image_width=80", frames="::36"):
        mapper.add(frame)
    return mapper.map


@cache
def part():
    """Return a corner of that map, for tests in which all of it would only take longer."""
    return sv.crop(flight(), [0, 0, 0], [4, 4, 2])


def put_at(where, box_m=2 * BOX_M, **settings):
    """Save the map in boxes."""
    sv.save_boxed(flight(**settings), where, box_m)


def few_boxes(where):
    """Return the map there, opened with a cache of a few boxes."""
    return sv.load_map(where, cache_bytes=60 * 20**3)


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Return the folder of the map in boxes; it must not be changed."""
    folder = tmp_path_factory.mktemp("boxed") / "m.svox"
    put_at(folder, BOX_M)
    return folder


@pytest.fixture(scope="module", params=["folder", "s3"])
def kept(request, saved):
    """Return where the map is in boxes, in a folder and in a bucket; it must not be changed."""
    if request.param == "folder":
        return str(saved)
    url = f"{request.getfixturevalue('s3')}/{uuid4().hex}/city.svox"
    put_at(url)
    return url


def somewhere(n, seed=0):
    """Return points in and around the map, every third on a face between boxes or cells."""
    random, (low, high) = np.random.default_rng(seed), flight().bounds()
    points = random.uniform(low - 2, high + 2, (n, 3))
    points[::3] = np.round(points[::3] / 0.1) * 0.1
    points[::9] = np.round(points[::9] / BOX_M) * BOX_M
    return points


def assert_same(ours, theirs):
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(a, b)


def test_all_questions_are_answered_as_in_memory(kept):
    whole, big = flight(), few_boxes(kept)
    assert isinstance(big, BoxedMap)
    assert len(big.manifest.boxes) > (8 if is_url(kept) else 20)
    points = somewhere(3000)
    assert_same([big.state(points), big.probability(points), big.log_odds(points)],
                [whole.state(points), whole.probability(points), whole.log_odds(points)])  # fmt: skip
    few = points[:300]
    highs = few + np.random.default_rng(1).uniform(0, 0.8, few.shape)
    assert_same([big.check_boxes(few, highs)], [whole.check_boxes(few, highs)])
    assert_same([big.check_capsules(few, highs, 0.3)], [whole.check_capsules(few, highs, 0.3)])
    assert big.counts() == whole.counts()
    np.testing.assert_allclose(big.bounds(), whole.bounds())
    assert big.frames == whole.frames
    assert_same(big.storage.blocks(), whole.storage.blocks())
    assert big.storage._used <= big.storage.cache_bytes


@pytest.mark.parametrize("stop_at", STOPS, ids=str)
def test_rays_stop_as_in_memory(saved, stop_at):
    whole, big = flight(), few_boxes(saved)
    ways = np.random.default_rng(2).normal(size=(400, 3))
    ways[:6] = [*np.eye(3), *-np.eye(3)]
    for origins, longest in ((somewhere(400), 30.0), (somewhere(400, 3), 2.5), ([2.0, 2.0, 1.0], np.inf)):
        assert_same(big.cast_rays(origins, ways, longest, stop_at), whole.cast_rays(origins, ways, longest, stop_at))


@pytest.mark.parametrize("obstacles", STOPS, ids=str)
def test_the_nearest_obstacle_is_that_in_memory(saved, obstacles):
    whole, big = flight(), sv.load_map(saved, cache_bytes=5_000_000)
    for longest in (1.0, np.inf):
        assert_same(big.nearest_obstacle(somewhere(300), longest, obstacles),
                    whole.nearest_obstacle(somewhere(300), longest, obstacles))  # fmt: skip


def test_parts_differences_distances_and_clouds_are_those_in_memory(saved, tmp_path):
    whole, big = flight(), sv.load_map(saved, cache_bytes=3_000_000)
    box = [0.05, 0.2, 0.1], [3.4, 2.9, 2.0]
    assert_same(sv.crop(big, *box).storage.blocks(), sv.crop(whole, *box).storage.blocks())
    differences = sv.difference(whole, big).counts
    assert differences.sum() == np.trace(differences) == sum(whole.counts().values())
    fields = [sv.DistanceField(one, *box) for one in (big, whole)]
    assert_same([fields[0].metres], [fields[1].metres])
    assert_same([coarsen(big, 2).storage.blocks()[1]], [coarsen(whole, 2).storage.blocks()[1]])
    for one, name in ((big, "a.ply"), (whole, "b.ply")):
        sv.export(one, tmp_path / name)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


def test_only_what_is_asked_for_is_read(saved, monkeypatch):
    big, read = sv.load_map(saved), []
    monkeypatch.setattr(
        "stereovox.maps.storage.boxed_storage.read_box", lambda *given: read.append(given[-1].box) or read_box(*given)
    )
    assert big.counts() == flight().counts()
    assert not read
    big.state([[0.5, 0.5, 0.5], [0.6, 0.5, 0.7]])
    assert read == [(0, 0, 0)]
    big.state([[0.9, 0.5, 0.5]])
    assert read == [(0, 0, 0)]


def test_what_needs_more_than_the_cache_is_refused_with_the_cure(saved):
    big = sv.load_map(saved, cache_bytes=2 * 16**3)
    with pytest.raises(StereovoxError, match="cache_bytes="):
        big.check_boxes([[-50, -50, -50]], [[50, 50, 50]])


@pytest.mark.parametrize("settings", [{"map.keep_times": True}, {"map.cell": "int8"}], ids=str)
def test_times_and_other_cells(tmp_path, settings):
    put_at(tmp_path / "m.svox", **settings)
    whole, big = flight(**settings), few_boxes(tmp_path / "m.svox")
    assert_same(big.storage.blocks(), whole.storage.blocks())
    if whole.config.map.keep_times:
        coords = whole.storage.blocks()[0]
        known = whole.storage.blocks()[1] != whole.storage.cell_format.unknown
        assert_same([big.storage.times_of(coords)[known]], [whole.storage.times_of(coords)[known]])


def test_levels_are_the_map_in_larger_cells(kept):
    big = few_boxes(kept)
    once = VoxelCells(coarsen(flight(), 2))
    layout = big.manifest.layout_of(1)
    found = [read_box(Place.of(kept), layout, entry) for entry in big.manifest.levels[0]]
    assert sum(map(len, (one.coords for one in found))) == len(once.blocks)
    for one in found:
        for coords, cells in zip(one.coords.tolist(), one.cells, strict=True):
            np.testing.assert_array_equal(layout.rules.states(cells), once.states(tuple(coords)))
    assert len(big.manifest.levels[-1]) == 1 or big.overview().counts()
    small = big.overview(most=1000)
    assert small.config.cell[0] > big.config.cell[0]


def test_boxes_of_an_odd_number_of_blocks_have_levels_as_well(tmp_path, monkeypatch):
    """A block of the next level then lies in two boxes."""
    monkeypatch.setattr("stereovox.maps.cells.pyramid.SMALL", 100)
    sv.save_boxed(flight(), tmp_path / "m.svox", 2.4)
    big, coarse = sv.load_map(tmp_path / "m.svox"), flight()
    assert big.manifest.layout.side == 24
    assert len(big.manifest.levels) > 2
    for level, entries in enumerate(big.manifest.levels, 1):
        coarse = coarsen(coarse, 2)
        expected, layout = VoxelCells(coarse), big.manifest.layout_of(level)
        found = [read_box(Place.of(tmp_path / "m.svox"), layout, entry) for entry in entries]
        assert sum(len(one.coords) for one in found) == len(expected.blocks)
        for one in found:
            for coords, cells in zip(one.coords.tolist(), one.cells, strict=True):
                np.testing.assert_array_equal(layout.rules.states(cells), expected.states(tuple(coords)))


class VoxelCells:
    def __init__(self, voxel_map):
        self._rules = voxel_map.storage.rules
        coords, cells = voxel_map.storage.blocks()
        self.blocks = dict(zip(map(tuple, coords.tolist()), cells, strict=True))

    def states(self, coords):
        return self._rules.states(self.blocks[coords])


def test_a_new_map_replaces_the_old_one_whole_or_not_at_all(where, monkeypatch):
    sv.save_boxed(part(), where, 2 * BOX_M)
    before = sv.load_map(where).storage.blocks()

    def stop(*_):
        raise KeyboardInterrupt

    other = sv.crop(flight(), [0, 0, 0], [2, 2, 2])
    with monkeypatch.context() as patch:
        patch.setattr(boxed_map, "write_boxed_manifest", stop)
        with pytest.raises(KeyboardInterrupt):
            sv.save_boxed(other, where, BOX_M)
    assert_same(sv.load_map(where).storage.blocks(), before)
    sv.save_boxed(other, where, BOX_M)
    assert_same(sv.load_map(where).storage.blocks(), other.storage.blocks())
    names = {"/".join(name.split("/")[:3]) for name in Place.of(where).names("boxes/")}
    assert names == read_boxed_manifest(Place.of(where)).names


def test_a_manifest_that_could_not_be_read_is_not_written(tmp_path, monkeypatch):
    sv.save_boxed(part(), tmp_path / "m.svox", 2 * BOX_M)
    before = sv.load_map(tmp_path / "m.svox").storage.blocks()
    monkeypatch.setattr(boxed_manifest, "MAX_MANIFEST", len((tmp_path / "m.svox/manifest.json").read_bytes()))
    with pytest.raises(MapFileError, match="choose larger boxes"):
        sv.save_boxed(sv.load_map(tmp_path / "m.svox"), tmp_path / "n.svox", BOX_M / 2)
    assert_same(sv.load_map(tmp_path / "m.svox").storage.blocks(), before)


def test_there_is_one_writer(where):
    place = Place.of(where)
    with only_writer_at(place), ThreadPoolExecutor(1) as other, pytest.raises(MapFileError, match="another"):
        other.submit(sv.save_boxed, part(), where).result()
    sv.save_boxed(part(), where)


def test_damage_is_told_by_the_box(where):
    sv.save_boxed(part(), where, BOX_M)
    place = Place.of(where)
    entry = read_boxed_manifest(place).boxes[5]
    name = f"{entry.name}/cells/c/0/0"
    data = bytearray(place.read(name))
    data[len(data) // 2] ^= 1
    place.write(name, bytes(data))
    with pytest.raises(MapFileError, match=f"{entry.name}: damaged box .*; remove it and make .* --resume") as error:
        sv.load_map(where).storage.blocks()
    assert "\n" not in str(error.value)
    place.remove([name])
    with pytest.raises(MapFileError, match=f"{entry.name}: is missing; .* load it again"):
        sv.load_map(where).storage.blocks()


@pytest.mark.parametrize(
    "change",
    [
        {"box_side": 7}, {"box_side": 1 << 20}, {"boxes": 3}, {"boxes": [{}]}, {"levels": "a"}, {"extra": []},
        {"config": {"voxel_size": -1}}, {"version": 99}, {"format": "other"},
    ],
    ids=str,
)  # fmt: skip
def test_a_damaged_manifest_is_one_line(saved, tmp_path, change):
    (tmp_path / "m.svox").mkdir()
    put_manifest(tmp_path / "m.svox/manifest.json", {**manifest_in(saved / "manifest.json"), **change})
    with pytest.raises(MapFileError) as error:
        sv.load_map(tmp_path / "m.svox")
    assert "\n" not in str(error.value)


def test_nothing_is_added_and_the_cure_is_told(saved):
    big = sv.load_map(saved)
    with pytest.raises(StereovoxError, match="stereovox crop"):
        sv.Mapper(big.config, resume=big)
    with pytest.raises(StereovoxError, match="stereovox crop"):
        big.storage.insert(*flight().storage.blocks())
    with pytest.raises(MapFileError, match="is a map in boxes"):
        flight().save(saved)


def test_other_things_are_not_replaced(tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes/a.txt").write_text("mine")
    with pytest.raises(MapFileError, match=r"holds a\.txt"):
        sv.save_boxed(flight(), tmp_path / "notes")
    assert (tmp_path / "notes/a.txt").read_text() == "mine"
    with pytest.raises(StereovoxError, match="boxes of 100 m"):
        sv.save_boxed(flight(), tmp_path / "new", 100)


def test_a_map_in_one_piece_is_not_saved_below_a_folder_that_is_called_as_a_store(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(MapFileError, match=r"s3://bucket/m\.svox: only a map in boxes can lie in an object store"):
        flight().save("s3://bucket/m.svox")
    assert not list(tmp_path.iterdir())
