# SPDX-License-Identifier: Apache-2.0
"""A second recording is found in the first one's world, or it is said why it cannot be."""

from copy import deepcopy
from types import SimpleNamespace

import numpy as np
import pytest
from made_loops import ELSEWHERE, RACKS, RING, closed, truths

from stereovox.correct.loops import placing
from stereovox.correct.loops.closer import difference
from stereovox.correct.loops.placing import placed
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import from_quaternion, inverse

SECOND = RING.replace("seed=3", "seed=8")
FIRST_PART, SECOND_PART = (0, 120), (60, 120)
"""Frames of the two: what they share is found in half of the ring."""


def test_a_second_recording_is_found_and_joined():
    first, second = deepcopy(closed(RING, *FIRST_PART)), deepcopy(closed(SECOND, *SECOND_PART, elsewhere=True))
    place = placed(first, second)
    off = difference(inverse(ELSEWHERE), place.T_first_second)
    assert np.linalg.norm(off[3:]) < 0.6  # both have drifted
    assert np.linalg.norm(off[:3]) < np.radians(5)
    assert len({(loop.first, loop.second) for loop in place.loops}) == len(place.loops) >= 3
    count = len(first.submaps)
    first.join(second, place.T_first_second, place.loops)
    first.finish()
    where = np.array([submap.T_map_anchor for submap in first.submaps])
    exact = [*truths(closed(RING, *FIRST_PART), RING), *truths(closed(SECOND, *SECOND_PART, elsewhere=True), SECOND)]
    apart = []
    for i in range(count):
        for k in range(count, len(where)):
            real = inverse(exact[i]) @ exact[k]
            if np.linalg.norm(real[:3, 3]) < 0.6:
                apart.append(np.linalg.norm(difference(real, inverse(where[i]) @ where[k])[3:]))
    assert len(apart) > 4
    assert np.median(apart) < 0.06


@pytest.mark.parametrize(("side", "parts"), [(40.0, 1), (7.0, 4)])
def test_places_are_found_in_the_whole_and_in_parts(monkeypatch, side, parts):
    first, second = closed(RING, *FIRST_PART), closed(SECOND, *SECOND_PART, elsewhere=True)
    numbers, steps = list(range(0, len(second.submaps), 3)), list[tuple[int, int]]()
    monkeypatch.setattr(placing, "AREA_M", side)
    found = placing._places(first, second, numbers, lambda *done: steps.append(done))
    assert steps[-1] == (parts * len(numbers),) * 2
    for number in numbers:
        off = [difference(inverse(ELSEWHERE) @ second.submaps[number].T_map_anchor, T) for T in found[number]]
        assert len(off) == placing.PEAKS
        assert any(np.linalg.norm(one[3:]) < 1 and np.linalg.norm(one[:3]) < 0.25 for one in off)


def test_only_parts_are_searched_that_a_camera_was_near():
    corner = [[x, 0.0] for x in np.arange(0.0, 400.0, 5.0)] + [[400.0, y] for y in np.arange(0.0, 300.0, 5.0)]
    poses = [from_quaternion([*place, 1.0], [0, 0, 0, 1]) for place in corner]
    way = SimpleNamespace(submaps=[SimpleNamespace(T_map_anchor=T) for T in poses], R_level_map=np.eye(3))
    areas = placing._areas(way)
    for place in np.array(corner) + np.random.default_rng(5).uniform(-2, 2, (len(corner), 2)):
        assert any((np.abs(place - middle) <= half + 1e-9).all() for middle, half in areas)
    assert len(areas) <= 22  # of 88 that the square has
    assert max(half.max() for _, half in areas) <= placing.AREA_M / 2


def test_what_was_never_seen_is_not_found():
    first = closed(RING, 0, 90)
    second = closed("sim:apartment?image_width=106", 300, 400)
    with pytest.raises(StereovoxError, match=r"is unknown: .* places of it were found"):
        placed(first, second)


def test_an_office_that_may_be_any_is_not_placed():
    offices = "sim:offices?offices=6&visits=2&image_width=106"
    first, second = closed(f"{offices}&walk=1", 0, 200), closed(f"{offices}&walk=2&seed=4", 60, 160, elsewhere=True)
    with pytest.raises(StereovoxError, match=r"fits the first in two ways|is not known"):
        placed(first, second)


def test_one_place_alone_does_not_say_where_a_recording_lies():
    first, second = closed(RING, 0, 90), closed(RING, 30, 34, elsewhere=True)
    assert len(second.submaps) == 1
    with pytest.raises(StereovoxError, match="of 1 places of it were found in the first, 3 must agree"):
        placed(first, second)


def test_shelves_that_may_be_any_are_not_placed():
    again = RACKS.replace("seed=1", "seed=5&walk=2").replace("passes=3", "passes=2")
    with pytest.raises(StereovoxError, match=r"is unknown"):
        placed(closed(RACKS, drift=0.05), closed(again, elsewhere=True))
