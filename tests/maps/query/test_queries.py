# SPDX-License-Identifier: Apache-2.0
"""Queries against slow twins on a dense array of states, and on cases that can be worked out by hand."""

import itertools
from typing import Any

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap, make_map
from stereovox.maps.cells.cell_format import CellRules
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.query.queries import NO_CELL

FREE, UNKNOWN, TENTATIVE, OCCUPIED = State.FREE, State.UNKNOWN, State.TENTATIVE, State.OCCUPIED
RANK = np.array([1, 0, 2, 3])  # of UNKNOWN, FREE, TENTATIVE, OCCUPIED
HALF = 16
"""The dense array holds cells -HALF..HALF-1 of each axis."""
SIDES = {"cubes": {"voxel_size": 0.1}, "slabs": {"voxel_size": 0.3, "steps": (0.1, 0.3, 0.07)}}
TOUCH = 1e-9
CAMERA = PinholeCamera.from_field_of_view(64, 48, 90)


def random_map(seed, **settings):
    """Return a map of blocks that are missing, wholly free at the floor, nearly free or mixed, and its dense states."""
    rng = np.random.default_rng(seed)
    config = load_config(**{**SIDES["cubes"], **settings})
    blocks = np.stack(np.meshgrid(*[np.arange(-2, 2)] * 3, indexing="ij"), -1).reshape(-1, 3)
    kinds = rng.choice(4, len(blocks), p=[0.1, 0.4, 0.3, 0.2])
    states = np.zeros((2 * HALF,) * 3, np.uint8)
    for block, kind in zip(blocks, kinds, strict=True):
        x, y, z = 8 * block + HALF
        shares = ([1, 0, 0, 0], [0, 1, 0, 0], [0.005, 0.98, 0.01, 0.005], [0.3, 0.3, 0.2, 0.2])[kind]
        states[x : x + 8, y : y + 8, z : z + 8] = rng.choice(4, (8, 8, 8), p=shares)
    known = np.argwhere(states)
    log_odds = np.array([0.0, -3.0, -1.5, 2.0])[states[tuple(known.T)]]
    voxel_map = VoxelMap.from_cells(config, known - HALF, log_odds)
    none = np.empty((0, 3), np.int32), np.empty((0, 512), np.int16)
    voxel_map.add(Evidence(*none, blocks[kinds == 1].astype(np.int32), -9000))  # to the floor
    return voxel_map, states


@pytest.fixture(
    scope="module",
    params=[("cubes", "int16"), ("slabs", "int16"), ("cubes", "uint8")],
    ids=lambda case: "-".join(case),
)
def world(request):
    sides, cell = request.param
    voxel_map, states = random_map(5, **SIDES[sides], **{"map.cell": cell})
    return voxel_map, states, np.array(voxel_map.config.cell)


def corners(states, sides):
    """Return lowest and highest corners (n, 3) of all cells of the dense array, and their states (n,)."""
    cells = np.indices(states.shape).reshape(3, -1).T - HALF
    return cells * sides, (cells + 1) * sides, states.ravel()


def points_in(sides, rng, n, part=0.9):
    return rng.uniform(-part, part, (n, 3)) * HALF * sides


def state_by_hand(states, sides, point):
    with np.errstate(invalid="ignore"):
        cell = np.floor(np.asarray(point, float) / sides)
    if not (np.abs(cell + 0.5) < HALF).all():
        return UNKNOWN
    return states[tuple(cell.astype(int) + HALF)]


