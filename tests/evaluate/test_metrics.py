# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.evaluate.metrics import Confusion, by_part, compare, compare_map, find_piece, find_pieces, longest_gap
from stereovox.evaluate.truth import Piece, Truth, keys
from stereovox.maps import VoxelMap

ROW = [[x, 0, 0] for x in range(10)]


def test_confusion_and_its_rates_by_hand():
    predicted = np.array([1, 1, 1, 0, 0, 0, 0, 0, 0, 0], bool)
    actual = np.array([1, 1, 0, 1, 0, 0, 0, 0, 0, 0], bool)
    counted = Confusion.count(predicted, actual)
    assert counted == Confusion(tp=2, fp=1, tn=6, fn=1)
    assert counted.rates() == pytest.approx(
        {"accuracy": 0.8, "precision": 2 / 3, "recall": 2 / 3, "specificity": 6 / 7, "npv": 6 / 7}
    )


def test_rates_of_nothing_are_none():
    assert set(Confusion(0, 0, 0, 0).rates().values()) == {None}


def test_compare_with_tolerance_and_excluded_cells_by_hand():
    occupied = np.array([0, 1, 1, 0, 0, 0, 1, 0, 0, 1], bool)
    surface, inside = keys([[1, 0, 0], [3, 0, 0], [8, 0, 0], [50, 0, 0]]), keys([[9, 0, 0]])
    result = compare(keys(ROW), occupied, surface, inside)
    # occupied 1 2 6 (9 is excluded); surface among the known: 1 3 8
    assert (result["tp"], result["fp"], result["tn"], result["fn"]) == (1, 2, 4, 2)
    assert result["excluded"] == 1
    assert result["tolerance_precision"] == pytest.approx(2 / 3)  # 1 and 2, not 6
    assert result["tolerance_recall"] == pytest.approx(1.0)  # 1; 3 by 2; 8 by 9, which counts as evidence
    assert compare(keys(ROW), occupied, surface, inside, tolerance=2)["tolerance_precision"] == pytest.approx(1.0)


def test_longest_gap_counts_whole_empty_steps():
    along = np.array([0.5, 1.5, 1.6, 2.5, 3.5, 4.5, 9.5, 10.5])
    found = np.array([1, 0, 0, 0, 1, 0, 0, 0], bool)
    assert longest_gap(along, found) == 2
    assert longest_gap(along, ~found) == 1
    assert longest_gap(np.zeros(0), np.zeros(0, bool)) == 0


def _pole(name="pole"):
    return Piece("poles", name, np.array([0.0, 0, 1]), keys([[0, 0, z] for z in range(40)]))


def _standing(heights):
    return keys([[0, 0, z] for z in heights])


def test_a_whole_pole_is_found():
    found = find_piece(_pole(), np.ones(40, bool), _standing(range(40)), 0.05)
    assert (found.seen, found.exact, found.near, found.longest_gap, found.missing) == (40, 40, 40, 0, False)


def test_a_pole_with_a_hole_is_missing():
    # cells 10 to 16 are empty; 11 to 15 have no occupied cell within one: 5 steps of 5 cm
    found = find_piece(_pole(), np.ones(40, bool), _standing([*range(10), *range(17, 40)]), 0.05)
    assert (found.exact, found.near) == (33, 35)
    assert found.longest_gap == pytest.approx(0.25)
    assert found.missing


def test_a_small_hole_is_reported_but_not_missing():
    found = find_piece(_pole(), np.ones(40, bool), _standing([*range(10), *range(14, 40)]), 0.05)
    assert found.longest_gap == pytest.approx(0.10)
    assert not found.missing


def test_scattered_holes_make_a_pole_missing_too():
    found = find_piece(_pole(), np.ones(40, bool), _standing(range(1, 40, 6)), 0.05)
    assert found.missing


def test_cells_nobody_saw_do_not_count():
    seen = np.arange(40) < 20
    assert not find_piece(_pole(), seen, _standing(range(20)), 0.05).missing
    nobody = find_piece(_pole(), np.zeros(40, bool), _standing([]), 0.05)
    assert (nobody.seen, nobody.missing) == (0, False)


def test_map_against_truth():
    config = load_config("default", voxel_size=0.05, **{"map.prior": 0.5})
    cells = [*([0, 0, z] for z in range(40)), [5, 0, 0], [6, 0, 0], [7, 0, 0]]
    voxel_map = VoxelMap.from_cells(config, cells, [3.0] * 20 + [-1.0] * 20 + [-1.0, 0.1, 3.0])
    pole = _pole()
    truth = Truth(0.05, pole.cells, keys([[7, 0, 0]]), (pole,))
    result = compare_map(voxel_map, truth)
    assert (result["tp"], result["fp"], result["tn"], result["fn"]) == (20, 0, 2, 20)
    assert (result["free_in_solid"], result["excluded"]) == (20, 1)
    found = find_pieces(voxel_map, truth, np.full(40, 20))
    assert [(piece.near, piece.missing) for piece in found] == [(21, True)]
    assert by_part(found)["poles"] == {
        "pieces": 1,
        "missing": ["pole"],
        "seen_cells": 40,
        "recall": 0.5,
        "tolerance_recall": 21 / 40,
        "longest_gap": pytest.approx(0.95),
    }
    assert by_part(find_pieces(voxel_map, truth, np.full(40, 19)))["poles"]["pieces"] == 0
