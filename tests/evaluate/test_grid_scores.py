# SPDX-License-Identifier: Apache-2.0
"""Two floors' maps compared, against counting cell by cell in plain Python."""

import json
import math

import numpy as np
import pytest
from made_floors import FREE, WALL, changed, random_floor, room

from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_align import aligned_grids
from stereovox.evaluate.grid_scores import Difference, differences, score_grids, wrong
from stereovox.geometry import se2
from stereovox.maps import State
from stereovox.maps.occupancy import OccupancyGrid

REGION = (1.1, 4.0, 3.0, 0.7)
"""Its corners are given high before low in y."""


def word(grid, row, column):
    """unknown, free or occupied: what is between is unknown, as to map_server."""
    if not (0 <= row < grid.cells.shape[0] and 0 <= column < grid.cells.shape[1]):
        return "unknown"
    percent = int(grid.cells[row, column])
    if percent < 0 or 100 * grid.free_below <= percent <= 100 * grid.occupied_above:
        return "unknown"
    return "occupied" if percent > 100 * grid.occupied_above else "free"


def slow(ours, theirs, shift=(0, 0), region=None, tolerance=1):
    """Count everything for two maps of one cell size, `ours` moved by whole (rows, columns)."""
    rows, columns = theirs.cells.shape
    reach = 15
    cells = [(r, c) for r in range(-reach, rows + reach) for c in range(-reach, columns + reach)]
    say = {at: word(ours, at[0] - shift[0], at[1] - shift[1]) for at in cells}
    true = {at: word(theirs, *at) for at in cells}

    def out(at):
        x, y = (at[1] + 0.5) * theirs.resolution, (at[0] + 0.5) * theirs.resolution
        return region is not None and region[0] <= x <= region[2] and region[3] <= y <= region[1]

    inside = [at for at in cells if not out(at)]
    differ = [at for at in inside if say[at] != true[at]]
    walls = {at for at in cells if say[at] == "occupied"}
    true_walls = {at for at in cells if true[at] == "occupied"}
    ours_in, theirs_in = {at for at in walls if not out(at)}, {at for at in true_walls if not out(at)}

    def close(at, others):
        return any(max(abs(at[0] - o[0]), abs(at[1] - o[1])) <= tolerance for o in others)

    def gaps(start, goal):
        return sorted(min(math.dist(a, b) for b in goal) * theirs.resolution for a in start)

    near, found = sum(close(a, true_walls) for a in ours_in), sum(close(a, walls) for a in theirs_in)
    number = sum(true[at] != "unknown" for at in cells)
    both = [at for at in inside if "unknown" not in (say[at], true[at])]
    return {
        "eq7_percent": 100 * len(differ) / number,
        "eq7_coverage_percent": 100 * sum("unknown" in (say[at], true[at]) for at in differ) / number,
        "eq7_contradiction_percent": 100 * sum("unknown" not in (say[at], true[at]) for at in differ) / number,
        "eq7_outside_percent": 100 * len(differ) / sum(true[at] != "unknown" for at in inside),
        "known_error_percent": 100 * sum(say[at] != true[at] for at in both) / len(both),
        "missed": sum(say[at] == "unknown" for at in differ),
        "extra": sum(true[at] == "unknown" for at in differ),
        "wrongly_occupied": sum((say[at], true[at]) == ("occupied", "free") for at in differ),
        "wrongly_free": sum((say[at], true[at]) == ("free", "occupied") for at in differ),
        "forgiven": sum(say[at] != true[at] for at in cells if out(at)),
        "known_in_both": len(both),
        "occupied_iou": len(ours_in & theirs_in) / len(ours_in | theirs_in),
        "occupied_iou_tolerant": (near + found) / 2 / (len(ours_in) + len(theirs_in) - (near + found) / 2),
        "tolerance_precision": near / len(ours_in),
        "tolerance_recall": found / len(theirs_in),
        "tp": sum((say[at], true[at]) == ("occupied", "occupied") for at in inside),
        "fp": sum((say[at], true[at]) == ("occupied", "free") for at in inside),
        "fn": sum(true[at] == "occupied" and say[at] != "occupied" for at in inside),
        "tn": sum(true[at] == "free" and say[at] != "occupied" for at in inside),
        "to": gaps(ours_in, true_walls),
        "from": gaps(theirs_in, walls),
    }


