# SPDX-License-Identifier: Apache-2.0
"""Lines of loops that a map remembers: round trip, bounds, motion."""

import json

import numpy as np
import pytest

from stereovox.geometry.se3 import rotation_matrix, transform_points
from stereovox.maps.record.camera_path import MAX_LINES, Lines, LoopLines


def made(number, seed=0):
    return np.random.default_rng(seed).normal(0, 5, (number, 2, 3)).astype(np.float32).astype(float)


def test_what_is_saved_comes_back():
    lines = LoopLines.between(made(5), made(2, seed=1))
    back = LoopLines.loaded(json.loads(json.dumps(lines.saved())))
    assert back == lines
    assert back.counts() == {"closed": 5, "refused": 2}
    np.testing.assert_array_equal(back.closed.ends, made(5))
    np.testing.assert_array_equal(back.refused.ends, made(2, seed=1))
    assert LoopLines.loaded(LoopLines().saved()) == LoopLines()
    assert LoopLines.between([], []) == LoopLines()


def test_of_very_many_some_are_kept_from_the_first_to_the_last():
    ends = made(3 * MAX_LINES + 7)
    lines = Lines.between(ends)
    assert lines.number == len(ends)
    assert len(lines.ends) == MAX_LINES
    np.testing.assert_array_equal(lines.ends[[0, -1]], ends[[0, -1]])
    assert Lines.loaded(lines.saved()) == lines
    assert lines.moved(np.eye(4)) == lines


def test_they_move_with_the_map():
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0]
    there = LoopLines.between(made(5), made(1)).moved(T)
    np.testing.assert_allclose(there.closed.ends, transform_points(T, made(5)), atol=1e-5)
    np.testing.assert_allclose(there.refused.ends, transform_points(T, made(1)), atol=1e-5)


@pytest.mark.parametrize(
    "lie",
    [
        {"number": 4},
        {"number": 5.0},
        {"number": True},
        {"number": -1},
        {"number": MAX_LINES + 5},
        {"ends": 5},
        {"ends": "?"},
        {"ends": "AAAA"},
        {"ends": "AADAfw" * 40},
        {"ends": "A" * (8 * 6 * MAX_LINES + 4)},
        {"ends": Lines.between(np.full((5, 2, 3), 1e8)).saved()["ends"]},
        {"ends": Lines.between(np.full((5, 2, 3), np.nan)).saved()["ends"]},
    ],
)
def test_what_cannot_have_been_saved_is_refused(lie):
    with pytest.raises(ValueError, match=r"loops|base64|padding|buffer"):
        Lines.loaded({**Lines.between(made(5)).saved(), **lie})
