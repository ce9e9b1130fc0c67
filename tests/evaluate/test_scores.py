# SPDX-License-Identifier: Apache-2.0
"""All measures against a reference that goes from cell to cell, and against numbers worked out by hand."""

import json

import made_decisions
import made_scores
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.evaluate.decisions import Outcome, outcomes
from stereovox.evaluate.scores import score
from stereovox.evaluate.truth import indices, keys
from stereovox.evaluate.truth_cells import CellReader, Neighbourhood, TruthCells
from stereovox.frame import Viewpoint
from stereovox.maps import make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.rolling import RollingMap
from stereovox_lab.papers.valenti.judge import ScoreSeries

SIZE = 0.5
MEANING = {
    "map.prior": 0.5,
    "map.log_odds_min": -2.5,
    "map.log_odds_max": 3.5,
    "map.free_below": 0.3,
    "map.occupied_above": 0.7,
}
CONFIG = sv.load_config(voxel_size=SIZE, **MEANING)
WIDE = sv.load_config(CONFIG, **{"map.log_odds_min": -30.0, "map.log_odds_max": 30.0})
CELL = st.tuples(*[st.integers(-9, -5) | st.integers(6, 9)] * 3)  # across the borders of blocks, below zero too
LEVELS = st.integers(-2000, 3500).map(lambda n: (n or 1) / 1000)
OURS = st.dictionaries(CELL, LEVELS, max_size=60)
TRUTH = st.dictionaries(CELL, st.booleans(), min_size=1, max_size=60)


def made(cells, config=CONFIG):
    return sv.VoxelMap.from_cells(config, list(cells) or np.empty((0, 3)), list(cells.values()))


def made_truth(truth, config=CONFIG):
    return made({cell: 3.0 if surface else -2.0 for cell, surface in truth.items()}, config)


def probabilities(ours):
    return [(cell, made_scores.probability(log_odds)) for cell, log_odds in ours.items()]


def flat(numbers, prefix=""):
    """The numbers of a nested dict; None becomes NaN, which pytest.approx can compare."""
    found = {}
    for name, value in numbers.items():
        if isinstance(value, dict):
            found.update(flat(value, f"{name}."))
        else:
            found[prefix + name] = np.nan if value is None else value
    return found


@settings(max_examples=60, deadline=None)
@given(OURS, TRUTH, st.integers(0, 3), st.sampled_from([0.2, 0.5, 0.7, 0.93]), st.sampled_from([5, 10]))
def test_all_measures_agree_with_the_slow_reference(ours, truth, tolerance, threshold, bins):
    found = score(made(ours), made_truth(truth), threshold, tolerance, bins=bins).as_dict()
    states = {cell: "occupied" if p > 0.7 else "free" if p < 0.3 else "tentative" for cell, p in probabilities(ours)}
    wanted = made_scores.scores(ours, truth, threshold, tolerance, bins)
    wanted["decisions"] = made_decisions.decisions(states, truth, tolerance)
    del found["decisions"]["parts"]  # tests/evaluate/test_decision_parts.py
    assert flat(found) == pytest.approx(flat(wanted), abs=1e-6, nan_ok=True)


@settings(max_examples=25, deadline=None)
@given(OURS, TRUTH, st.integers(0, 2), st.lists(st.sampled_from([0.05, 0.31, 0.5, 0.7, 0.9]), min_size=1))
def test_the_curve_holds_what_each_threshold_alone_gives(ours, truth, tolerance, thresholds):
    curve = score(made(ours), made_truth(truth), 0.7, tolerance, thresholds=thresholds).curve
    for i, threshold in enumerate(thresholds):
        wanted = made_scores.tally(list(truth), ours, truth, threshold, tolerance)
        for name in ("precision", "recall", "tolerance_precision", "tolerance_recall"):
            value = np.nan if wanted[name] is None else wanted[name]
            assert getattr(curve, name)[i] == pytest.approx(value, nan_ok=True), (name, threshold)


def test_a_row_of_cells_by_hand():
    truth = dict.fromkeys([(x, 0, 0) for x in range(8)], False) | {(1, 0, 0): True, (5, 0, 0): True, (7, 0, 0): True}
    ours = {(0, 0, 0): -1.0, (1, 0, 0): 2.0, (2, 0, 0): 1.0, (4, 0, 0): 1.5, (5, 0, 0): -1.0, (3, 0, 0): 2.0}
    ours[(40, 0, 0)] = 3.0  # outside the truth: not judged
    found = score(made(ours), made_truth(truth))
    # called occupied: 1 2 3 4; true: 1 5 7; never observed: 6 7
    assert (found.tp, found.fp, found.tn, found.fn) == (1, 3, 2, 2)
    assert (found.observed.tp, found.observed.fp, found.observed.tn, found.observed.fn) == (1, 3, 1, 1)
    assert (found.accuracy, found.precision, found.recall) == pytest.approx((3 / 8, 1 / 4, 1 / 3))
    assert (found.specificity, found.npv, found.coverage) == pytest.approx((2 / 5, 1 / 2, 6 / 8))
    assert found.tolerance_precision == pytest.approx(3 / 4)  # 1; 2 next to 1; 4 next to 5; not 3
    assert found.tolerance_recall == pytest.approx(2 / 3)  # 1; 5 by 4; not 7
    assert found.observed.tolerance_recall == pytest.approx(1)
    assert score(made(ours), made_truth(truth), tolerance=3).tolerance_recall == pytest.approx(1)  # 7 by 4