# points


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_points_equal_one_by_one(world, dtype):
    voxel_map, states, sides = world
    rng = np.random.default_rng(1)
    anywhere = points_in(sides, rng, 1000, part=1.5)
    on_faces = rng.integers(-HALF, HALF, (1000, 3)) * sides
    beside = np.nextafter(on_faces, rng.choice([-9, 9], (1000, 3)))
    odd = [[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [1e300, 0, 0], [0, -1e18, 0], [-0.0, 0, 0]]
    with np.errstate(over="ignore"):
        points = np.concatenate([anywhere, on_faces, beside, odd]).astype(dtype)
    wanted = [state_by_hand(states, sides, point) for point in points]
    assert voxel_map.state(points).tolist() == wanted
    log_odds = voxel_map.log_odds(points)
    assert (log_odds.dtype, voxel_map.probability(points).dtype) == (np.float32, np.float32)
    assert np.array_equal(log_odds != 0, np.array(wanted) != UNKNOWN)
    assert voxel_map.probability(points) == pytest.approx(1 / (1 + np.exp(-log_odds.astype(float))), abs=1e-6)


def test_points_come_in_any_form(world):
    voxel_map, _, sides = world
    points = points_in(sides, np.random.default_rng(2), 60)
    wanted = voxel_map.state(points).tolist()
    frozen = points.copy()
    frozen.flags.writeable = False
    for same in (points.tolist(), np.asfortranarray(points), np.repeat(points, 2, axis=0)[::2], frozen):
        assert voxel_map.state(same).tolist() == wanted
    assert voxel_map.state(points.ravel()[:3]).tolist() == wanted[:1]
    assert voxel_map.state([[1, 2, 3]]).tolist() == voxel_map.state([[1.0, 2.0, 3.0]]).tolist()
    assert voxel_map.state(np.empty((0, 3))).shape == (0,)


def test_points_at_the_limit_of_indices():
    last = 2**30 - 1
    far = [[last, 0, 0], [-last, 0, 0], [7, 0, 0], [2**30, 0, 0], [-(2**30), 0, 0]]
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=1.0), far, [-3.0] * 5)
    wrapped = 2**35 + 7  # cut down to 32 bits, that is cell 7
    asked = [last, -last, wrapped, 7, -wrapped, 2**30, -(2**30), 1e300, -np.inf, np.nan]
    expected = [State.FREE, State.FREE, State.UNKNOWN, State.FREE, *[State.UNKNOWN] * 6]
    assert voxel_map.state([[x, 0, 0] for x in asked]).tolist() == expected
    assert voxel_map.state([[x, 0, 0] for x in asked[::-1]]).tolist() == expected[::-1]


# rays


def rays_by_hand(states, sides, origin, direction, stop_at):
    """Return the distance at which a ray enters the first stopping cell for sure, and the earliest that can be."""
    low, high, of_cell = corners(states, sides)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / direction, (high - origin) / direction
    beside = (direction == 0) & ((origin < low) | (origin >= high))
    enter = np.where(direction == 0, -np.inf, np.minimum(a, b)).max(axis=1)
    leave = np.where(direction == 0, np.inf, np.maximum(a, b)).min(axis=1)
    stops = np.isin(of_cell, stop_at) & ~beside.any(axis=1)
    enter = np.maximum(enter, 0)
    sure, touched = (enter[stops & (leave - enter > slack)] for slack in (TOUCH, -TOUCH))
    return sure.min(initial=np.inf), touched.min(initial=np.inf)


STOPS = [(OCCUPIED,), (OCCUPIED, UNKNOWN), (TENTATIVE,), (UNKNOWN,), (OCCUPIED, TENTATIVE, UNKNOWN)]


def directions_of(rng, n):
    """Return unit vectors: any, and along axes and diagonals, as grids provoke them."""
    straight = rng.integers(-1, 2, (n, 3)).astype(float)
    straight[~straight.any(axis=1)] = [0, 0, -1]
    directions = np.where(rng.random((n, 1)) < 0.7, rng.normal(size=(n, 3)), straight)
    return directions / np.linalg.norm(directions, axis=1)[:, None]


@pytest.mark.parametrize("stop_at", STOPS, ids=lambda states: "-".join(s.name.lower() for s in states))
def test_rays_equal_the_twin(world, stop_at):
    voxel_map, states, sides = world
    rng = np.random.default_rng(3)
    origins, directions = points_in(sides, rng, 60, part=0.6), directions_of(rng, 60)
    lengths = rng.uniform(0.5, 9, (60, 1))
    farthest = 0.39 * HALF * min(sides)  # never leaves the dense array
    hits = voxel_map.cast_rays(origins, directions * lengths, farthest, stop_at)
    met = 0
    for origin, direction, distance, cell, state in zip(origins, directions, *hits, strict=True):
        sure, touched = rays_by_hand(states, sides, origin, direction, stop_at)
        if np.isfinite(distance):
            met += 1
            assert touched - 1e-5 <= distance <= sure + 1e-5
            assert state == states[tuple(cell + HALF)]
            assert state in stop_at
            entered = origin + distance * direction
            assert ((entered >= cell * sides - 1e-5) & (entered <= (cell + 1) * sides + 1e-5)).all()
        else:
            assert sure > farthest - 1e-6
            assert cell.tolist() == [NO_CELL] * 3
            assert state == UNKNOWN
    assert met >= 5


