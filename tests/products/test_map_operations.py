# SPDX-License-Identifier: Apache-2.0
"""Crop, merge, difference and larger cells, against plain loops over tables of cells."""

import itertools
import math
from dataclasses import replace

import made_flights as made
import numpy as np
import pytest
from made_maps import KINDS, random_map, states, table
from scipy.optimize import linprog

import stereovox as sv
from stereovox import Mapper, State, StereovoxError, VoxelMap, load_config
from stereovox.geometry.se3 import from_quaternion, inverse, rotation_matrix, transform_points
from stereovox.maps.storage.rolling import RollingMap
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
    same.storage.insert(*voxel_map.storage.blocks())
    moving.storage.go_on_with(same.storage)
    moving.storage.set_viewpoint(made.at((5.0, 5.0, 5.0)))
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


def test_a_crop_keeps_up_and_how_old_its_frames_are():
    mapper = Mapper(load_config(voxel_size=0.1, up="-y"))
    source = sv.open_source("sim:room?axes=optical", frames=":2")
    for frame in source:
        assert mapper.add(frame).refused is None
    whole = mapper.map
    part = sv.crop(whole, [-1, -1, 0], [1, 1, 2])
    assert part.config == whole.config
    assert part.history.frames == whole.history.frames == 2
    np.testing.assert_array_equal(part.path, whole.path)
    assert part.history.last_frame == whole.history.last_frame is not None


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
    prior = (
        round(math.log(config.prior / (1 - config.prior)) * a.storage.cell_format.per_log_odds)
        / a.storage.cell_format.per_log_odds
    )
    first, second = table(a), table(b)
    lowest, highest = (
        float(a.storage.cell_format.log_odds(np.array([end]))[0])
        for end in (a.storage.rules.lowest, a.storage.rules.highest)
    )
    prior = min(max(prior, lowest), highest)
    result = first | second
    for cell in first.keys() & second.keys():
        total = min(max(first[cell] + second[cell] - prior, lowest), highest)
        result[cell] = total or 1 / a.storage.cell_format.per_log_odds
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_merged_log_odds_add_up(kind):
    a, b = random_map(1, kind), random_map(2, kind)
    found, wanted = table(sv.merge(a, b)), summed(a, b)
    assert found.keys() == wanted.keys()
    np.testing.assert_allclose(
        [found[cell] for cell in wanted], list(wanted.values()), atol=1.1 / a.storage.cell_format.per_log_odds
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
    assert merged.history.quality == both.history.quality


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


def turned(voxel_map, T):
    """The table of a map after a motion by whole cells."""
    sides = np.array(voxel_map.config.cell)
    places = {cell: (T[:3, :3] @ ((np.array(cell) + 0.5) * sides) + T[:3, 3]) / sides for cell in table(voxel_map)}
    return {tuple(np.floor(places[cell]).astype(int).tolist()): value for cell, value in table(voxel_map).items()}


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
@pytest.mark.parametrize("kind", ["int16", "int8", "uint8"])
def test_whole_cells_and_quarter_turns_are_exact(T, kind):
    voxel_map = random_map(kind=kind)
    there = moved(voxel_map, T)
    assert table(there) == turned(voxel_map, T)
    assert table(moved(there, inverse(T))) == table(voxel_map)
    assert sv.merge(voxel_map, voxel_map, T).frames == 0


@pytest.mark.parametrize("turn", [[0, 0, 0], [0, 0, math.pi], [math.pi, 0, 0]])
def test_whole_uneven_cells_and_half_turns_are_exact(turn):
    voxel_map, T = random_map(kind="uneven"), motion(turn, [1e4 + 0.3, -0.4, 0.05])
    assert table(moved(voxel_map, T)) == turned(voxel_map, T)


def test_times_move_with_the_cells(halves):
    both = halves[2]
    exact, askew = (moved(both, motion(turn, [0.5, 0.1, 0])) for turn in ([0, 0, math.pi / 2], [0.2, 0.1, 0.7]))
    assert sorted(exact.ages()) == sorted(both.ages())
    assert np.isfinite(askew.ages()).all()
    middles = transform_points(inverse(motion([0.2, 0.1, 0.7], [0.5, 0.1, 0])), askew.centers(askew.cells()[0]))
    before = np.nan_to_num(both.age(middles), nan=np.inf)  # where an unknown cell got a solid one
    assert (askew.ages() <= before).all()
    assert (askew.ages() == before).mean() > 0.9


def overlap(middle, turn):
    """Whether a cell in another frame overlaps cell (0, 0, 0): a ball fits into both. All in cells of this frame.

    middle: (3,) of the other cell; turn: (3, 3), its edges. Linear programming: the largest ball.
    """
    normals = np.concatenate([np.eye(3), np.linalg.inv(turn)])
    middles = np.concatenate([np.zeros(3), normals[3:] @ middle])  # each lies between two faces, half a cell away
    lengths = np.linalg.norm(normals, axis=1)
    walls = np.concatenate([np.column_stack([normals, lengths]), np.column_stack([-normals, lengths])])
    limits = np.concatenate([middles + 0.5, 0.5 - middles])
    found = linprog([0, 0, 0, -1], walls, limits, bounds=[(None, None)] * 4)
    return bool(found.x[3] > 1e-5)


class SlowMove:
    """What `moved` should make of a map, cell by cell in plain Python and float64."""

    def __init__(self, voxel_map, T):
        self.map, self.sides, self.back = voxel_map, np.array(voxel_map.config.cell), inverse(T)
        self.known, self.what, self.pushed = table(voxel_map), states(voxel_map), {}
        self.turn = self.back[:3, :3] * self.sides / self.sides[:, None]
        for cell, state in self.what.items():
            if state >= State.TENTATIVE:
                place = transform_points(T, [(np.array(cell) + 0.5) * self.sides])[0]
                target = tuple(np.floor(place / self.sides).astype(int).tolist())
                self.pushed[target] = max(self.pushed.get(target, -99), self.known[cell])

    def place(self, target, inside=(0.5, 0.5, 0.5)):
        """Where a place in a cell of the new frame lies, in cells of the old one."""
        return transform_points(self.back, [(np.array(target) + inside) * self.sides])[0] / self.sides

    def under(self, target, inside=(0.5, 0.5, 0.5)):
        """The old cell there."""
        return tuple(np.floor(self.place(target, inside)).astype(int).tolist())

    def overlapped(self, target):
        """States of the old cells that a new one overlaps, the solid ones first; each is looked at when asked for."""
        middle = self.place(target)
        reach = np.abs(self.turn).sum(axis=1) / 2
        near = itertools.product(
            *map(range, np.floor(middle - reach).astype(int), np.floor(middle + reach).astype(int) + 1)
        )
        for cell in sorted(near, key=lambda cell: -self.what.get(cell, 0)):
            state = self.what.get(cell, State.UNKNOWN)
            if state != State.FREE and overlap(middle - np.array(cell) - 0.5, self.turn):
                yield state

    def prior(self):
        return float(self.map.storage.cell_format.log_odds(np.array([self.map.storage.rules.prior]))[0])

    def shared(self, target):
        """What speaks for an obstacle in 4 x 4 x 4 places in a cell, on the average, on top of the prior."""
        steps = (np.arange(4) + 0.5) / 4
        values = [self.known.get(self.under(target, inside), -99) for inside in itertools.product(steps, repeat=3)]
        rules, there = self.map.storage.rules, self.map.storage.cell_format
        highest = float(there.log_odds(np.array([rules.thresholds.occupied_least - 1]))[0])
        return min(self.prior() + np.mean(np.maximum(np.array(values) - self.prior(), 0)), highest)

    def __call__(self, target):
        """The log-odds of a cell in the new frame; None: unknown."""
        values = [table[at] for table, at in ((self.known, self.under(target)), (self.pushed, target)) if at in table]
        value = max(values, default=None)
        if (
            value is None
            or self.map.storage.rules.states(self.map.storage.cell_format.stored([value]))[0] != State.FREE
        ):
            return value
        worst = next(self.overlapped(target), State.FREE)
        return value if worst == State.FREE else None if worst == State.UNKNOWN else self.shared(target)


@pytest.mark.parametrize("kind", ["int16", "uint8", "uneven"])
def test_any_other_motion_makes_each_cell_as_bad_as_what_it_overlaps(kind):
    voxel_map = random_map(4, kind, 200, low=-4, high=4)
    T = motion([0.4, -0.7, 1.1], [0.123, 0.456, -0.789])
    there, slow, step = moved(voxel_map, T), SlowMove(voxel_map, T), 1 / voxel_map.storage.cell_format.per_log_odds
    found = table(there)
    low, high = np.array(list(found)).min(0) - 1, np.array(list(found)).max(0) + 2
    for target in itertools.product(*(range(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True))):
        wanted = slow(target)
        assert found.get(target) == (wanted if wanted is None else pytest.approx(wanted, abs=2 * step)), target
    occupied = transform_points(T, voxel_map.occupied())
    assert (there.state(occupied) == State.OCCUPIED).all()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("T", [motion([0, 0, 0.3], [0.02, 0, 0.1]), motion([1.5, -0.2, 2.5], [60.03, -7.0, 400.01])])
def test_only_what_is_free_is_free_after_any_motion(kind, T):
    """5 x 5 x 5 places in each cell that is known, and others round about."""
    voxel_map, rng = random_map(9, kind, 800, low=-7, high=6), np.random.default_rng(31)
    there = moved(voxel_map, T)
    cells, sides = voxel_map.cells()[0], np.array(voxel_map.config.cell)
    inside = np.array(list(itertools.product(np.linspace(1e-3, 1 - 1e-3, 5), repeat=3)))
    around = rng.uniform(-9, 17, (50_000, 3))
    places = np.concatenate([(cells[:, None] + inside).reshape(-1, 3), around]) * sides
    before, after = voxel_map.state(places), there.state(transform_points(T, places))
    assert set(before[after == State.FREE]) == {State.FREE}
    assert (before == State.UNKNOWN).sum() > 10_000
    assert (there.state(transform_points(T, voxel_map.occupied())) == State.OCCUPIED).all()


@pytest.mark.parametrize("settings", [{}, {"map.prior": 0.5, "map.free_below": 0.4999, "map.occupied_above": 0.5001}])
def test_a_free_cell_that_is_mostly_occupied_is_not_occupied_by_that(settings):
    """One free cell among occupied ones: where the middle of a cell is in it, an eighth of that cell is."""
    indices = np.argwhere(np.ones((4, 4, 4)))
    log_odds = np.where((indices == 1).all(axis=1), -4.0, 3.5)
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=0.1, **settings), indices, log_odds)
    there = moved(voxel_map, motion([0, 0, 0], [0.049, 0.049, 0.049]))
    occupied = set(map(tuple, there.cells_in(State.OCCUPIED).tolist()))
    assert occupied == {tuple(cell) for cell in indices.tolist()} - {(1, 1, 1)}
    assert there.state([[0.15] * 3]) == [State.UNKNOWN if settings else State.TENTATIVE]
    assert not len(there.cells_in(State.FREE))


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
        assert len(list(far.storage.tile_store.tiles())) > 1
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
        with pytest.raises(StereovoxError, match="beyond the range of cell indices"):
            together(a, a, motion([0, 0, 0], [0, 1e12, 0]))
    assert table(sv.merge(sv.coarsen(a, 2), other)).keys() == table(sv.coarsen(a, 2)).keys() | table(other).keys()
    assert not len(sv.crop(VoxelMap(a.config), [0, 0, 0], [1, 1, 1]).cells()[0])
    assert not len(
        sv.merge(VoxelMap(a.config), VoxelMap(a.config), from_quaternion([1, 0, 0], [0, 0, 0, 1])).cells()[0]
    )


def test_a_moved_map_remembers_no_pose_of_its_old_frame():
    mapper = sv.Mapper(voxel_size=0.2)
    frames = list(sv.open_source("sim:room?image_width=160", frames=":12"))
    for frame in [*frames, replace(frames[-1], depth=2 * frames[-1].depth, reason=None)]:
        mapper.add(frame)
    assert mapper.map.history.doubts
    assert mapper.map.history.looks
    history = moved(mapper.map, motion([0, 0, 0.3], [1, 0, 0])).history
    assert (history.trusted, history.waiting, history.looks, history.doubts) == ({}, {}, {}, {})
    assert history.usual == mapper.map.history.usual
