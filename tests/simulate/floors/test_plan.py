# SPDX-License-Identifier: Apache-2.0
"""Plans of floors: walls round free rectangles, rays in two dimensions, and the perfect map."""

from __future__ import annotations

import numpy as np
import pytest
from made_segments import distance_to

from stereovox.simulate.floors.floor import Floor
from stereovox.simulate.floors.plan import FloorPlan, block, post
from stereovox.simulate.floors.view import cast, with_lids

BENT = FloorPlan(
    [(0.0, 0.0, 4.0, 2.0), (3.0, 1.0, 4.0, 5.0)],
    [block("boxes", "crate", (1.0, 0.5, 1.5, 1.0), (0.0, 0.4), 30), post("posts", "post", (3.5, 4.0), 0.3, 2.0)],
)
"""A corridor with a corner, a crate and a post."""


def slow_cast(segments: np.ndarray, x: float, y: float, angle: float) -> float:
    """Solve start + s along = origin + t direction for each segment, one by one."""
    nearest = np.inf
    for x0, y0, x1, y1 in segments:
        matrix = np.array([[np.cos(angle), x0 - x1], [np.sin(angle), y0 - y1]])
        if abs(np.linalg.det(matrix)) < 1e-12:
            continue
        t, s = np.linalg.solve(matrix, [x0 - x, y0 - y])
        if 0 <= s <= 1 and t >= 0:
            nearest = min(nearest, t)
    return nearest


def test_rays_meet_what_a_slow_solver_finds():
    random = np.random.default_rng(3)
    segments = BENT.outline(0.2, 0.2)
    for x, y in ((0.5, 0.5), (3.5, 3.0), (2.0, 1.7)):
        angles = random.uniform(-np.pi, np.pi, 60)
        slow = [slow_cast(segments, x, y, angle) for angle in angles]
        np.testing.assert_allclose(cast(segments, (x, y), angles), slow, atol=1e-9)
        short = np.where(np.array(slow) <= 1.2, slow, np.inf)
        np.testing.assert_allclose(cast(segments, (x, y), angles, 1.2), short, atol=1e-9)


def test_a_ray_along_an_axis_and_one_that_meets_nothing():
    segments = np.array([(2.0, -1.0, 2.0, 1.0), (1.0, 0.0, 3.0, 0.0)])  # the second lies along the ray
    np.testing.assert_allclose(cast(segments, (0, 0), [0.0, np.pi, np.pi / 2]), [2.0, np.inf, np.inf])
    assert cast(np.empty((0, 4)), (0, 0), [0.0]) == np.inf


def test_walls_stand_round_the_union_of_the_rectangles_and_nowhere_else():
    length = np.linalg.norm(BENT.walls[:, :2] - BENT.walls[:, 2:], axis=1).sum()
    assert length == pytest.approx(4 + 5 + 1 + 3 + 3 + 2)  # round the L: overlaps leave no wall inside
    inner = np.array([(3.0, 1.5), (3.5, 2.0), (3.5, 1.0)])
    assert (distance_to(BENT.walls, inner) > 0.4).all()


@pytest.mark.parametrize("plan", ["corridors", "testbed"])
def test_flat_rays_and_the_scene_of_solids_agree(plan):
    floor = Floor(f"sim:floor?plan={plan}&noise=0")
    angles = np.linspace(-np.pi, np.pi, 200, endpoint=False) + 1e-3
    for stamp in floor.truth.stamps_ns[:: len(floor.truth) // 12]:
        x, y = floor.truth.at(stamp)[:2, 3]
        for height in (0.1, 0.225, 0.72, 1.33):
            flat = cast(floor.plan.outline(height, height), (x, y), angles)
            rays = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(len(angles))])
            solid = floor.plan.scene.cast((x, y, height), rays)
            alike = np.abs(flat - solid) < 1e-3
            assert alike.mean() > 0.985, (plan, height, angles[~alike])  # a ray on a corner may go either way