@pytest.mark.parametrize("region", [None, REGION])
@pytest.mark.parametrize(("shift", "tolerance"), [((0, 0), 1), ((2, -5), 1), ((-4, 3), 2), ((1, 0), 0)])
def test_all_numbers_are_those_of_counting(region, shift, tolerance):
    theirs, ours = random_floor(1), random_floor(2, shape=(7, 13))
    wanted = slow(ours, theirs, shift, region, tolerance)
    start = (shift[1] * 0.5, shift[0] * 0.5, 0)
    found = score_grids(ours, theirs, [region] if region else (), align=False, tolerance=tolerance, start=start)
    numbers = found.as_dict()
    for name, value in wanted.items():
        if name in numbers:
            assert numbers[name] == pytest.approx(value), name
    for name, gaps in (("to_reference", wanted["to"]), ("from_reference", wanted["from"])):
        told = numbers["distance_m"][name]
        assert told["mean"] == pytest.approx(np.mean(gaps))
        assert told["median"] == pytest.approx(np.median(gaps))
        assert told["p95"] == pytest.approx(np.percentile(gaps, 95))
        assert told["max"] == pytest.approx(gaps[-1])


def test_equation_7_by_hand():
    reference = OccupancyGrid(np.array([[100, 0, 0, -1], [100, 0, -1, 100]], np.int8), 1.0)
    ours = OccupancyGrid(np.array([[0, 0, 100, 0], [100, -1, -1, 50]], np.int8), 1.0)
    found = score_grids(ours, reference, align=False)
    assert differences(aligned_grids(ours, reference)).tolist() == [[3, 0, 2, 4], [0, 1, 0, 1]]
    errors = found.errors
    assert (errors.missed, errors.wrongly_occupied, errors.wrongly_free, errors.extra) == (2, 1, 1, 1)
    assert (errors.reference_occupied, errors.reference_free) == (3, 3)
    assert found.eq7_percent == pytest.approx(100 * 5 / 6)
    assert errors.eq7_coverage_percent == pytest.approx(100 * 3 / 6)
    assert errors.eq7_contradiction_percent == pytest.approx(100 * 2 / 6)
    assert errors.known_error_percent == pytest.approx(100 * 2 / 4)


@pytest.mark.parametrize("seed", range(5))
def test_coverage_and_contradiction_add_up_to_equation_7(seed):
    theirs, ours = random_floor(seed), random_floor(seed + 50)
    errors = score_grids(ours, theirs, [REGION] if seed % 2 else (), align=False).errors
    both = errors.eq7_coverage_percent + errors.eq7_contradiction_percent
    assert both == pytest.approx(errors.eq7_percent, rel=1e-12)


def test_what_was_never_seen_is_coverage_and_what_is_opposite_is_contradiction():
    reference = room()
    unseen = np.where(np.arange(reference.cells.shape[1]) < 30, -1, reference.cells).astype(np.int8)
    opposite = np.where(reference.cells == WALL, FREE, np.where(reference.cells == FREE, WALL, -1)).astype(np.int8)
    for cells, coverage, contradiction in ((unseen, 25, 0), (opposite, 0, 100)):
        errors = score_grids(changed(reference, cells), reference, align=False).errors
        assert errors.eq7_coverage_percent == pytest.approx(coverage)
        assert errors.eq7_contradiction_percent == pytest.approx(contradiction)


