# SPDX-License-Identifier: Apache-2.0
"""The truth of some of its cells, against slow references that count those alone and look at all that is near."""

import made_decisions
import made_scores
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_cell_maps import CELL, OURS, flat, made, made_truth, probabilities

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.evaluate.scores import score
from stereovox.evaluate.thickness import Thickness, thickness
from stereovox.evaluate.truth_cells import TruthCells, level
from stereovox.maps import State

CHOSEN = st.dictionaries(CELL, st.tuples(st.booleans(), st.booleans()), min_size=1, max_size=60)
"""Cells of a truth: whether each holds a surface, and whether it is chosen."""


def made_part(marked, tolerance):
    """The part of a truth, the truth as a dict, and the chosen cells in the order of their keys."""
    whole = TruthCells(made_truth({cell: surface for cell, (surface, _) in marked.items()}), tolerance)
    order = [tuple(cell) for cell in np.floor(whole.centers() / whole.voxel_size).astype(int).tolist()]
    part = whole.part(np.array([marked[cell][1] for cell in order]))
    return part, {cell: surface for cell, (surface, _) in marked.items()}, [cell for cell in order if marked[cell][1]]


def state(p):
    return "occupied" if p > 0.7 else "free" if p < 0.3 else "tentative"


@settings(max_examples=60, deadline=None)
@given(OURS, CHOSEN.filter(lambda marked: any(chosen for _, chosen in marked.values())), st.integers(0, 3))
def test_all_measures_of_a_part_agree_with_the_slow_reference(ours, marked, tolerance):
    part, truth, cells = made_part(marked, tolerance)
    found = score(made(ours), part).as_dict()
    states = {cell: state(p) for cell, p in probabilities(ours)}
    wanted = made_scores.scores(ours, truth, 0.7, tolerance, 10, cells)
    wanted["decisions"] = made_decisions.decisions(states, truth, tolerance, set(cells))
    parts = {(one.pop("by"), one.pop("name")): one for one in found["decisions"].pop("parts")}
    assert flat(found) == pytest.approx(flat(wanted), abs=1e-6, nan_ok=True)
    surface = {cell for cell, is_surface in truth.items() if is_surface}
    kinds = {cell: made_decisions.thickness(cell, surface) for cell in cells if truth[cell]}
    assert set(parts) == {("thickness", kind) for kind in kinds.values()}
    for (_, kind), one in parts.items():
        alike = {cell for cell, its in kinds.items() if its == kind}
        assert flat(one) == pytest.approx(
            flat(made_decisions.decisions(states, truth, tolerance, alike)), abs=1e-6, nan_ok=True
        )


@settings(max_examples=60, deadline=None)
@given(OURS, CHOSEN.filter(lambda marked: any(chosen for _, chosen in marked.values())), st.integers(0, 3))
def test_what_is_read_of_a_part_is_there(ours, marked, tolerance):
    part, truth, cells = made_part(marked, tolerance)
    reading = part.read(made(ours))
    surface = [cell for cell in cells if truth[cell]]
    states = {cell: State[state(p).upper()] for cell, p in probabilities(ours)}

    def near(cell, within):
        return made_scores.neighbours(cell, within)

    assert [tuple(cell) for cell in part.surface().tolist()] == surface
    assert reading.states.tolist() == [states.get(cell, State.UNKNOWN) for cell in cells]
    assert reading.log_odds == pytest.approx([ours.get(cell, 0.0) for cell in cells], abs=1e-3)
    for within in (0, 1, 2, tolerance):
        assert part.near_within(within).tolist() == [any(truth.get(n, False) for n in near(c, within)) for c in cells]
        best = [max((ours.get(n, -np.inf) for n in near(cell, within)), default=-np.inf) for cell in surface]
        assert reading.best_within(within) == pytest.approx(best, abs=1e-3)
    assert part.near.tolist() == part.near_within(tolerance).tolist()
    for found, within in ((reading.beside, 1), (reading.reached, tolerance)):
        assert found.tolist() == [max(states.get(n, State.UNKNOWN) for n in near(cell, within)) for cell in surface]
    for threshold in (0.3, 0.7):
        assert reading.found(threshold).tolist() == [
            any(ours.get(n, -np.inf) > level(threshold) for n in near(cell, tolerance)) for cell in surface
        ]


@settings(max_examples=25, deadline=None)
@given(OURS, CHOSEN, st.integers(0, 2**32 - 1))
def test_a_part_of_a_part_is_the_part_of_both(ours, marked, seed):
    truth = TruthCells(made_truth({cell: surface for cell, (surface, _) in marked.items()}))
    first = np.random.default_rng(seed).random(len(truth.cells)) < 0.7
    both = first & (np.random.default_rng(seed + 1).random(len(truth.cells)) < 0.7)
    if not both.any():
        return
    one, other = (part.read(made(ours)) for part in (truth.part(first).part(both[first]), truth.part(both)))
    for name in ("log_odds", "states", "best", "beside", "reached"):
        assert np.array_equal(getattr(one, name), getattr(other, name))


def test_a_surface_beyond_the_rim_of_a_part_counts_as_near_and_as_what_a_cell_belongs_to():
    sheet = {(x, y, 0): True for x in range(10) for y in range(10)}
    whole = TruthCells(made_truth({**sheet, **{(x, 5, 1): False for x in range(10)}}))
    rim = np.floor(whole.centers()[:, 0] / whole.voxel_size) == 4
    part = whole.part(rim)
    assert (thickness(part.neighbourhood) == Thickness.SHEET).all()  # though ten cells in a row are chosen
    air = whole.part(~whole.occupied & rim)
    assert air.near.tolist() == [True]
    assert len(air.surface()) == 0
    found = score(made({(4, 5, 1): 2.0}), air)
    assert (found.fp, found.tolerance_precision, found.tolerance_recall) == (1, 1.0, None)
    assert len(whole.surface()) == 100  # the whole stays as it was
    assert score(sv.VoxelMap(part.map.config), part).decisions.surface_unknown == 1


def test_a_part_without_a_cell_is_refused():
    truth = TruthCells(made_truth({(0, 0, 0): True}))
    with pytest.raises(StereovoxError, match="choose a larger one"):
        truth.part(np.zeros(1, bool))