def test_a_perfect_and_a_silent_map():
    truth = {(x, y, 0): (x + y) % 3 == 0 for x in range(6) for y in range(6)}
    best = score(made({cell: 30.0 if surface else -30.0 for cell, surface in truth.items()}, WIDE), made_truth(truth))
    rates = (best.accuracy, best.precision, best.recall, best.specificity, best.npv, best.correlation, best.auc)
    assert rates == pytest.approx([1] * 7)
    assert (best.average_precision, best.iou, best.f_score_1, best.f_score_2) == pytest.approx((1, 1, 1, 1))
    assert (best.error, best.ece, best.ece_likely, best.ece_equal_mass) == pytest.approx((0, 0, 0, 0), abs=1e-9)
    nothing = score(sv.VoxelMap(CONFIG), made_truth(truth))
    assert (nothing.tp, nothing.fp, nothing.recall, nothing.coverage) == (0, 0, 0, 0)
    assert (nothing.precision, nothing.error, nothing.ece, nothing.correlation) == (None, None, None, None)
    assert (nothing.f_score_1, nothing.ece_likely, nothing.ece_equal_mass) == (0, None, None)
    assert nothing.average_precision == pytest.approx(12 / 36)
    assert (nothing.auc, nothing.observed_auc, nothing.observed.accuracy) == (pytest.approx(0.5), None, None)


def test_correlation_is_given_with_unobserved_cells_at_one_half_and_as_free():
    truth = {(x, 0, 0): x < 2 for x in range(6)}
    found = score(made({(0, 0, 0): 2.0, (2, 0, 0): -2.0}), made_truth(truth))
    high, low, actual = 1 / (1 + np.exp(-2.0)), 1 / (1 + np.exp(2.0)), [1, 1, 0, 0, 0, 0]
    at_half, as_free = ([high, other, low, other, other, other] for other in (0.5, 0.0))
    assert found.correlation == pytest.approx(np.corrcoef(at_half, actual)[0, 1], abs=1e-3)
    assert found.correlation_free == pytest.approx(np.corrcoef(as_free, actual)[0, 1], abs=1e-3)
    assert found.observed.correlation_free == found.observed.correlation


def test_a_tentative_cell_of_the_truth_is_not_judged():
    found = score(made({(0, 0, 0): 2.0, (1, 0, 0): 2.0}), made({(0, 0, 0): 0.1, (1, 0, 0): 3.0}))
    assert (found.cells, found.tp, found.fp) == (1, 1, 0)


@pytest.mark.parametrize("cell", ["int16", "uint8"])
def test_above_the_threshold_means_what_the_map_itself_calls_occupied(cell):
    config = sv.load_config(CONFIG, **{"map.cell": cell})
    levels = np.log(0.7 / 0.3) + np.arange(-5, 6) / 60
    voxel_map = made({(x, 0, 0): level for x, level in enumerate(levels)}, config)
    truth = made_truth(dict.fromkeys([(x, 0, 0) for x in range(len(levels))], True))
    assert score(voxel_map, truth, 0.7).tp == len(voxel_map.occupied())


def test_the_numbers_are_json_and_hold_the_contract():
    found = score(sv.VoxelMap(CONFIG), made_truth({(0, 0, 0): False})).as_dict()
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    contract = "tp fp tn fn accuracy precision recall specificity npv error correlation"
    more = "observed tolerance_precision tolerance_recall ece brier auc threshold tolerance_cells cells"
    assert {*contract.split(), *more.split()} <= set(found)
    assert {*contract.split(), "auc"} - {"error"} <= set(found["observed"])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"threshold": 1.0}, "threshold 1.0"),
        ({"threshold": float("nan")}, "threshold nan"),
        ({"tolerance": -1}, "tolerance -1"),
        ({"tolerance": 21}, "tolerance 21"),
        ({"path": [[0, 0]]}, "not a list of points"),
        ({"path": np.empty((0, 3))}, "not a list of points"),
    ],
)
def test_numbers_out_of_range_are_named(settings, said):
    with pytest.raises(StereovoxError, match=said):
        score(made({(0, 0, 0): 1.0}), made_truth({(0, 0, 0): True}), **settings)


def test_maps_that_cannot_be_compared():
    other = made({(0, 0, 0): 1.0}, sv.load_config(voxel_size=0.4))
    with pytest.raises(StereovoxError, match=r"0\.4 m .* 0\.5 m"):
        score(other, made_truth({(0, 0, 0): True}))
    with pytest.raises(StereovoxError, match="holds no occupied"):
        score(other, sv.VoxelMap(CONFIG))


