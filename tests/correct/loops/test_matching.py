# SPDX-License-Identifier: Apache-2.0
"""Submaps laid onto each other: right where they show one place, not at all where they do not."""

import numpy as np
from made_loops import RING, closed, truths

from stereovox.correct.loops.drift import difference
from stereovox.correct.loops.submaps import _seen_from, matched
from stereovox.geometry.se3 import inverse, rotation_matrix
from stereovox.track.fit import _moved, motion_between


def test_neighbours_lie_as_they_do_and_their_covariance_holds():
    closer = closed(RING)
    truth, squared = truths(closer, RING), []
    for i in range(len(truth) - 1):
        exact = inverse(truth[i]) @ truth[i + 1]
        guess = exact.copy()
        guess[:3, 3] += [0.1, -0.05, 0.05]
        found = matched(*(closer.shapes[closer.submaps[k]] for k in (i, i + 1)), guess)
        if found is not None and found.held:
            off = difference(exact, found.T_earlier_later)
            assert np.linalg.norm(off[3:]) < 0.12
            squared.append(off @ np.linalg.solve(found.covariance, off) / 6)
    assert len(squared) > 8
    assert np.median(squared) < 1.5


def test_places_that_differ_are_seldom_taken_for_one():
    ring, rooms = closed(RING), closed("sim:apartment?image_width=106", 0, 400)
    taken, tried = 0, 0
    for one in ring.submaps[::3]:
        for other in rooms.submaps[::3]:
            earlier, later = ring.shapes[one], rooms.shapes[other]
            guess = np.eye(4)
            guess[:3, 3] = earlier.points.mean(axis=0) - later.points.mean(axis=0)
            match = matched(earlier, later, guess)
            taken, tried = taken + (match is not None and match.held), tried + 1
    assert tried > 100
    assert taken <= 0.03 * tried  # a wall and the floor of one are like those of the other


def test_a_covariance_seen_from_the_other_side():
    random = np.random.default_rng(1)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(random.normal(size=3)), random.normal(size=3)
    spread = random.normal(0, 1e-4, (20000, 6)) @ random.normal(size=(6, 6))
    moved = np.array([motion_between(T, inverse(_moved(inverse(T), motion))) for motion in spread])
    np.testing.assert_allclose(_seen_from(T, np.cov(spread.T)), np.cov(moved.T), rtol=0.01, atol=1e-10)