def test_the_perfect_map_knows_what_can_be_seen_and_reached():
    grid = BENT.truth(0.05, (0.5, 1.5))
    assert grid.origin[0] <= -0.1
    assert grid.resolution == 0.05
    at = lambda x, y: int(grid.cells[tuple(grid.indices([(x, y)])[0])])  # noqa: E731 - short and local
    assert at(0.5, 1.5) == 0
    assert at(3.5, 4.6) == 0  # behind the post, but it can be reached
    assert at(1.25, 0.75) == at(2.0, 3.0) == at(3.5, 4.0) == -1  # inside the crate, a wall and the post
    assert at(0.01, 1.0) == at(2.0, 0.01) == at(3.5 - 0.15, 4.01) == 100
    assert {-1, 0, 100} == set(np.unique(grid.cells))
    # every occupied cell has a surface in it, every surface a cell
    rows, columns = np.nonzero(grid.cells == 100)
    assert distance_to(BENT.outline(0.1, 1.8), grid.centres(rows, columns)).max() <= 0.05 * np.sqrt(0.5) + 1e-9


def test_the_perfect_map_is_of_a_band_of_heights():
    under = FloorPlan([(0.0, 0.0, 2.0, 2.0)], [block("tables", "top", (0.5, 0.5, 1.5, 1.5), (0.7, 0.74))])
    free = (under.truth(0.05, (0.2, 0.2), (0.2, 0.3)).cells == 0).sum()
    less = (under.truth(0.05, (0.2, 0.2), (0.2, 1.0)).cells == 0).sum()
    assert free - less == pytest.approx(1.1**2 / 0.05**2, rel=0.15)


LIDS = [  # x from, heights, whether a camera at 0.3 m sees a lid between 0.1 and 1.8 m; each 0.5 m wide
    ("table", 0.5, (0.7, 0.75), True),
    ("pallet", 1.5, (0.0, 0.15), True),
    ("crate", 2.5, (0.0, 0.5), False),
    ("beam", 3.5, (1.9, 2.0), False),
    ("mat", 4.5, (0.0, 0.05), False),
    ("below", 5.5, (0.0, 0.4), False),
    ("on top", 5.5, (0.4, 0.9), False),
    ("pillar", 6.5, (0.0, 2.6), False),
]


def test_a_camera_sees_tops_below_and_undersides_above_it():
    obstacles = [block("boxes", name, (x, 0.5, x + 0.5, 1.0), heights) for name, x, heights, _ in LIDS]
    obstacles.append(block("legs", "leg", (0.6, 0.6, 0.7, 0.7), (0.0, 0.7)))
    obstacles.append(block("tables", "shut away", (9.0, 0.5, 9.5, 1.0), (0.7, 0.75)))
    plan = FloorPlan([(0.0, 0.0, 8.0, 2.0), (8.5, 0.0, 10.0, 2.0)], obstacles)
    slice_ = plan.truth(0.02, (0.1, 0.1))
    grid = with_lids(slice_, obstacles, (0.1, 1.8), 0.3)
    at = lambda cells, x, y: int(cells[tuple(grid.indices([(x, y)])[0])])  # noqa: E731 - short and local
    for name, x, heights, seen in LIDS:
        passed = heights[0] > 1.8 or heights[1] < 0.1  # nothing between the heights: the floor there is free
        before = 0 if passed else -1
        assert at(slice_.cells, x + 0.25, 0.75) == before, name
        assert at(grid.cells, x + 0.25, 0.75) == (100 if seen else before), name
    assert at(grid.cells, 0.65, 0.65) == -1  # inside of the leg
    assert at(grid.cells, 9.25, 0.75) == -1  # no way leads there
    area = (grid.cells == 100).sum() - (slice_.cells == 100).sum()
    assert area == pytest.approx((2 * 0.48**2 - 0.1**2) / 0.02**2, rel=0.05)
    assert ((grid.cells == slice_.cells) | ((grid.cells == 100) & (slice_.cells == -1))).all()


def test_a_perfect_map_of_a_floor_can_have_lids():
    floor = Floor("sim:floor?plan=testbed&seconds=1")
    slice_, whole = (floor.true_grid(0.05, (0.1, 1.8), lids=lids) for lids in (False, True))
    table = next(obstacle for obstacle in floor.plan.obstacles if obstacle.name == "table 2: top")
    crate = next(obstacle for obstacle in floor.plan.obstacles if obstacle.name == "crate")
    for obstacle, seen in ((table, 100), (crate, -1)):
        row, column = slice_.indices([obstacle.corners.mean(axis=0)])[0]
        assert slice_.cells[row, column] == -1
        assert whole.cells[row, column] == seen
    np.testing.assert_array_equal(floor.true_grid(0.05, lids=True).cells, floor.true_grid(0.05).cells)  # the lidar's