@settings(max_examples=30, deadline=None)
@given(st.sets(CELL, min_size=1, max_size=20), st.integers(0, 3), st.randoms(use_true_random=False))
def test_the_best_neighbour_is_the_best_of_all(cells, tolerance, random):
    one = Neighbourhood(keys(sorted(cells)), tolerance)
    wanted = {near for cell in cells for near in made_scores.neighbours(cell, tolerance)}
    assert [tuple(cell) for cell in indices(one.around).tolist()] == sorted(wanted)
    values = {cell: random.random() for cell in sorted(wanted)}
    best = [max(values[near] for near in made_scores.neighbours(cell, tolerance)) for cell in sorted(cells)]
    assert one.highest(np.array(list(values.values()))).tolist() == best


def test_cells_are_read_from_a_window_with_tiles_on_disk_as_well(tmp_path):
    config = sv.load_config(CONFIG, **{"window.size": [20, 20, 20], "window.outside": "keep"})
    rolling = make_map(config)
    random, camera = np.random.default_rng(2), sv.PinholeCamera(8, 6, 5.0, 5.0, 3.5, 2.5)
    for x in (0.0, 60.0):  # far enough for what was near the first place to go to disk
        T = np.eye(4)
        T[0, 3] = x
        rolling.storage.set_viewpoint(Viewpoint(camera, T))
        block = np.array([[int(x / SIZE) >> 3, 0, 0]], np.int32)
        values = random.integers(-900, 900, (1, 512)).astype(np.int16)
        rolling.add(Evidence(block, values, np.empty((0, 3), np.int32), 0))
    assert isinstance(rolling, RollingMap)
    assert rolling.storage.tile_store is not None
    assert len(rolling.storage.tile_store.tiles()) > 0
    cells, log_odds = rolling.cells()
    assert np.array_equal(CellReader(keys(cells)).log_odds(rolling), log_odds)
    rolling.save(tmp_path / "rolling.svox")
    assert np.array_equal(CellReader(keys(cells)).log_odds(sv.load_map(tmp_path / "rolling.svox")), log_odds)
    assert len(cells) > 1000
    assert not CellReader(keys(cells)).log_odds(sv.VoxelMap(CONFIG)).any()
    rolling.close()


def test_a_series_remembers_what_score_says_after_each_frame():
    truth = made_truth({(x, 0, 0): x % 3 == 0 for x in range(9)})
    series = ScoreSeries(TruthCells(truth), 0.6)
    maps = [sv.VoxelMap(CONFIG), made({(3, 0, 0): 2.0, (4, 0, 0): -1.0}), made({(x, 0, 0): 0.6 for x in range(9)})]
    for number, one in zip((4, 8, 12), maps, strict=True):
        series.add(number, one)
    arrays = series.arrays()
    assert arrays["frame"].tolist() == [4, 8, 12]
    for i, one in enumerate(maps):
        whole = flat(score(one, truth, 0.6).as_dict())
        for name, values in arrays.items():
            if name != "frame":
                key = name.replace("observed_", "observed.")
                assert values[i] == pytest.approx(whole[key], nan_ok=True), name


def test_what_came_of_each_cell():
    truth = {(0, 0, 0): True, (1, 0, 0): False, (4, 0, 0): False, (7, 0, 0): True, (10, 0, 0): True, (9, 0, 0): False}
    ours = {(0, 0, 0): 2.0, (1, 0, 0): 2.0, (4, 0, 0): 2.0, (7, 0, 0): -1.0}
    cells = TruthCells(made_truth(truth))
    shown = outcomes(cells.read(made(ours)), cells, 0.7)
    found = {tuple(cell): Outcome(o) for cell, o in zip(shown.cells.tolist(), shown.outcome, strict=True)}
    assert found == {
        (0, 0, 0): Outcome.HIT,
        (1, 0, 0): Outcome.NEAR,
        (4, 0, 0): Outcome.FALSE,
        (7, 0, 0): Outcome.MISSED,
        (10, 0, 0): Outcome.UNSEEN,
    }
    shown = outcomes(cells.read(made({(9, 0, 0): 2.0})), cells, 0.7)
    assert Outcome.FOUND in shown.outcome
    assert Outcome.UNSEEN in shown.outcome


def test_maps_of_unequal_steps_are_compared_in_cubes():
    from stereovox.config import load_config
    from stereovox.maps import VoxelMap

    flat = load_config(steps=(0.2, 0.2, 0.1))
    ours = VoxelMap.from_cells(flat, [[0, 0, 0], [1, 0, 0], [0, 0, 1]], [3, 3, -3])
    cubes = load_config(voxel_size=0.1)
    one = [[x, y, 0] for x in (0, 1) for y in (0, 1)]
    truth = VoxelMap.from_cells(cubes, one + [[x, y, 1] for x, y, _ in one], [3] * 4 + [-3] * 4)
    found = score(ours, truth)
    assert (found.tp, found.fp, found.tn, found.fn) == (4, 0, 4, 0)
