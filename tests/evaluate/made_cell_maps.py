# SPDX-License-Identifier: Apache-2.0
"""Small maps and truths of cells by name, for what is judged against the slow references."""

import made_scores
import numpy as np
from hypothesis import strategies as st

import stereovox as sv

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
