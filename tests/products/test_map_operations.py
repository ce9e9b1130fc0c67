# SPDX-License-Identifier: Apache-2.0
"""Crop, merge, difference and larger cells, against plain loops over tables of cells."""

import itertools
import math

import made_flights as made
import numpy as np
import pytest
from made_maps import KINDS, random_map, states, table

import stereovox as sv
from stereovox import Mapper, State, StereovoxError, VoxelMap, load_config
from stereovox.geometry import from_quaternion, inverse, rotation_matrix, transform_points
from stereovox.maps.rolling import RollingMap
from stereovox.products.moved import moved

BOX = np.array([-0.63, -1.0, -0.31]), np.array([0.72, 0.4, 1.0])
WORST = (State.OCCUPIED, State.TENTATIVE, State.UNKNOWN, State.FREE)


def motion(turn, shift):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn), shift
    return T


def on_disk(voxel_map):
    """The same map with all cells but those of a small window in tiles on disk."""
    window = {"window.size": [0.8] * 3, "window.trigger": 0.1, "window.outside": "keep"}
    config = load_config(voxel_map.config, **window)
    same, moving = VoxelMap(config), RollingMap(config)
    same.insert(*voxel_map.blocks())
    moving.go_on_with(same)
    moving.look_from(made.at((5.0, 5.0, 5.0)))
    return moving


@pytest.mark.parametrize("kind", KINDS)
def test_crop_keeps_the_cells_whose_middle_is_inside(kind):
    voxel_map = random_map(kind=kind)
    part = table(sv.crop(voxel_map, *BOX))
    middles = {
        cell: [(i + 0.5) * side for i, side in zip(cell, voxel_map.config.cell, strict=True)]
        for cell in table(voxel_map)
    }
    wanted = {
        cell: value
        for cell, value in table(voxel_map).items()
        if all(a <= m < b for a, m, b in zip(BOX[0], middles[cell], BOX[1], strict=True))
    }
    assert part == wanted
    assert 0 < len(part) < len(table(voxel_map))


def test_crops_that_share_a_face_make_the_whole():
    voxel_map = random_map()
    low, high = (sv.crop(voxel_map, *box) for box in (([-math.inf] * 3, [0.33, math.inf, math.inf]),
                                                      ([0.33, -math.inf, -math.inf], [math.inf] * 3)))  # fmt: skip
    assert not table(low).keys() & table(high).keys()
    assert table(low) | table(high) == table(voxel_map)
    assert not table(sv.crop(voxel_map, [50, 50, 50], [51, 51, 51]))


@pytest.mark.parametrize("box", [([0, 0, 0], [1, 0, 1]), ([0, 0], [1, 1]), ([0, 0, math.nan], [1, 1, 1])])
def test_boxes_that_are_none(box):
    with pytest.raises(StereovoxError, match="corners"):
        sv.crop(random_map(), *box)


def summed(a, b):
    """What a cell of both should hold, from the tables of both."""
    config = a.config.map
    prior = round(math.log(config.prior / (1 - config.prior)) * a.cell_format.per_log_odds) / a.cell_format.per_log_odds
    first, second = table(a), table(b)
    lowest, highest = (float(a.cell_format.log_odds(np.array([end]))[0]) for end in (a._rules.lowest, a._rules.highest))
    prior = min(max(prior, lowest), highest)
    result = first | second
    for cell in first.keys() & second.keys():
        total = min(max(first[cell] + second[cell] - prior, lowest), highest)
        result[cell] = total or 1 / a.cell_format.per_log_odds
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_merged_log_odds_add_up(kind):
    a, b = random_map(1, kind), random_map(2, kind)
    found, wanted = table(sv.merge(a, b)), summed(a, b)
    assert found.keys() == wanted.keys()
    np.testing.assert_allclose(
        [found[cell] for cell in wanted], list(wanted.values()), atol=1.1 / a.cell_format.per_log_odds
    )


