# SPDX-License-Identifier: Apache-2.0
"""Positions that do not drift hold the way of a camera."""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest
from made_loops import ELSEWHERE, blind, follow, off, truths

from stereovox.config import load_config
from stereovox.correct.close_loops import _positions
from stereovox.correct.loops.closer import LoopCloser
from stereovox.correct.loops.drift import Positions
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.simulate.simulation import Simulation

WALK = "sim:loop?length=30&laps=1&image_width=106&drift=0.06&seed=5"


def measured(sigma, every_ns=1_000_000_000, length=None):
    """Return positions once a second in another world, with noise."""
    walk, random = Simulation(WALK), np.random.default_rng(1)
    numbers = range(0, length or len(walk), max(1, round(every_ns / walk.period_ns)))
    places = np.array([(ELSEWHERE @ walk.true_pose(i))[:3, 3] for i in numbers])
    stamps = np.array([i * walk.period_ns for i in numbers])
    return Positions(stamps, places + random.normal(0, sigma, places.shape), sigma)


@cache
def unfinished():
    closer = blind(LoopCloser(load_config()))
    follow(closer, WALK, 230)
    return closer


def held(positions):
    closer = deepcopy(unfinished())
    closer.finish(positions=positions)
    return closer


def test_a_way_that_drifts_is_held():
    closer = held(measured(0.05))
    truth = truths(closer, WALK)
    before = off([submap.T_odom_anchor for submap in closer.submaps], truth)
    after = off([submap.T_map_anchor for submap in closer.submaps], truth)
    assert before > 0.15
    assert after < 0.5 * before
    np.testing.assert_allclose(closer.submaps[0].T_map_anchor, closer.submaps[0].T_odom_anchor, atol=1e-2)


def test_wrong_positions_hardly_pull():
    positions = measured(0.05)
    positions.places[6] += [8, -5, 3]
    truth = truths(held(None), WALK)
    off_by = off([submap.T_map_anchor for submap in held(positions).submaps], truth)
    assert off_by < 1.3 * off([submap.T_map_anchor for submap in held(measured(0.05)).submaps], truth) + 0.02


@pytest.mark.parametrize("scale", [1, 1000])
def test_positions_of_another_unit_or_way_are_told_from_right_ones(scale):
    positions = measured(0.05)
    positions.places *= scale
    positions.places[6] += scale * np.array([8, -5, 3])
    submaps = len(held(positions).submaps)
    if scale == 1:
        positions.check_used()
        assert 0 < positions.contradicted < 0.2 * positions.used
    else:
        with pytest.raises(
            StereovoxError, match=f"contradicts the path in {positions.contradicted} of {submaps} places"
        ):
            positions.check_used()


def test_positions_in_a_map_with_another_way_up():
    random = np.random.default_rng(2)
    anchors = random.uniform(-10, 10, (20, 3))
    R = rotation_matrix([np.pi / 2, 0, 0])  # y points down
    turned = (anchors @ R.T @ rotation_matrix([0, 0, 1.2]).T + [4, 5, 6]) @ R
    placed = Positions(np.arange(20), turned, 0.1).in_map(turned, anchors, R)
    np.testing.assert_allclose(placed, anchors, atol=1e-9)


def test_between_positions_far_apart_in_time_there_is_none():
    positions = Positions(np.array([0, 1, 9]) * 10**9, np.array([[0.0, 0, 0], [1, 0, 0], [9, 0, 0]]), 1.0)
    found = positions.at(np.array([-1, 0, 5 * 10**8, 10**9, 4 * 10**9, 9 * 10**9, 10**10]))
    np.testing.assert_allclose(found[:, 0], [np.nan, 0, 0.5, 1, np.nan, 9, np.nan])


@pytest.mark.parametrize(("length", "sigma"), [(12, 0.05), (None, 20.0)])
def test_too_few_or_too_vague_positions_are_refused(length, sigma):
    with pytest.raises(StereovoxError, match="are needed to know how they lie in the map"):
        held(measured(sigma, length=length))


def test_positions_of_which_none_is_usable_are_refused(tmp_path):
    file = tmp_path / "gnss.tum"
    file.write_text("0.0 nan nan nan 0 0 0 1\n1.0 nan nan nan 0 0 0 1\n")
    with pytest.raises(StereovoxError, match="0 places of the path have a position"):
        held(_positions(str(file), 1.0, load_config()))