def test_an_excluded_region_counts_as_right_and_stays_in_the_number_below():
    reference, ours = room(), room()
    cells = ours.cells.copy()
    cells[:, :44] = -1  # the part left of the inner wall was never seen
    ours = changed(ours, cells)
    plain = score_grids(ours, reference, align=False)
    found = score_grids(ours, reference, [(0, 0, 2.2, 4)], align=False)
    known = found.errors.reference_occupied + found.errors.reference_free
    assert plain.eq7_percent == pytest.approx(100 * 44 * 80 / known)
    assert found.eq7_percent == 0
    assert found.errors.forgiven == 44 * 80 == plain.errors.missed
    assert found.errors.excluded == 44 * 80
    assert known == 80 * 120
    cells[40, 60] = WALL
    one = score_grids(changed(ours, cells), reference, [(0, 0, 2.2, 4)], align=False)
    assert one.eq7_percent == pytest.approx(100 / known)
    assert one.errors.eq7_outside_percent == pytest.approx(100 / (known - 44 * 80))
    assert one.coverage == 1


def test_a_wall_one_cell_aside_is_an_error_for_equation_7_alone():
    """Thin walls on free floor: all of them stand one cell aside, and the map is a good one."""
    cells = np.full((60, 60), FREE, np.int8)
    cells[10:50, 10:50:8] = WALL
    reference, aside = OccupancyGrid(cells, 0.05), OccupancyGrid(np.roll(cells, 1, axis=1), 0.05)
    absent = changed(reference, np.full_like(cells, FREE))
    shifted, lost = (score_grids(one, reference, align=False) for one in (aside, absent))
    walls = (cells == WALL).sum()
    assert shifted.eq7_percent == pytest.approx(100 * 2 * walls / cells.size)
    assert shifted.eq7_percent == 2 * lost.eq7_percent, "worse than no wall at all"
    assert shifted.occupied.iou == 0
    assert shifted.occupied.iou_tolerant == 1
    assert shifted.to_reference.max == pytest.approx(0.05)
    assert shifted.from_reference.max == pytest.approx(0.05)
    assert lost.occupied.iou_tolerant == 0
    assert lost.to_reference.mean is None


def test_a_perfect_map_is_perfect_and_all_of_it_is_json():
    found = score_grids(room(), room(), align=False)
    numbers = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    contract = ("tp", "fp", "tn", "fn", "accuracy", "precision", "recall", "specificity", "npv", "error", "correlation")
    assert set(contract) <= set(numbers)
    assert (numbers["eq7_percent"], numbers["fp"], numbers["fn"], numbers["error"]) == (0, 0, 0, 0)
    perfect = ("precision", "recall", "occupied_iou", "occupied_iou_tolerant", "free_iou", "coverage", "correlation")
    assert [numbers[name] for name in perfect] == pytest.approx([1] * 7)
    assert numbers["distance_m"]["to_reference"]["max"] == 0
    blind = score_grids(changed(room(), np.full_like(room().cells, -1)), room(), align=False).as_dict()
    assert json.dumps(blind, allow_nan=False)
    assert (blind["eq7_percent"], blind["coverage"], blind["error"]) == (100, 0, None)


@pytest.mark.parametrize("turns", range(4))
def test_maps_of_other_frames_and_quarter_turns_lie_on_each_other_exactly(turns):
    reference = random_floor(5, shape=(8, 11), side=0.25, origin=(2.0, -1.0, 0.3))
    high, wide = 8 * 0.25, 11 * 0.25
    corner = [(0, 0, 0), (wide, 0, np.pi / 2), (wide, high, np.pi), (0, high, -np.pi / 2)][turns]
    pose = se2.compose(reference.origin, corner)
    ours = OccupancyGrid(np.ascontiguousarray(np.rot90(reference.cells, turns)), 0.25, tuple(pose))
    laid = aligned_grids(ours, reference)
    assert (differences(laid) == Difference.SAME).all()
    assert (laid.reference.states == State.OCCUPIED).any()
    moved = aligned_grids(changed(ours, np.roll(ours.cells, 1, axis=0)), reference)
    assert (differences(moved) != Difference.SAME).any()