def test_merging_commutes_and_crops_of_it_are_merged_crops():
    a, b = random_map(1), random_map(2)
    assert table(sv.merge(a, b)) == table(sv.merge(b, a))
    assert table(sv.merge(a, VoxelMap(a.config))) == table(sv.merge(VoxelMap(a.config), a)) == table(a)
    assert table(sv.crop(sv.merge(a, b), *BOX)) == table(sv.merge(sv.crop(a, *BOX), sv.crop(b, *BOX)))


def test_cells_of_other_kinds_are_merged_by_their_log_odds():
    a, b = random_map(1), random_map(2, "int8")
    found = sv.merge(a, b)
    assert found.config == a.config
    only_b = table(b).keys() - table(a).keys()
    merged = table(found)
    assert all(abs(merged[cell] - table(b)[cell]) < 0.03 for cell in list(only_b)[:200] if abs(table(b)[cell]) < 3)


@pytest.fixture(scope="module")
def halves():
    """Maps of every second frame, of the others, and of all, none of which clamps anything."""
    settings = {"voxel_size": 0.1, "map.log_odds_min": -30.0, "map.log_odds_max": 30.0, "map.keep_times": True,
                "sensor.p_right": 0.8}  # fmt: skip
    mappers = [Mapper(**settings) for _ in range(3)]
    for n, frame in enumerate(sv.open_source("sim:room?image_width=96", frames=":10")):
        for mapper in (mappers[n % 2], mappers[2]):
            assert mapper.add(frame).refused is None
    return [mapper.map for mapper in mappers]


def test_merged_halves_are_the_map_of_all_frames(halves):
    even, odd, both = halves
    merged = sv.merge(even, odd)
    found, wanted = table(merged), table(both)
    assert found.keys() == wanted.keys()
    assert len(wanted) > 3000
    away = np.abs(np.array([found[cell] - value for cell, value in wanted.items()]))
    assert away.max() < 0.0011  # where a sum passed just through "unknown"
    assert (away > 0).sum() < 20
    np.testing.assert_allclose(merged.ages(), both.ages(), atol=0.011)  # times count in steps of 10 ms
    assert (merged.frames, merged.viewpoint.stamp_ns) == (10, both.viewpoint.stamp_ns)
    assert merged.history.last_frame == both.history.last_frame
    assert merged.history.ways == both.history.ways


def test_a_merged_map_is_saved_with_what_it_says(halves, tmp_path):
    T = motion([0, 0, 0.3], [1.0, 2.0, 0.0])
    merged = sv.merge(*halves[:2], T)
    assert merged.frames == 10
    (first,), (second,) = (one.history.path.stops for one in halves[:2])
    path = merged.history.path
    assert sorted(path.stops) == [first, first + "+"]
    np.testing.assert_array_equal(path.poses(first), halves[0].history.path.poses(first))
    np.testing.assert_allclose(path.poses(first + "+"), T @ halves[1].history.path.poses(second), atol=1e-6)
    merged.save(tmp_path / "both.svox")
    again = sv.load_map(tmp_path / "both.svox")
    assert (table(again), again.history) == (table(merged), merged.history)
    np.testing.assert_array_equal(again.ages(), merged.ages())


def turned(cell, value, T):
    """Where a motion by whole cells of 0.1 m takes a cell."""
    place = T[:3, :3] @ (np.array(cell) + 0.5) + T[:3, 3] / 0.1
    return tuple(np.floor(place).astype(int).tolist()), value


@pytest.mark.parametrize(
    "T",
    [
        motion([0, 0, 0], [0.3, -1.7, 2.5]),
        motion([0, 0, math.pi / 2], [0.1, 0, 0]),
        motion([math.pi, 0, 0], [-0.8, 0.3, 0]),
        motion([0, -math.pi / 2, 0], [100.0, -70.0, 5.0]) @ motion([math.pi / 2, 0, 0], [0, 0, 0]),
    ],
    ids=["shift", "quarter", "half", "two quarters"],
)
def test_whole_cells_and_quarter_turns_are_exact(T):
    voxel_map = random_map()
    there = moved(voxel_map, T)
    assert table(there) == dict(turned(cell, value, T) for cell, value in table(voxel_map).items())
    assert table(moved(there, inverse(T))) == table(voxel_map)
    assert sv.merge(voxel_map, voxel_map, T).frames == 0