def test_long_rays_equal_the_twin(world):
    """From far outside and through the whole map: rays are cut to where there are blocks."""
    voxel_map, states, sides = world
    rng = np.random.default_rng(4)
    targets, directions = points_in(sides, rng, 80, part=1.1), directions_of(rng, 80)
    origins = targets - 10 * HALF * sides * directions
    directions = targets - origins
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    distances = voxel_map.cast_rays(origins, directions, np.inf).distance
    for origin, direction, distance in zip(origins, directions, distances, strict=True):
        sure, touched = rays_by_hand(states, sides, origin, direction, (OCCUPIED,))
        assert touched - 1e-4 <= distance <= sure + 1e-4 or distance == sure
    one_by_one = [voxel_map.cast_rays(o, [d], 1e4).distance[0] for o, d in zip(origins, directions, strict=True)]
    assert one_by_one == pytest.approx(distances.tolist(), abs=1e-4)


def test_rays_on_faces_and_corners():
    """Cells of 0.5 m, so that all places are whole in binary."""
    config = load_config(voxel_size=0.5)
    wall = [[8, y, z] for y in range(-3, 3) for z in range(-3, 3)]
    voxel_map = VoxelMap.from_cells(config, [*wall, [-9, -9, -9]], [2.0] * 37)

    def hit(origin, direction, farthest=100.0, stop_at=(OCCUPIED,)):
        hits = voxel_map.cast_rays(origin, [direction], farthest, stop_at)
        return hits.distance[0], hits.cell[0].tolist()

    assert hit([0, 0, 0], [2, 0, 0]) == (4.0, [8, 0, 0])  # along an edge: of the cells above it
    assert hit([0, 0.25, 0.25], [1, 0, 0], 4.0) == (4.0, [8, 0, 0])  # just as far as allowed
    assert hit([0, 0.25, 0.25], [1, 0, 0], 3.99)[0] == np.inf
    assert hit([4.0, 0.1, 0.1], [-1, 0, 0]) == (0.0, [8, 0, 0])  # begins on its face: it is the origin's own cell
    assert hit([4.5, 0.1, 0.1], [-1, 0, 0]) == (0.0, [8, 0, 0])  # next to it, and enters at once
    assert hit([4.5, 0.1, 0.1], [1, 0, 0])[0] == np.inf
    assert hit([4.5, 0.1, 0.1], [0, 1, 0])[0] == np.inf
    diagonal, cell = hit([0, 0, 0], [-1, -1, -1])  # from corner to corner
    assert diagonal == pytest.approx(4 * np.sqrt(3))
    assert cell == [-9, -9, -9]
    assert hit([0, 0, 0], [1, 0, 0], stop_at=[UNKNOWN]) == (0.0, [0, 0, 0])
    assert hit([4.2, 0, 0], [1, 0, 0], stop_at=UNKNOWN) == (pytest.approx(0.3), [9, 0, 0])
    assert hit([0, 0, 0], [1e-200, 0, 0]) == hit([0, 0, 0], [1e200, 0, 0]) == (4.0, [8, 0, 0])
    assert hit([0, 0.25, 0.25], [1, 1e-310, -1e-310]) == (4.0, [8, 0, 0])


def test_rays_of_an_empty_map():
    empty = VoxelMap(load_config(voxel_size=0.1))
    hits = empty.cast_rays([0, 0, 0], np.eye(3), np.inf)
    assert not np.isfinite(hits.distance).any()
    unknown = empty.cast_rays([-0.01, 0.11, 0], np.eye(3), np.inf, [UNKNOWN])
    assert unknown.distance.tolist() == [0, 0, 0]
    assert unknown.cell.tolist() == [[-1, 1, 0]] * 3
    assert [array.shape for array in empty.cast_rays([0, 0, 0], np.empty((0, 3)), 1.0)] == [(0,), (0, 3), (0,)]


# boxes


def worst(states):
    return [FREE, UNKNOWN, TENTATIVE, OCCUPIED][RANK[np.ravel(states)].max()]


