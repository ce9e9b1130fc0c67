# SPDX-License-Identifier: Apache-2.0
"""Branch and bound finds what trying everything finds; ambiguous places are not taken."""

import numpy as np
import pytest
from made_drives import box, ranges

from stereovox.config import load_config
from stereovox.geometry import se2
from stereovox.localize.slam import _bound
from stereovox.localize.slam.line_map import Cloud
from stereovox.localize.slam.loops import ClosureSearch

PAD = 64


def exhaustive(places, side, field):
    """Score of every turn and shift: (turns, 2 side + 1, 2 side + 1)."""
    rows, columns = field.shape
    scores = np.zeros((len(places), 2 * side + 1, 2 * side + 1))
    for k, turn in enumerate(places):
        for a in range(-side, side + 1):
            for b in range(-side, side + 1):
                r, c = turn[:, 0] + a, turn[:, 1] + b
                inside = (r >= 0) & (c >= 0) & (r < rows) & (c < columns)
                scores[k, a + side, b + side] = field[r[inside], c[inside]].sum()
    return scores


def climbed(places, side, field, least=0.0, taken=(0, 0, 0), apart=-1, levels=5):
    pyramid = np.empty((levels, field.shape[0] + PAD, field.shape[1] + PAD), np.float32)
    _bound.coarsen(field, PAD, pyramid)
    best = np.full(3, -99, np.int64)
    top = _bound.climb(places, side, pyramid, PAD, np.float32(least), np.array(taken, np.int64), apart, best)
    return float(top), best


def scene(seed):
    rng = np.random.default_rng(seed)
    field = np.where(rng.random((50, 70)) < 0.1, rng.random((50, 70)), 0).astype(np.float32)
    places = rng.integers(-20, 80, (4, 25, 2)).astype(np.int32)  # some outside of the field, on each side
    return field, places


def test_windows_hold_the_maxima_of_their_cells():
    field, _ = scene(0)
    pyramid = np.empty((4, 50 + PAD, 70 + PAD), np.float32)
    _bound.coarsen(field, PAD, pyramid)
    padded = np.pad(field, ((PAD, 8), (PAD, 8)))
    for h in range(4):
        windows = np.lib.stride_tricks.sliding_window_view(padded, (2**h, 2**h)).max(axis=(2, 3))
        assert np.array_equal(pyramid[h], windows[: 50 + PAD, : 70 + PAD])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("side", [3, 16, 21])
def test_branch_and_bound_is_exhaustive_search(seed, side):
    field, places = scene(seed)
    scores = exhaustive(places, side, field)
    top, (k, a, b) = climbed(places, side, field)
    assert top == pytest.approx(scores.max(), rel=1e-5)
    assert scores[k, a + side, b + side] == pytest.approx(scores.max(), rel=1e-5)


def test_nothing_below_the_least_score_is_found():
    field, places = scene(1)
    top = exhaustive(places, 9, field).max()
    assert climbed(places, 9, field, least=top * 1.001)[1].tolist() == [-99] * 3
    assert climbed(places, 9, field, least=top * 0.999)[1].tolist() != [-99] * 3


@pytest.mark.parametrize("seed", range(3))
def test_the_second_best_place_is_found_away_from_the_best(seed):
    field, places = scene(seed)
    scores = exhaustive(places, 12, field)
    _, best = climbed(places, 12, field)
    shifts = np.arange(-12, 13)
    near = (np.abs(shifts - best[1]) <= 3)[:, None] & (np.abs(shifts - best[2]) <= 3)
    top, rival = climbed(places, 12, field, taken=best, apart=3)
    assert top == pytest.approx(scores[:, ~near].max(), rel=1e-5)
    assert max(abs(rival[1] - best[1]), abs(rival[2] - best[2])) > 3


def seen(walls, pose):
    angles = np.radians(np.arange(0, 360, 0.7))
    found = ranges(walls, np.asarray(pose, float), angles, 12.0)
    ahead = np.column_stack([np.cos(angles), np.sin(angles)])
    hit = np.isfinite(found)
    return Cloud((found[hit, None] * ahead[hit]).astype(np.float32), (-ahead[hit]).astype(np.float32))


def corridor(*things):
    ends = np.array([[-40, -1, 40, -1], [-40, 1.5, 40, 1.5]], float)
    niches = [box(2.0 * i, 1.1, 2.0 * i + 0.4, 1.5) for i in range(-15, 15)]
    return np.vstack([ends, *niches, *(box(*thing) for thing in things)])


def test_a_place_that_looks_like_its_neighbour_is_not_taken():
    search, there = ClosureSearch(load_config().slam), np.array([1.3, 0.2, 0.05])
    for things, clear in (([], False), ([(-0.5, -1, 0.2, -0.3), (3.0, -1, 3.2, -0.5)], True)):
        walls = corridor(*things)
        search.set_target(seen(walls, [0, 0, 0]))
        match = search.match(seen(walls, there), [0.0, 0.0, 0.0], 4.0, 0.2)
        assert (match is not None) == clear
        if match is not None:
            assert np.allclose(match.pose, there, atol=0.02)


def test_a_place_is_found_from_far_off():
    walls = np.vstack([box(-5, -3, 6, 4), box(1, 1, 2, 1.5), box(-3, -3, -2.5, 0)])
    search, there = ClosureSearch(load_config().slam), np.array([2.0, -1.0, 0.4])
    search.set_target(seen(walls, [0, 0, 0]))
    guess = se2.compose([1.5, -1.2, -0.3], there)
    match = search.match(seen(walls, there), guess, 3.5, 0.5)
    assert match is not None
    assert np.allclose(match.pose, there, atol=0.01)
    assert match.share > 0.9
    assert search.match(seen(box(-1, -1, 1.2, 1), [0, 0, 0]), guess, 1.0, 0.3) is None
