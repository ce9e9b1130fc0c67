# SPDX-License-Identifier: Apache-2.0
"""Cells that rays cross, against a slow loop; the evidence of a scan."""

import itertools

import numpy as np
import pytest

from stereovox.errors import StereovoxError
from stereovox.integrate import points
from stereovox.integrate.points import crossed_cells, scan_evidence


def slowly_crossed(start: np.ndarray, stop: np.ndarray) -> set[tuple[int, ...]]:
    """Cells of size 1 that contain a piece of the ray: check the middle between any two of its crossings."""
    at = [0.0, 1.0]
    for axis in range(3):
        low, high = sorted((start[axis], stop[axis]))
        if high > low:
            at += [
                (face - start[axis]) / (stop[axis] - start[axis]) for face in range(int(np.ceil(low)), int(high) + 1)
            ]
    at = sorted(share for share in at if 0 <= share <= 1)
    middles = [(a + b) / 2 for a, b in itertools.pairwise(at) if b - a > 1e-12]
    return {tuple(int(c) for c in np.floor(start + share * (stop - start))) for share in middles}


def test_rays_cross_what_the_slow_loop_says():
    rng = np.random.default_rng(7)
    origin, ends = rng.uniform(-2, 2, 3), rng.uniform(-9, 9, (60, 3))
    ends[0] = origin + np.array([4, 0, 0])  # along an axis
    ends[1] = origin + np.array([0, -3, 2])
    ends[2] = origin + 0.01  # in the same cell, most likely
    for end in ends:
        found = {tuple(int(c) for c in cell) for cell in crossed_cells(origin * 0.2, end[None] * 0.2, 0.2)}
        assert found == slowly_crossed(origin, end)
    together = crossed_cells(origin, ends, 1.0)
    expected = set().union(*(slowly_crossed(origin, end) for end in ends))
    assert sorted(map(tuple, together.tolist())) == sorted(expected)


def test_no_rays_cross_no_cells():
    assert len(crossed_cells(np.zeros(3), np.empty((0, 3)), 0.1)) == 0


def test_pieces_change_nothing(monkeypatch):
    ends = np.random.default_rng(3).uniform(-9, 9, (200, 3))
    whole = crossed_cells(np.zeros(3), ends, 0.3)
    monkeypatch.setattr(points, "AT_ONCE", 100)
    np.testing.assert_array_equal(crossed_cells(np.zeros(3), ends, 0.3), whole)


def test_a_ray_too_long_to_walk_is_refused():
    with pytest.raises(StereovoxError, match="use larger cells"):
        crossed_cells(np.zeros(3), np.array([[1e9, 0, 0]]), 0.1)


def test_evidence_of_a_scan_is_of_its_hits_first():
    origin, ends = np.array([0.05, 0.05, 0.05]), np.array([[1.05, 0.05, 0.05], [2.05, 0.05, 0.05], [-3.01, -0.52, 0.7]])
    evidence = scan_evidence(origin, ends, 0.1, 900, -400)
    block, column = np.nonzero(evidence.values)
    cells = evidence.coords[block] * 8 + np.stack([column >> 6, column >> 3 & 7, column & 7], axis=1)
    found = dict(zip(map(tuple, cells.tolist()), evidence.values[block, column].tolist(), strict=True))
    hits = {tuple(cell) for cell in np.floor(ends / 0.1).astype(int).tolist()}
    expected = dict.fromkeys(map(tuple, crossed_cells(origin, ends, 0.1).tolist()), -400)
    assert found == expected | dict.fromkeys(hits, 900)
