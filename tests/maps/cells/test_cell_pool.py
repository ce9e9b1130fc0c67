# SPDX-License-Identifier: Apache-2.0
"""The pool of blocks against a dict of NumPy arrays: with blocks at the floor, that rise, sink, come and go."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereovox.config import load_config
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.cells import cell_pool
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.cell_pool import CellPool
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.query.queries import stored_at

FORMATS = ("int16", "int8", "uint8")
NONE, NOTHING = np.empty((0, 3), np.int32), np.empty((0, 512), np.int16)


def rules_of(cell, **limits):
    return CellRules(load_config(**{"map.cell": cell}, **{f"map.{key}": value for key, value in limits.items()}).map)


class Slow:
    """Blocks as a dict: coordinates -> 512 whole numbers; a block of which nothing is known is not in it."""

    def __init__(self, rules):
        self.blocks = {}
        self.unknown, self.prior = rules.format.unknown, int(rules.prior)
        self.limits = int(rules.lowest), int(rules.highest)

    def add(self, coords, values):
        changed = 0
        for block, steps in zip(map(tuple, coords.tolist()), values.astype(int), strict=True):
            old = self.blocks.get(block, np.full(512, self.unknown))
            new = np.clip(np.where(old == self.unknown, self.prior, old) + steps, *self.limits)
            new[new == self.unknown] += 1
            new = np.where(steps == 0, old, new)
            changed += int((new != old).sum())
            self.put([block], [new])
        return changed

    def put(self, coords, cells):
        for block, numbers in zip(map(tuple, coords), cells, strict=True):
            self.blocks.pop(block, None)
            if (numbers != self.unknown).any():
                self.blocks[block] = np.asarray(numbers)

    def rows(self, coords):
        return np.array([self.blocks[block] for block in coords]).reshape(-1, 512)


def assert_same(pool, slow, rules):
    """Compare every cell in every way a pool is read, and that it keeps no more rows than it must."""
    coords, cells = (np.concatenate(part) for part in zip(*pool.pieces(), strict=True))
    wanted = sorted(slow.blocks)
    assert list(map(tuple, coords.tolist())) == wanted
    np.testing.assert_array_equal(cells, slow.rows(wanted))
    at_floor = sum((numbers == rules.lowest).all() for numbers in slow.blocks.values())
    assert pool.count.tolist() == [len(wanted) - at_floor, at_floor]
    assert sorted(map(tuple, pool.block_coords.tolist())) == wanted
    around = np.argwhere(np.ones((6, 6, 6), bool)).astype(np.int32) - 3
    there, found = pool.get(around)
    assert [tuple(block) for block in there.tolist()] == [b for b in map(tuple, around.tolist()) if b in slow.blocks]
    np.testing.assert_array_equal(found, slow.rows(map(tuple, there.tolist())))
    asked = np.random.default_rng(0).integers(-24, 24, (500, 3))
    stored = stored_at(pool.stored_cells, (1.0, 1.0, 1.0), asked + 0.5)
    empty = np.full(512, slow.unknown)
    low = asked & 7
    assert stored.tolist() == [
        slow.blocks.get(block, empty)[(x << 6) | (y << 3) | z]
        for block, (x, y, z) in zip(map(tuple, (asked >> 3).tolist()), low.tolist(), strict=True)
    ]


def some_blocks(random, most=30):
    return np.unique(random.integers(-2, 3, (random.integers(0, most), 3)), axis=0).astype(np.int32)


def some_steps(random, n, size):
    """Rows of all kinds: nothing, one way down, a hit among free cells, anything."""
    values = np.full((n, 512), -size)
    values[random.random(n) < 0.2] = 0
    for row in values[random.random(n) < 0.3]:
        row[random.integers(0, 512, 3)] = size
    mixed = random.random(n) < 0.4
    values[mixed] = random.integers(-size, size, (int(mixed.sum()), 512))
    values[random.random((n, 512)) < random.choice([0.0, 0.3])] = 0
    return values.astype(np.int16)


@pytest.mark.parametrize("cell", FORMATS)
@pytest.mark.parametrize("threads", [1, 3])
def test_equals_a_dict(cell, threads, monkeypatch):
    monkeypatch.setattr(cell_pool, "WORTH_A_THREAD", 2)
    monkeypatch.setattr(cell_pool, "PIECE", 7)
    rules = rules_of(cell)
    pool, slow, random = CellPool(rules, rows=1, bare=1), Slow(rules), np.random.default_rng(7)
    span = int(rules.highest) - int(rules.lowest)
    sunk = risen = 0
    for _ in range(120):
        bare = pool.count[1]
        blocks = some_blocks(random)
        match random.integers(0, 8):
            case 0:
                pool.remove(blocks)
                slow.put(blocks.tolist(), np.full((len(blocks), 512), slow.unknown))
            case 1:
                cells = random.integers(*slow.limits, (len(blocks), 512)).astype(rules.format.dtype)
                cells[random.random(len(blocks)) < 0.3] = rules.lowest
                cells[random.random(len(blocks)) < 0.3] = rules.format.unknown
                pool.put(blocks, cells)
                slow.put(blocks.tolist(), cells)
            case _:
                half = len(blocks) // 2
                values = some_steps(random, half, span // 3)
                steps = -random.integers(1, span, len(blocks) - half).astype(np.int16)
                changed = slow.add(blocks[:half], values)
                changed += slow.add(blocks[half:], np.repeat(steps[:, None], 512, axis=1))
                assert pool.add(blocks[:half], values, blocks[half:], steps, threads) == changed
        sunk, risen = sunk + (pool.count[1] > bare), risen + (pool.count[1] < bare)
        assert_same(pool, slow, rules)
    assert min(sunk, risen) > 10


@settings(max_examples=60, deadline=None)
@given(
    cell=st.sampled_from(FORMATS),
    limits=st.tuples(st.floats(-30, -0.001), st.floats(0.001, 30)),
    prior=st.floats(0.001, 0.999),
    steps=st.lists(st.integers(-32768, 32767), min_size=1, max_size=12),
)
def test_sums_never_overflow(cell, limits, prior, steps):
    rules = rules_of(cell, log_odds_min=limits[0], log_odds_max=limits[1], prior=prior)
    pool, slow, here = CellPool(rules), Slow(rules), np.zeros((1, 3), np.int32)
    for step in steps:
        values = np.resize(np.array([step, -step // 2, 0, step]), (1, 512)).astype(np.int16)
        assert pool.add(here, values, NONE, same(0, NONE), 1) == slow.add(here, values)
    assert_same(pool, slow, rules)


def same(step, blocks):
    return np.full(len(blocks), step, np.int16)


def many(n):
    return np.column_stack([np.arange(n), np.arange(n) % 7, -np.arange(n)]).astype(np.int32)


def test_memory_is_given_back():
    rules = rules_of("int16")
    pool, blocks = CellPool(rules), many(5000)
    start = pool.reserved_bytes
    pool.add(NONE, NOTHING, blocks, same(-100, blocks), 1)
    assert pool.memory_bytes > 5000 * 1024
    assert pool.memory_bytes <= pool.reserved_bytes < 1.6 * pool.memory_bytes
    pool.add(NONE, NOTHING, blocks, same(-30000, blocks), 1)
    assert pool.count.tolist() == [0, 5000]
    assert pool.memory_bytes <= pool.reserved_bytes < start + 5000 * 60
    hit = np.zeros((1, 512), np.int16)
    hit[0, 5] = 1
    pool.add(blocks[:1], hit, NONE, same(0, NONE), 1)
    assert pool.count.tolist() == [1, 4999]
    pool.remove(blocks)
    assert len(pool) == 0
    assert pool.reserved_bytes == start


def test_a_pool_never_shrinks_below_its_first_size():
    pool = CellPool(rules_of("int16"), rows=600, bare=600)
    before = pool.reserved_bytes
    for step in (-100, -30000):
        pool.add(NONE, NOTHING, many(600), same(step, many(600)), 1)
        assert pool.reserved_bytes == before
    pool.remove(many(600))
    assert pool.reserved_bytes == before


def test_what_is_free_already_needs_no_rows():
    pool = CellPool(rules_of("int16"), rows=1)
    pool.add(NONE, NOTHING, many(200), same(-30000, many(200)), 1)
    before = pool.values
    steps = np.where(np.random.default_rng(0).random((100, 512)) < 0.5, 0, -300).astype(np.int16)
    assert pool.add(many(200)[:100], steps, many(200)[100:], same(-300, many(100)), 1) == 0
    assert pool.values is before, "no row was made and taken back"


def test_evidence_that_names_a_block_twice_does_no_harm():
    """It breaks the rule of `Evidence`; yet the pool stays whole."""
    rules = rules_of("int16")
    pool, slow = CellPool(rules), Slow(rules)
    twice = np.zeros((2, 3), np.int32)
    for values in ([[-30000], [50]], [[1], [1]], [[-30000], [-30000]]):
        steps = np.repeat(np.array(values, np.int16), 512, axis=1)
        pool.add(twice, steps, NONE, same(0, NONE), 1)
        slow.add(twice, steps)
        assert_same(pool, slow, rules)


def free_map():
    """A map of one block at the floor, one next to it that is not."""
    voxel_map = VoxelMap(load_config(voxel_size=0.1))
    steps = np.full((1, 512), -30000, np.int16)
    steps[0, 9] = 0
    voxel_map.add(Evidence(np.array([[1, 0, 0]], np.int32), steps, np.array([[0, 0, -4]], np.int32), -30000))
    return voxel_map


def test_a_map_looks_the_same_whatever_its_blocks_are_kept_in(tmp_path):
    voxel_map = free_map()
    coords, cells = voxel_map.storage.blocks()
    assert coords.tolist() == [[0, 0, -4], [1, 0, 0]]
    assert [np.unique(row).tolist() for row in cells] == [[-4000], [-4000, 0]]
    assert voxel_map.counts() == {"free": 1023, "tentative": 0, "occupied": 0}
    assert voxel_map.bounds() == pytest.approx(np.array([[0, 0, -3.2], [1.6, 0.8, 0.8]]))
    assert len(voxel_map.cells()[0]) == len(voxel_map.free()) == 1023
    assert voxel_map.log_odds([[0.4, 0.4, -2.9], [0.4, 0.4, 2.9]]).tolist() == [-4, 0]
    voxel_map.save(tmp_path / "m")
    loaded = load_map(tmp_path / "m")
    assert loaded.memory_bytes == voxel_map.memory_bytes
    assert loaded.add(Evidence(NONE, NOTHING, coords, -10)) == 1, "only the cell that was unknown"


def test_a_block_that_becomes_unknown_is_gone():
    voxel_map = free_map()
    full = voxel_map.memory_bytes
    coords, cells = voxel_map.storage.blocks()
    voxel_map.storage.insert(coords, np.zeros_like(cells))
    assert voxel_map.bounds() is None
    assert len(voxel_map.storage.blocks()[0]) == 0
    assert voxel_map.memory_bytes == full - 1024 - 2 * 12


def test_blocks_at_the_floor_cost_their_coordinates():
    voxel_map = VoxelMap(load_config(voxel_size=0.1))
    voxel_map.add(Evidence(NONE, NOTHING, many(2000), -30000))
    assert voxel_map.memory_bytes < 2000 * 50
    assert voxel_map.counts()["free"] == 2000 * 512