def worst_in_box(states, sides, low, high):
    first, last = (np.floor(corner / sides).astype(int) + HALF for corner in (low, high))
    beyond = [UNKNOWN] if (first < 0).any() or (last >= 2 * HALF).any() else []
    inside = tuple(slice(max(a, 0), max(b + 1, 0)) for a, b in zip(first, last, strict=True))
    return worst([*states[inside].ravel(), *beyond])


def test_boxes_equal_the_twin(world):
    voxel_map, states, sides = world
    rng = np.random.default_rng(6)
    middles = points_in(sides, rng, 900, part=1.1)
    reach = rng.uniform(0, 1, (900, 3)) * sides * rng.choice([0, 1, 4, 15, 60], (900, 1), p=[0.1, 0.4, 0.3, 0.1, 0.1])
    low, high = middles - reach, middles + reach
    on_faces = rng.random(900) < 0.3
    low[on_faces] = np.round(low[on_faces] / sides) * sides
    high[on_faces] = np.maximum(low[on_faces], np.round(high[on_faces] / sides) * sides)
    wanted = [worst_in_box(states, sides, a, b) for a, b in zip(low, high, strict=True)]
    assert set(wanted) == {FREE, UNKNOWN, TENTATIVE, OCCUPIED}
    assert voxel_map.check_boxes(low, high).tolist() == wanted


def test_faces_of_a_box_count():
    cells = [[x, y, z] for x in range(4) for y in range(4) for z in range(4)]
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=0.5), [*cells, [2, 2, 2]], [-3.0] * 64 + [2.0])
    low, high = np.array([[0.5] * 3, [0.5] * 3, [1.5] * 3, [1.0, 1.0, 0.5], [0, 0, 0], [-0.1, 0, 0]]), np.zeros((6, 3))
    high[:] = [[0.99] * 3, [1.0] * 3, [1.99] * 3, [1.2, 1.2, 0.9], [1.9, 1.9, 0.9], [0.4] * 3]
    assert voxel_map.check_boxes(low, high).tolist() == [FREE, OCCUPIED, FREE, FREE, FREE, UNKNOWN]
    assert voxel_map.check_boxes([0, 0, 0], [2, 0, 0]).tolist() == [UNKNOWN]  # the face at 2 m belongs to the next cell


# capsules


def distances_of_axis(low, high, start, end):
    """Return the distances (n,) of boxes from a line segment: it is convex along it, so thirds are cut off."""
    a, b = np.zeros(len(low)), np.ones(len(low))

    def distance(t):
        place = start + t[:, None] * (end - start)
        return np.linalg.norm(np.maximum(np.maximum(low - place, place - high), 0), axis=1)

    for _ in range(60):
        left, right = a + (b - a) / 3, b - (b - a) / 3
        nearer = distance(left) <= distance(right)
        a, b = np.where(nearer, a, left), np.where(nearer, right, b)
    return distance((a + b) / 2)


def test_capsules_equal_the_twin(world):
    voxel_map, states, sides = world
    rng = np.random.default_rng(7)
    n = 120
    low, high, of_cell = corners(states, sides)
    start = points_in(sides, rng, n, part=0.8)
    end = start + directions_of(rng, n) * rng.choice([0, 0.2, 1.5], (n, 1))
    end = np.clip(end, -0.9 * HALF * sides, 0.9 * HALF * sides)
    radius = rng.choice([0, 0.02, 0.1, 0.3], n) * (1 + rng.random(n)) * (min(sides) / 0.1)
    found = voxel_map.check_capsules(start, end, radius)
    seen = set()
    for a, b, r, state in zip(start, end, radius, found, strict=True):
        about = (high >= np.minimum(a, b) - r - 1e-6).all(axis=1) & (low <= np.maximum(a, b) + r + 1e-6).all(axis=1)
        off, here = distances_of_axis(low[about], high[about], a, b), of_cell[about]
        beyond = [UNKNOWN] if (np.maximum(np.abs(a), np.abs(b)) + r > HALF * sides).any() else []
        sure, touched = worst(here[off <= max(r - 1e-6, 0)]), worst([*here[off <= r + 1e-6], *beyond])
        assert RANK[sure] <= RANK[state] <= RANK[touched], (a, b, r)
        seen.add(state)
    assert {FREE, UNKNOWN, OCCUPIED} <= seen