@pytest.mark.parametrize("kind", ["int16", "uint8", "uneven"])
def test_any_other_motion_takes_the_cell_at_the_middle_and_loses_nothing_solid(kind):
    voxel_map = random_map(3, kind, 500, low=-5, high=6)
    T = motion([0.4, -0.7, 1.1], [0.123, 0.456, -0.789])
    there, sides = moved(voxel_map, T), np.array(voxel_map.config.cell)
    known, what = table(voxel_map), states(voxel_map)
    pushed = {}
    for cell, state in what.items():
        if state >= State.TENTATIVE:
            place = transform_points(T, [(np.array(cell) + 0.5) * sides])[0]
            target = tuple(np.floor(place / sides).astype(int).tolist())
            pushed[target] = max(pushed.get(target, -99), known[cell])
    found = table(there)
    low, high = np.array(list(found)).min(0) - 1, np.array(list(found)).max(0) + 2
    targets = list(itertools.product(*(range(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))))
    sources = np.floor(transform_points(inverse(T), (np.array(targets) + 0.5) * sides) / sides).astype(int).tolist()
    for target, source in zip(targets, map(tuple, sources), strict=True):
        values = [table[at] for table, at in ((known, source), (pushed, target)) if at in table]
        assert found.get(target) == max(values, default=None), target
    occupied = transform_points(T, voxel_map.occupied())
    assert (there.state(occupied) == State.OCCUPIED).all()


def test_a_thin_pole_survives_any_turn():
    """A square of one cell that is turned by 45 degrees need not hold the middle of any cell."""
    pole = VoxelMap.from_cells(load_config(voxel_size=0.1), [(0, 0, k) for k in range(20)], np.full(20, 3.0))
    there = moved(pole, motion([0, 0, math.pi / 4], [0.0, 0.0 - math.sqrt(0.005), 0.0]))
    assert sorted(cell[2] for cell in table(there)) == list(range(20))


@pytest.mark.parametrize("kind", KINDS)
def test_changes_are_those_of_each_cell(kind):
    a, b = random_map(1, kind), random_map(2, kind)
    before, after = states(a), states(b)
    changes = sv.difference(a, b)
    pairs = {cell: (before.get(cell, 0), after.get(cell, 0)) for cell in sorted({*before, *after})}
    for name, chosen in {
        "appeared": lambda x, y: (x, y) == (State.FREE, State.OCCUPIED),
        "vanished": lambda x, y: (x, y) == (State.OCCUPIED, State.FREE),
        "became_known": lambda x, y: x == State.UNKNOWN,
        "became_unknown": lambda x, y: y == State.UNKNOWN,
    }.items():
        wanted = [cell for cell, pair in pairs.items() if chosen(*pair)]
        assert list(map(tuple, getattr(changes, name).tolist())) == wanted
        assert wanted
    counts = np.zeros((4, 4), int)
    for pair in pairs.values():
        counts[pair] += 1
    np.testing.assert_array_equal(changes.counts, counts)
    back = sv.difference(b, a)
    np.testing.assert_array_equal(back.appeared, changes.vanished)
    np.testing.assert_array_equal(back.became_unknown, changes.became_known)
    same = sv.difference(a, a)
    assert not any(len(kind) for kind in (same.appeared, same.vanished, same.became_known, same.became_unknown))


def test_a_difference_in_another_frame():
    a, T = random_map(), motion([0, 0, math.pi / 2], [0.3, 0, 0])
    assert not np.triu(sv.difference(a, moved(a, inverse(T)), T).counts, 1).any()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("factor", [2, 3, 10])
