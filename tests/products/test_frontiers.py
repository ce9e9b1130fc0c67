# SPDX-License-Identifier: Apache-2.0
"""Frontiers against a flood fill over a table of cells."""

import itertools

import numpy as np
import pytest
from made_maps import KINDS, random_map, states

from stereovox import State, StereovoxError, VoxelMap, frontiers, load_config
from stereovox.products.blocks import CORNERS, FACES, components
from stereovox.products.frontiers import write_frontiers

FREE, WALL = -3.0, 3.0


def steps_of(half):
    return [*half, *(tuple(-i for i in step) for step in half)]


def moved(cell, step):
    return tuple(a + b for a, b in zip(cell, step, strict=True))


def flooded(cells, half):
    """Sets of cells that hang together by the steps or their opposites."""
    left, groups, steps = set(cells), [], steps_of(half)
    while left:
        group, edge = set(), [left.pop()]
        while edge:
            cell = edge.pop()
            group.add(cell)
            near = {moved(cell, step) for step in steps} & left
            left -= near
            edge += near
        groups.append(group)
    return groups


@pytest.mark.parametrize("kind", KINDS)
def test_equals_the_flood_fill(kind):
    voxel_map = random_map(5, kind, 2500)
    what = states(voxel_map)
    rim = [cell for cell, state in what.items() if state == State.FREE
           and any(moved(cell, step) not in what for step in steps_of(FACES))]  # fmt: skip
    wanted = {frozenset(group) for group in flooded(rim, CORNERS) if len(group) >= 3}
    found = frontiers(voxel_map, smallest=3, longest=99.0)
    assert {frozenset(map(tuple, one.cells.tolist())) for one in found} == wanted
    assert len(wanted) > 1
    assert [len(one.cells) for one in found] == sorted(map(len, wanted), reverse=True)
    for one in found:
        np.testing.assert_allclose(one.centroid, voxel_map.centers(one.cells).mean(axis=0))


@pytest.mark.parametrize("half", [FACES, CORNERS, ((1, 0, 2), (0, 1, -1)), ((0, 1, -4), (1, 0, 3))])
def test_components_equal_the_flood_fill(half):
    cells = np.unique(np.random.default_rng(0).integers([-9, -9, -2], [9, 9, 3], (400, 3)), axis=0)
    np.random.default_rng(1).shuffle(cells)
    group = components(cells, half)
    found = {frozenset(map(tuple, cells[group == n].tolist())) for n in range(group.max() + 1)}
    assert found == set(map(frozenset, flooded(map(tuple, cells.tolist()), half)))


def room(**more):
    """A free room of 20 x 12 x 10 cells in walls, and behind a door one cell thick a corridor with an open end."""
    cells = {}
    for cell in itertools.product(range(-1, 21), range(-1, 13), range(-1, 11)):
        inside = all(0 <= i < n for i, n in zip(cell, (20, 12, 10), strict=True))
        cells[cell] = FREE if inside else WALL
    for cell in itertools.product(range(20, 40), range(3, 8), range(6)):
        cells[cell] = FREE if cell[1] in (4, 5, 6) and 1 <= cell[2] <= 4 else WALL
    config = load_config(voxel_size=0.1, **more)
    return VoxelMap.from_cells(config, list(cells), list(cells.values()))


def test_the_open_end_of_a_corridor():
    (end,) = frontiers(room(), start=[1.0, 0.6, 0.5], radius=0.0, smallest=5)
    assert end.cells.tolist() == [[39, y, z] for y in (4, 5, 6) for z in (1, 2, 3, 4)]
    np.testing.assert_allclose(end.centroid, [3.95, 0.55, 0.3])
    assert end.look_from[:2] == pytest.approx([3.95, 0.55])  # a cell of its own
    assert abs(end.look_from[2] - 0.3) < 0.06
    (end,) = frontiers(room(), start=[1.0, 0.6, 0.5], radius=0.12)
    assert end.look_from[0] < 3.9  # farther in: no unknown cell within the radius
    assert (room().check_capsules(end.look_from, end.look_from, 0.12) == State.FREE).all()
    (end,) = frontiers(room(), start=[1.0, 0.6, 0.5], radius=0.3)  # too large for the corridor; nothing hides the end
    assert end.look_from[0] < 2.0
    (end,) = frontiers(room(), start=[1.0, 0.6, 0.5], radius=9.0)
    assert end.look_from is None