def test_a_capsule_touches_a_cell_at_its_radius():
    """Cells of 0.5 m in free space, one of them occupied, with corners at 1 and 1.5 m."""
    cells = np.stack(np.meshgrid(*[np.arange(-8, 16)] * 3), -1).reshape(-1, 3)
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=0.5), [*cells, [2, 2, 2]], [-3.0] * len(cells) + [2.0])

    def check(start, end, radius):
        return voxel_map.check_capsules([start], [end], radius).tolist()[0]

    assert check([0.5, 1.25, 1.25], [0.5, 1.25, 1.25], 0.5) == OCCUPIED  # a ball at a face
    assert check([0.5, 1.25, 1.25], [0.5, 1.25, 1.25], 0.499) == FREE
    assert check([1.75, 1.25, 0], [1.75, 1.25, 3], 0.25) == OCCUPIED  # an axis that passes by
    assert check([1.75, 1.25, 0], [1.75, 1.25, 3], 0.249) == FREE
    assert check([0.25, 2, 1.25], [-3, 5, 1.25], 0.902) == OCCUPIED  # nearest to an end
    assert check([0.25, 2, 1.25], [-3, 5, 1.25], 0.901) == FREE
    assert check([0, 2.5, 1.25], [2.5, 0, 1.25], 0) == OCCUPIED  # through the middle
    assert check([0, 0, 0], [3, 0, 3], 1.0) == OCCUPIED  # past an edge, 1 m off
    assert check([0, 0, 0], [3, 0, 3], 0.999) == FREE
    assert check([0, 0, 0], [0.4, 0.4, 0.4], np.sqrt(0.36 * 3) - 1e-6) == FREE  # a corner
    assert check([0, 0, 0], [0.4, 0.4, 0.4], np.sqrt(0.36 * 3) + 1e-6) == OCCUPIED


# nearest


@pytest.mark.parametrize("obstacles", STOPS, ids=lambda states: "-".join(s.name.lower() for s in states))
@pytest.mark.parametrize("max_distance", [0.15, 1.0, np.inf])
def test_nearest_equals_the_twin(world, obstacles, max_distance):
    voxel_map, states, sides = world
    rng = np.random.default_rng(8)
    inner = 0.5 if UNKNOWN in obstacles else 1.6  # beyond the dense array all is unknown
    points = points_in(sides, rng, 80, part=inner)
    points[:20] = np.round(points[:20] / sides) * sides
    found = voxel_map.nearest_obstacle(points, max_distance, obstacles)
    low, high, of_cell = corners(states, sides)
    wanted = np.isin(of_cell, obstacles)
    low, high = low[wanted], high[wanted]
    for point, distance, cell in zip(points, *found, strict=True):
        away = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0), axis=1).min()
        if UNKNOWN in obstacles:
            away = min(away, (HALF * sides - np.abs(point)).min())
        if away > max_distance:
            assert distance == np.inf
            assert cell.tolist() == [NO_CELL] * 3
            continue
        assert distance == pytest.approx(away, abs=1e-5)
        assert voxel_map.state((cell + 0.5) * sides)[0] in obstacles
        gap = np.maximum(np.maximum(cell * sides - point, point - (cell + 1) * sides), 0)
        assert np.linalg.norm(gap) == pytest.approx(away, abs=1e-5)


def test_nearest_by_hand():
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=0.5), [[2, 2, 2], [-40, 0, 0]], [2.0, 2.0])
    points = [[1.25, 1.25, 1.25], [1, 1, 1], [0, 1.25, 1.25], [0, 0, 0], [-30, 0.25, 0.25]]
    found = voxel_map.nearest_obstacle(points, np.inf)
    assert found.distance.tolist() == pytest.approx([0, 0, 1, np.sqrt(3), 10])
    assert found.cell.tolist() == [[2, 2, 2]] * 4 + [[-40, 0, 0]]
    assert voxel_map.nearest_obstacle(points, 1.0).distance.tolist() == [0, 0, 1, np.inf, np.inf]
    assert voxel_map.nearest_obstacle([0, 0, 0], 1.0, UNKNOWN).cell.tolist() == [[0, 0, 0]]
    empty = VoxelMap(load_config(voxel_size=0.1))
    assert empty.nearest_obstacle([0, 0, 0], np.inf).distance.tolist() == [np.inf]