def test_no_obstacle_is_lost_when_cells_become_larger():
    fine = np.full((120, 160), FREE, np.int8)
    single = [(5, 9), (33, 70), (64, 64), (119, 159), (0, 0), (80, 3)]
    for row, column in single:
        fine[row, column] = WALL
    ours = OccupancyGrid(fine, 0.02)
    coarse = OccupancyGrid(np.full((12, 16), FREE, np.int8), 0.2)
    laid = aligned_grids(ours, coarse)
    found = {tuple(map(int, at)) for at in np.argwhere(laid.map.states == State.OCCUPIED)}
    assert found == {(row // 10, column // 10) for row, column in single}


@pytest.mark.parametrize("yaw", [0.2, 0.8, -1.3])
def test_no_obstacle_is_lost_in_a_turn_and_walls_do_not_grow(yaw):
    random = np.random.default_rng(3)
    cells = np.full((60, 60), FREE, np.int8)
    cells[tuple(random.integers(0, 60, (2, 80)))] = WALL
    cells[30] = WALL
    ours = OccupancyGrid(cells, 0.1)
    reference = OccupancyGrid(np.full((10, 10), FREE, np.int8), 0.1)
    laid = aligned_grids(ours, reference, (0.5, -0.2, yaw))
    walls = np.argwhere(cells == WALL)
    where = laid.map.indices(se2.transform((0.5, -0.2, yaw), ours.centres(*walls.T)))
    near = [laid.map.states[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2] for r, c in where]
    assert all((patch == State.OCCUPIED).any() for patch in near)
    count = int((laid.map.states == State.OCCUPIED).sum())
    assert len(walls) <= count * 1.05
    assert count <= 1.15 * len(walls)


def test_finer_cells_take_the_value_of_the_cell_they_lie_in():
    coarse = random_floor(4, shape=(3, 4), side=0.4)
    fine = OccupancyGrid(np.zeros((12, 16), np.int8), 0.1)
    assert (aligned_grids(coarse, fine).map.cells == np.kron(coarse.cells, np.ones((4, 4), int))).all()


def test_excluded_regions_are_in_the_frame_of_a_turned_map():
    reference = random_floor(1, shape=(20, 30), side=0.1, origin=(1.0, 2.0, 0.5))
    laid = aligned_grids(reference, reference, exclude=[(1.0, 2.5, 2.0, 3.0)])
    rows, columns = np.divmod(np.arange(laid.excluded.size), laid.excluded.shape[1])
    x, y = laid.reference.centres(rows, columns).T
    assert (laid.excluded.ravel() == ((x >= 1) & (x <= 2) & (y >= 2.5) & (y <= 3))).all()
    assert laid.excluded.any()


def test_the_difference_image_is_the_number_above():
    theirs, ours = random_floor(1), random_floor(2)
    laid = aligned_grids(ours, theirs, exclude=[REGION])
    found = score_grids(ours, theirs, [REGION], align=False)
    number = found.errors.reference_free + found.errors.reference_occupied
    assert 100 * wrong(differences(laid)).sum() / number == pytest.approx(found.eq7_percent)


@pytest.mark.parametrize(
    ("ours", "reference", "options", "said"),
    [
        (room(), changed(room(), np.full((80, 120), -1)), {}, "no free and no occupied cell"),
        (room(), OccupancyGrid(np.full((9, 9), 50, np.int8), 0.05), {}, "no free and no occupied cell"),
        (room(origin=(9e4, 0, 0)), room(), {}, "too far apart"),
        (room(), room(), {"exclude": [(0, 0, 1)]}, "give X0,Y0,X1,Y1"),
        (room(), room(), {"exclude": [(0, 0, 1, np.nan)]}, "give X0,Y0,X1,Y1"),
        (room(), room(), {"tolerance": -1}, "0 to 1000"),
    ],
)
def test_mistakes_are_one_line(ours, reference, options, said):
    with pytest.raises(StereovoxError, match=said):
        score_grids(ours, reference, **{"align": False, **options})
