"""Missions: a hall is explored without touching anything, and the middle of a room is found."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.products.frontiers import Frontier
from stereovox_lab.flights import explore
from stereovox_lab.flights.explore import Cruise, Frontiers, MiddleOfRoom, fly
from stereovox_lab.flights.flight import World

SHORT = Cruise(seconds=35.0)


@pytest.fixture(scope="module")
def world():
    return World("sim:hall?plan=3")


def test_exploring_uncovers_the_hall_and_touches_nothing(world):
    told, _ = fly(3, Frontiers(), SHORT, world)
    assert told.collided_s is None
    assert told.clearance_m > SHORT.airframe.radius
    shares = [share for _, share in told.coverage]
    assert shares[0] == 0
    after_look = next(share for seconds, share in told.coverage if seconds >= 10)
    assert shares[-1] > after_look + 0.05
    assert told.goals >= 2
    assert told.metres > 3


def test_the_middle_has_more_room_than_the_start(world):
    mission = MiddleOfRoom()
    told, _ = fly(3, mission, replace(SHORT, seconds=90.0), world)
    assert told.done
    assert told.collided_s is None
    start = world.start(np.random.default_rng([3, 1]))
    flat = [world.clearance.at(np.array([*place[:2], 1.3])) for place in (told.place, start)]
    assert flat[0] > 0.9
    assert flat[0] >= flat[1] - 0.1
    assert mission.room_m > 0.8


class Straight:
    """Ways in the open, which end `short` metres before what is asked for."""

    def __init__(self, x: float, short: float = 0.0):
        self.start, self.short = np.array([x, 0, 1.0]), short

    def path_to(self, goal, near):
        end = np.asarray(goal) - np.array([self.short, 0, 0])
        return np.stack([self.start, end]) if self.short <= near else None


def done(mission, ways):
    """Whether no frontier is a goal: what is left is to look all round."""
    found = mission.next(None, ways)
    return found is None or bool(np.isnan(found[1]).all())


@pytest.fixture
def one_frontier(monkeypatch):
    """Let every map have one frontier at x = 6 m, seen from x = 5 m."""
    found = [Frontier(np.zeros((20, 3), np.int32), np.array([6.0, 0, 1]), np.array([5.0, 0, 1]))]
    monkeypatch.setattr(explore, "frontiers_around", lambda *words: found)
    return found


def test_what_was_looked_at_is_done(one_frontier):
    mission = Frontiers()
    assert mission.next(None, Straight(0))[0][-1].tolist() == [5, 0, 1]
    assert done(mission, Straight(5))
    assert mission.next(None, Straight(5)) is None
    assert mission.left == {"seen from nowhere": 0, "no way to it": 0, "looked at already": 1}


def test_where_no_frontier_can_be_come_to_it_looks_all_round_from_near_some_but_not_for_ever(one_frontier):
    hidden = [replace(one_frontier[0], centroid=np.array([x, 0.0, 1]), look_from=None) for x in (9, 9.5, 20, 30, 40)]
    one_frontier[:] = hidden
    mission = Frontiers()
    for x in (9, 20, 30):  # the largest first; 9.5 is seen from 9
        way, look_at = mission.next(None, Straight(0))
        assert way[-1].tolist() == [x, 0, 1]
        assert np.isnan(look_at).all()
    assert mission.next(None, Straight(0)) is None  # three times in vain
    assert mission.left == {"seen from nowhere": 5, "no way to it": 0, "looked at already": 0}


def test_what_a_look_all_round_shows_is_gone_to(one_frontier):
    seen, mission = list(one_frontier), Frontiers()
    one_frontier[:] = [replace(seen[0], centroid=np.array([x, 0.0, 1]), look_from=None) for x in (9, 20, 30, 40)]
    assert [mission.next(None, Straight(0))[0][-1][0] for _ in range(3)] == [9, 20, 30]
    one_frontier += seen
    assert mission.next(None, Straight(0))[0][-1][0] == 5
    one_frontier[:] = one_frontier[:4]
    assert mission.next(None, Straight(5))[0][-1][0] == 40  # the count of those in vain began anew


def test_a_way_that_had_to_be_left_is_tried_again_but_not_for_ever(one_frontier):
    mission = Frontiers()
    for x in (0, 1, 2):
        assert mission.next(None, Straight(x)) is not None
    assert done(mission, Straight(3))


def test_what_was_looked_at_from_far_is_looked_at_from_near(one_frontier):
    mission = Frontiers()
    assert mission.next(None, Straight(0, short=1.5))[0][-1].tolist() == [3.5, 0, 1]
    assert mission.next(None, Straight(3.5))[0][-1].tolist() == [5, 0, 1]
    assert done(mission, Straight(5))


def test_why_frontiers_are_left_is_told(one_frontier):
    one_frontier.append(replace(one_frontier[0], look_from=None))
    mission = Frontiers()
    assert done(mission, Straight(0, short=3))
    assert mission.next(None, Straight(0, short=3)) is None
    assert mission.left == {"seen from nowhere": 1, "no way to it": 1, "looked at already": 0}


class Through:
    """A mission that would fly through the nearest wall."""

    def __init__(self):
        self.ways, self.left = 0, {}

    def next(self, voxel_map, ways):
        self.ways += 1
        if self.ways > 3:
            return None
        return np.stack([ways.start, ways.start + np.array([20.0, 0, 0])]), np.full(3, np.nan)


def test_ways_that_are_not_free_are_not_flown(world):
    """The check ahead stops it, whatever the mission says."""
    told, _ = fly(3, Through(), replace(SHORT, seconds=90.0), world)
    assert told.collided_s is None
    assert told.goals == 3
    assert told.clearance_m > SHORT.airframe.radius


def test_without_the_check_ahead_it_collides_and_that_is_told(world):
    """The control of the test above: a vehicle that takes all before it for its own place flies on."""
    told, _ = fly(3, Through(), replace(SHORT, seconds=60.0, own_radius=50.0, camera_hz=2.0), world)
    assert told.collided_s is not None
    assert told.seconds == told.collided_s
    assert told.clearance_m < SHORT.airframe.radius
    assert not told.done