# large and bad


def test_what_is_larger_than_the_map_is_answered(world):
    voxel_map, states, _ = world
    huge = [[-1e7] * 3], [[1e7] * 3]
    assert voxel_map.check_boxes(*huge).tolist() == [OCCUPIED]
    assert voxel_map.check_capsules(*huge, 1e6).tolist() == [OCCUPIED]
    assert voxel_map.check_capsules([[1e7] * 3], [[1e7, 1e7, 0]], 1e5).tolist() == [UNKNOWN]
    assert voxel_map.check_boxes([[1e3] * 3], [[1e7] * 3]).tolist() == [UNKNOWN]
    assert voxel_map.check_boxes([[1e300] * 3], [[1e301] * 3]).tolist() == [UNKNOWN]
    far = voxel_map.nearest_obstacle([[1e7, 0, 0]], np.inf)
    assert 0.99e7 < far.distance[0] < 1e7
    assert states[tuple(far.cell[0] + HALF)] == OCCUPIED
    empty = VoxelMap(load_config(voxel_size=0.1))
    assert empty.check_boxes(*huge).tolist() == [UNKNOWN]
    assert empty.check_capsules(*huge, 1e6).tolist() == [UNKNOWN]


def test_a_box_of_tentative_cells_among_the_unknown():
    """One tentative block far from the box's corner is found by way of the list of blocks."""
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=0.1), [[9000, 9000, 9000]], [-1.5])
    assert voxel_map.check_boxes([[-1e4] * 3], [[1e4] * 3]).tolist() == [TENTATIVE]
    assert voxel_map.check_capsules([[-1e4] * 3], [[1e4] * 3], 0.01).tolist() == [TENTATIVE]


# maps in a window


def test_a_window_knows_points_on_disk_and_the_rest_of_what_is_in_memory(tmp_path):
    config = load_config(voxel_size=0.1, window={"size": [3.2, 3.2, 3.2], "outside": "keep"})
    solid = np.full((1, 512), 5000, np.int16)
    rolling = make_map(config, tiles=tmp_path / "tiles")
    rolling.storage.set_viewpoint(Viewpoint(CAMERA, np.eye(4), 0))
    rolling.add(Evidence(np.zeros((1, 3), np.int32), solid, np.empty((0, 3), np.int32), -1))
    inside, ball = [[0.05, 0.05, 0.05]], ([[0.4] * 3], [[0.4] * 3], 0.1)
    assert rolling.state(inside).tolist() == [OCCUPIED]
    assert rolling.check_capsules(*ball).tolist() == [OCCUPIED]
    away = np.eye(4)
    away[:3, 3] = 50
    rolling.storage.set_viewpoint(Viewpoint(CAMERA, away, 1))
    assert rolling.state(np.array(inside, np.float32)).tolist() == [OCCUPIED]
    assert rolling.check_capsules(*ball).tolist() == [UNKNOWN]
    assert rolling.check_boxes(inside, inside).tolist() == [UNKNOWN]
    assert rolling.nearest_obstacle(inside, np.inf).distance.tolist() == [np.inf]
    assert rolling.cast_rays(np.add(inside, 5), [[-1, -1, -1]], np.inf).distance.tolist() == [np.inf]
    rolling.close()


def test_a_window_without_a_place_answers_from_the_map_it_goes_on_with():
    wall = VoxelMap.from_cells(load_config(voxel_size=0.1), [[5, 0, 0]], [2.0])
    rolling = make_map(load_config(voxel_size=0.1, window={"size": [3.2, 3.2, 3.2]}), resume=wall)
    assert rolling.cast_rays([0, 0, 0], [[1, 0, 0]], 9.0).distance.tolist() == pytest.approx([0.5])
    assert rolling.state([[0.55, 0, 0]]).tolist() == [OCCUPIED]


@pytest.mark.parametrize("cell", ["int16", "uint8"])
def test_whole_thresholds_tell_states_as_exact_ones_do(cell):
    for prior, free, occupied in itertools.product([0.05, 0.2, 0.5, 0.6], [0.12, 0.3, 0.49], [0.5, 0.7, 0.97]):
        limits = {"map.prior": prior, "map.free_below": free, "map.occupied_above": occupied, "map.cell": cell}
        rules = CellRules(load_config(**limits).map)
        numbers = np.arange(np.iinfo(rules.format.dtype).min, np.iinfo(rules.format.dtype).max + 1)
        states = np.full(len(numbers), TENTATIVE)
        states[numbers < rules.free_below] = FREE
        states[numbers > rules.occupied_above] = OCCUPIED
        states[numbers == rules.format.unknown] = UNKNOWN
        assert np.array_equal(rules.states(numbers.astype(rules.format.dtype)), states)


