# SPDX-License-Identifier: Apache-2.0
"""The table of decisions against a reference that goes from cell to cell, and by hand."""

from dataclasses import asdict

import made_decisions
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stereovox as sv
from stereovox.evaluate.decisions import decide, decisions
from stereovox.evaluate.truth import indices
from stereovox.evaluate.truth_cells import TruthCells

LEVELS = {"free": -2.0, "tentative": 0.2, "occupied": 2.0}
CONFIG = sv.load_config(
    voxel_size=0.5, **{"map.prior": 0.5, "map.log_odds_min": -2.5, "map.free_below": 0.3, "map.occupied_above": 0.7}
)
CELL = st.tuples(*[st.integers(-9, -5) | st.integers(6, 9)] * 3)  # across the borders of blocks, below zero too
OURS = st.dictionaries(CELL, st.sampled_from(list(LEVELS)), max_size=60)
TRUTH = st.dictionaries(CELL, st.booleans(), min_size=1, max_size=60)


def made(cells, config=CONFIG):
    return sv.VoxelMap.from_cells(config, list(cells) or np.empty((0, 3)), list(cells.values()))


def made_map(states, config=CONFIG):
    return made({cell: LEVELS[state] for cell, state in states.items()}, config)


def made_truth(truth):
    return made({cell: 3.0 if surface else -2.0 for cell, surface in truth.items()})


@settings(max_examples=60, deadline=None)
@given(OURS, TRUTH, st.integers(0, 3))
def test_all_rates_agree_with_the_slow_reference(ours, truth, tolerance):
    found = decisions(made_map(ours), TruthCells(made_truth(truth), tolerance))
    assert asdict(found) == pytest.approx(made_decisions.decisions(ours, truth, tolerance))


@settings(max_examples=30, deadline=None)
@given(OURS, TRUTH, st.integers(0, 2), st.sets(CELL))
def test_a_part_of_the_cells_alone(ours, truth, tolerance, chosen):
    cells = TruthCells(made_truth(truth), tolerance)
    mask = np.array([tuple(cell) in chosen for cell in indices(cells.cells).tolist()])
    found = decide(cells.read(made_map(ours)), cells, mask)
    assert asdict(found) == pytest.approx(made_decisions.decisions(ours, truth, tolerance, chosen))


def test_a_row_of_cells_by_hand():
    truth = dict.fromkeys([(x, 0, 0) for x in range(12)], False) | dict.fromkeys([(1, 0, 0), (5, 0, 0)], True)
    truth |= dict.fromkeys([(8, 0, 0), (11, 0, 0)], True)
    names = ["free", "free", "tentative", "free", "free", "free", "free", "occupied", "occupied", "occupied"]
    found = decisions(made_map({(x, 0, 0): name for x, name in enumerate(names)}), made_truth(truth))
    # surfaces: 1 free next to a tentative cell, 5 free with nothing next to it, 8 occupied, 11 never seen
    assert (found.surface, found.known, found.air, found.occupied, found.free) == (4, 3, 8, 3, 6)
    assert (found.surface_free, found.surface_free_alone, found.surface_unknown) == (0.5, 0.25, 0.25)
    assert (found.known_free, found.known_free_alone) == pytest.approx((2 / 3, 1 / 3))
    assert (found.surface_near, found.surface_occupied_near) == (0.5, 0.25)
    assert (found.occupied_hit, found.occupied_near, found.occupied_air) == pytest.approx((1 / 3, 1, 2 / 3))
    assert (found.air_occupied, found.air_tentative, found.air_free, found.air_unknown) == (0.25, 0.125, 0.5, 0.125)
    assert found.free_wrong == pytest.approx(1 / 3)


def test_the_map_decides_by_its_own_rules():
    truth = made_truth({(0, 0, 0): True, (1, 0, 0): True})
    levels = {(0, 0, 0): 0.5, (1, 0, 0): -0.5}
    assert decisions(made(levels), truth).surface_tentative == 1
    bold = sv.load_config(CONFIG, **{"map.occupied_above": 0.6, "map.free_below": 0.4})
    found = decisions(made(levels, bold), truth)
    assert (found.surface_occupied, found.surface_free) == (0.5, 0.5)
    byte = sv.load_config(bold, **{"map.cell": "uint8"})
    assert decisions(made(levels, byte), truth) == found