def test_what_a_wall_cuts_off_is_out_of_reach():
    cells = dict(zip(map(tuple, (of := room().cells())[0].tolist()), of[1].tolist(), strict=True))
    cells |= {(20, y, z): WALL for y in range(-1, 13) for z in range(-1, 11)}
    closed = VoxelMap.from_cells(load_config(voxel_size=0.1), list(cells), list(cells.values()))
    (end,) = frontiers(closed, start=[1.0, 0.6, 0.5], radius=0.0)
    assert end.look_from is None
    (end,) = frontiers(closed, start=[3.0, 0.5, 0.3], radius=0.0)
    assert end.look_from is not None


def test_long_ones_are_halved():
    free = [(x, y, 0) for x in range(40) for y in range(3)]
    field = VoxelMap.from_cells(load_config(voxel_size=0.1), free, [FREE] * len(free))
    (whole,) = frontiers(field, longest=4.0, radius=0.0)
    parts = frontiers(field, longest=1.0, radius=0.0)
    assert len(parts) == 4
    assert all(np.ptp(field.centers(part.cells)[:, 0]) <= 1.0 for part in parts)
    assert sorted(map(tuple, np.concatenate([part.cells for part in parts]).tolist())) == list(
        map(tuple, whole.cells.tolist())
    )


@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_heights_are_along_up(up):
    voxel_map = random_map(6, up=up)
    axis, sign = "xyz".index(up[-1]), -1 if up.startswith("-") else 1
    everywhere = np.concatenate([one.cells for one in frontiers(voxel_map, 1)])
    within = np.concatenate([one.cells for one in frontiers(voxel_map, 1, heights=(0.2, 0.6), floor=-0.3)])
    height = sign * (everywhere[:, axis] + 0.5) * 0.1 + 0.3
    wanted = everywhere[(height > 0.2) & (height <= 0.6)]
    assert set(map(tuple, within.tolist())) == set(map(tuple, wanted.tolist()))


def test_saved_for_numpy(tmp_path):
    found = frontiers(random_map(7), smallest=2, start=[0, 0, 0], radius=0.1)
    write_frontiers(found, tmp_path / "f.npz")
    saved = np.load(tmp_path / "f.npz")
    for n, one in enumerate(found):
        np.testing.assert_array_equal(saved["cells"][saved["frontier"] == n], one.cells)
        np.testing.assert_array_equal(saved["centroid"][n], one.centroid)
        assert np.isnan(saved["look_from"][n]).all() if one.look_from is None else True
    write_frontiers([], tmp_path / "none.npz")
    assert np.load(tmp_path / "none.npz")["look_from"].shape == (0, 3)


def test_nothing_and_nonsense():
    assert frontiers(VoxelMap(load_config())) == []
    for bad in ({"radius": -1}, {"radius": np.nan}, {"longest": 0}, {"start": [0, 0]}, {"start": [0, np.nan, 0]},
                {"heights": (1, 0)}):  # fmt: skip
        with pytest.raises(StereovoxError):
            frontiers(room(), **bad)
    far = VoxelMap.from_cells(load_config(), [(-(2**29),) * 3, (2**29,) * 3], [FREE, FREE])
    with pytest.raises(StereovoxError, match="crop"):
        frontiers(far, 1)


def test_heights_are_measured_above_the_floor_at_each_place():
    """A ramp below the world's origin: the band follows it; without a floor it is refused."""
    cells, values = [], []
    for x in range(30):
        level = x // 3 - 25
        cells += [(x, y, level + above) for y in range(12) for above in range(21)]
        values += [3.0 if above == 0 else FREE for _ in range(12) for above in range(21)]
    ramp = VoxelMap.from_cells(load_config(voxel_size=0.1), cells, values)
    found = np.concatenate([one.cells for one in frontiers(ramp, 1, heights=(0.45, 0.85))])
    above = found[:, 2] - (found[:, 0] // 3 - 25)
    assert set(above.tolist()) == {5, 6, 7, 8}
    with pytest.raises(StereovoxError, match="shows no floor"):
        frontiers(VoxelMap.from_cells(load_config(voxel_size=0.1), [[0, 0, 0]], [FREE]), 1, heights=(0.2, 0.6))