@pytest.mark.parametrize(
    ("query", "arguments", "message"),
    [
        ("cast_rays", ([0, 0, 0], [[1, 0, 0], [0, 0, 0]], 1), r"direction 1 is \(0, 0, 0\) and leads nowhere"),
        ("cast_rays", ([0, 0, 0], [[np.nan, 0, 0]], 1), "directions: number 0 is not finite"),
        (
            "cast_rays",
            ([[0, 0, 0]] * 2, [[1, 0, 0]] * 3, 1),
            "origins holds 2 places, directions 3; give one, or as many",
        ),
        ("cast_rays", ([0, 0], [[1, 0, 0]], 1), r"origins are \(2,\) int64; give \(N, 3\) metres"),
        ("cast_rays", ([1e9, 0, 0], [[1, 0, 0]], 1), "origins: beyond the map, whose cells reach 107374 km"),
        ("cast_rays", ("here", [[1, 0, 0]], 1), r"origins: 'here' is not numbers of shape \(N, 3\)"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], np.nan), "max_distance: nan is not a length of 0 m or more"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], 1, [FREE]), "stop_at: give one or more of State.UNKNOWN"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], 1, []), "stop_at: give one or more of"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], 1, [3.0]), r"stop_at: give one or more of .*, not \[3.0\]$"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], 1, 3.0), "stop_at: give one or more of .*, not 3.0$"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], 1, None), "stop_at: give one or more of .*, not None$"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], 1, "occupied"), "stop_at: give one or more of .*, not 'occupied'$"),
        ("cast_rays", ([0, 0, 0], [[1, 0, 0]], np.array([1.0, 2.0])), "max_distance: 2 lengths; give one for all"),
        ("cast_rays", ([0, 0, 0], [["1", "0", "0"]], 1), r"directions: \[\['1', '0', '0'\]\] is not numbers"),
        ("cast_rays", ([0, 0, 0], [[1j, 0, 0]], 1), r"directions: \[\[1j, 0, 0\]\] is not numbers of shape"),
        ("check_boxes", ([[0, 0, 0]] * 2, [[1, 0, 0], [0, 0, -1]]), "box 1: low is above high; swap them"),
        ("check_boxes", ([[0, 0, 0]], [[1, 0, 0]] * 2), "low holds 1 place, high 2; give as many"),
        ("check_boxes", ([[0, 0, 0]], [[np.inf, 0, 0]]), "high: number 0 is not finite"),
        ("check_capsules", ([[0, 0, 0]], [[1, 0, 0]], -1), "radius: -1 is not a length of 0 m or more"),
        ("check_capsules", ([[0, 0, 0]], [[1, 0, 0]], np.nan), "radius: nan is not a length"),
        (
            "check_capsules",
            ([[0, 0, 0]] * 3, [[1, 0, 0]] * 3, [1, 2]),
            "radius holds 2 lengths, start 3; give one, or as many",
        ),
        ("check_capsules", ([[0, 0, 0]], [[1, 0, 0]], np.inf), "radius: beyond the map"),
        ("check_capsules", ([[0, 0, 0]], [[1, 0, 0]], "0.2"), "radius: '0.2' is not a length in metres"),
        ("check_capsules", ([[0, 0, 0]], [[1, 0, 0]], None), "radius: None is not a length in metres"),
        (
            "check_capsules",
            ([[0, 0, 0]] * 4, [[1, 0, 0]] * 4, np.ones((2, 2))),
            r"radius is \(2, 2\) \w+; give \(N,\) metres",
        ),
        ("check_capsules", ([[0, 0, 0]], [[1, 0, 0]] * 2, 1), "start holds 1 place, end 2; give as many"),
        ("nearest_obstacle", ([[0, 0, np.inf]], 1), "points: number 0 is not finite"),
        ("nearest_obstacle", ([[0, 0, 0]], -1), "max_distance: -1 is not a length"),
        ("nearest_obstacle", ([[0, 0, 0]], "far"), "max_distance: 'far' is not a length in metres"),
        ("nearest_obstacle", ([[0, 0, 0]], None), "max_distance: None is not a length in metres"),
        ("nearest_obstacle", ([[0, 0, 0]], 1 + 0j), r"max_distance: \(1\+0j\) is not a length in metres"),
        ("nearest_obstacle", ([[0, 0, 0], [0, 0]], 1), r"points: \[\[0, 0, 0\], \[0, 0\]\] is not numbers of shape"),
        ("nearest_obstacle", ([[0, 0, 0]], 1, [7]), "obstacles: give one or more of"),
    ],
)
def test_bad_input_is_refused_in_one_line(query, arguments, message):
    voxel_map = VoxelMap(load_config(voxel_size=0.1))
    with pytest.raises(StereovoxError, match=message) as error:
        getattr(voxel_map, query)(*arguments)
    assert "\n" not in str(error.value)