def test_a_larger_cell_is_as_bad_as_the_worst_in_it(kind, factor):
    voxel_map = random_map(kind=kind, number=4000)
    values, what = table(voxel_map), states(voxel_map)
    children = {}
    for cell in values:
        children.setdefault(tuple(i // factor for i in cell), []).append(cell)
    wanted = {}
    for parent, cells in children.items():
        seen = {State(what[cell]) for cell in cells} | ({State.UNKNOWN} if len(cells) < factor**3 else set())
        wanted[parent] = next(state for state in WORST if state in seen)
    coarse = sv.coarsen(voxel_map, factor)
    assert states(coarse) == {cell: state for cell, state in wanted.items() if state != State.UNKNOWN}
    for cell, value in table(coarse).items():
        assert value == pytest.approx(max(values[child] for child in children[cell]), abs=1e-6)
    np.testing.assert_allclose(coarse.config.cell, np.array(voxel_map.config.cell) * factor)
    box = [np.array(cell) * coarse.config.cell for cell in wanted]  # it is what a query about its box says
    inner = np.array(voxel_map.config.cell) * 0.01
    told = voxel_map.check_boxes(box + inner, box + np.array(coarse.config.cell) - inner)
    assert told.tolist() == list(wanted.values())


def test_cells_that_stay_as_they_are(halves):
    for voxel_map in (random_map(), halves[2]):
        assert table(sv.coarsen(voxel_map, 1)) == table(voxel_map)
    np.testing.assert_array_equal(sv.coarsen(halves[2], 1).ages(), halves[2].ages())
    fine, coarse = halves[2], sv.coarsen(halves[2], 2)
    newest = {}
    for cell, age in zip(fine.cells()[0].tolist(), fine.ages().tolist(), strict=True):
        parent = tuple(i // 2 for i in cell)
        newest[parent] = min(newest.get(parent, 1e9), age)
    assert coarse.ages().tolist() == [newest[tuple(cell)] for cell in coarse.cells()[0].tolist()]
    assert sv.coarsen(random_map(), 3).config.voxel_size == 0.3
    for factor in (0, 1.5, np.nan, np.inf, 10**6, 10**30):
        with pytest.raises(StereovoxError):
            sv.coarsen(random_map(), factor)


def test_maps_that_lie_on_disk_give_the_same():
    a, b = random_map(1), random_map(2)
    far, T = on_disk(a), motion([0.2, 0.1, 0], [0.5, 0, 0])
    try:
        assert len(list(far.store.tiles())) > 1
        assert table(sv.crop(far, *BOX)) == table(sv.crop(a, *BOX))
        assert table(sv.coarsen(far, 2)) == table(sv.coarsen(a, 2))
        assert table(sv.merge(far, b)) == table(sv.merge(b, far)) == table(sv.merge(a, b))
        assert table(moved(far, T)) == table(moved(a, T))
        np.testing.assert_array_equal(sv.difference(far, b).counts, sv.difference(a, b).counts)
    finally:
        far.close()


def test_what_does_not_go_together():
    a = random_map()
    other = random_map(voxel_size=0.2)
    for together in (sv.merge, sv.difference):
        with pytest.raises(StereovoxError, match=r"0\.1 and 0\.2 m.*coarsen"):
            together(a, other)
        with pytest.raises(StereovoxError, match="up is z in one map and -y in the other"):
            together(a, random_map(up="-y"))
        together(a, random_map(up="-y"), motion([np.pi / 2, 0, 0], [0, 0, 0]))
        with pytest.raises(StereovoxError, match="rigid"):
            together(a, a, np.diag([2.0, 1, 1, 1]))
        with pytest.raises(StereovoxError, match="farther"):
            together(a, a, motion([0, 0, 0], [0, 1e12, 0]))
    assert table(sv.merge(sv.coarsen(a, 2), other)).keys() == table(sv.coarsen(a, 2)).keys() | table(other).keys()
    assert not len(sv.crop(VoxelMap(a.config), [0, 0, 0], [1, 1, 1]).cells()[0])
    assert not len(
        sv.merge(VoxelMap(a.config), VoxelMap(a.config), from_quaternion([1, 0, 0], [0, 0, 0, 1])).cells()[0]
    )