NOT_POINTS = [
    (np.zeros((3, 4)), r"are \(3, 4\) \w+; give \(N, 3\) metres, or \(3,\) for one"),
    (np.zeros((4, 2)), r"are \(4, 2\) \w+; give \(N, 3\) metres, or \(3,\) for one"),
    (np.zeros((2, 2, 3)), r"are \(2, 2, 3\) \w+; give \(N, 3\) metres, or \(3,\) for one"),
    (np.zeros((3, 0)), r"are \(3, 0\) \w+; give \(N, 3\) metres, or \(3,\) for one"),
    (np.zeros(6), r"are \(6,\) \w+; give \(N, 3\) metres, or \(3,\) for one"),
    ([1, 2], r"are \(2,\) \w+; give \(N, 3\) metres, or \(3,\) for one"),
    (1.0, r"are \(\) \w+; give \(N, 3\) metres, or \(3,\) for one"),
    ("abc", r": 'abc' is not numbers of shape \(N, 3\)"),
    ([["1", "2", "3"]], r": \[\['1', '2', '3'\]\] is not numbers"),
    (None, ": None is not numbers"),
    ([[1, 2, None]], r": \[\[1, 2, None\]\] is not numbers"),
    ([[1, 2, 3], [1, 2]], r": \[\[1, 2, 3\], \[1, 2\]\] is not numbers"),
    ([[1 + 2j, 0, 0]], r": \[\[\(1\+2j\), 0, 0\]\] is not numbers"),
    (np.zeros((9, 3), complex), r": array\(\[\[.*\) is not numbers"),
]


@pytest.mark.parametrize("method", ["state", "log_odds", "probability"])
@pytest.mark.parametrize(
    "settings", [{}, {"window": {"size": [3.2, 3.2, 3.2], "outside": "keep"}}], ids=["map", "window"]
)
@pytest.mark.parametrize(("points", "message"), NOT_POINTS, ids=[str(i) for i in range(len(NOT_POINTS))])
def test_what_is_no_points_is_refused_in_one_line(method, settings, points, message):
    voxel_map = make_map(load_config(voxel_size=0.1, **settings))
    with pytest.raises(StereovoxError, match=f"^points ?{message}") as error:
        getattr(voxel_map, method)(points)
    assert "\n" not in str(error.value)
    voxel_map.close()


def test_an_empty_list_is_a_batch_of_none():
    voxel_map = VoxelMap(load_config(voxel_size=0.1))
    answers = [
        voxel_map.state([]),
        voxel_map.cast_rays([0, 0, 0], [], 1.0).distance,
        voxel_map.check_boxes([], []),
        voxel_map.check_capsules([], [], 0.1),
        voxel_map.nearest_obstacle([], 1.0).distance,
    ]
    assert [answer.shape for answer in answers] == [(0,)] * 5


def test_states_may_be_whole_numbers():
    wall = VoxelMap.from_cells(load_config(voxel_size=0.5), [[2, 0, 0]], [2.0])
    anyhow: list[Any] = [OCCUPIED, 3, [3], np.array([3], np.uint8), {OCCUPIED}, iter([OCCUPIED])]
    for stop_at in anyhow:
        assert wall.cast_rays([0, 0, 0], [1, 0, 0], 9.0, stop_at).distance.tolist() == [1.0]
