"""Missions: a hall is explored without touching anything, and the middle of a room is found."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.lab.flights.explore import Cruise, Frontiers, MiddleOfRoom, fly
from stereovox.lab.flights.flight import World

SHORT = Cruise(seconds=35.0)


@pytest.fixture(scope="module")
def world():
    return World("sim:hall?plan=3")


def test_exploring_uncovers_the_hall_and_touches_nothing(world):
    explored, _ = fly(3, Frontiers(), SHORT, world)
    assert explored.collided_s is None
    assert explored.clearance_m > SHORT.airframe.radius
    shares = [share for _, share in explored.coverage]
    assert shares[0] == 0
    after_look = next(share for seconds, share in explored.coverage if seconds >= 10)
    assert shares[-1] > after_look + 0.1
    assert explored.goals >= 2
    assert explored.metres > 3


def test_the_middle_has_more_room_than_the_start(world):
    mission = MiddleOfRoom()
    explored, _ = fly(3, mission, replace(SHORT, seconds=90.0), world)
    assert explored.done
    assert explored.collided_s is None
    start = world.start(np.random.default_rng([3, 1]))
    flat = [world.clearance.at(np.array([*place[:2], 1.3])) for place in (explored.place, start)]
    assert flat[0] > 0.9
    assert flat[0] >= flat[1] - 0.1
    assert mission.room_m > 0.8


class Through:
    """A mission that would fly through the nearest wall."""

    def __init__(self):
        self.ways = 0

    def next(self, voxel_map, ways):
        self.ways += 1
        if self.ways > 3:
            return None
        return np.stack([ways.start, ways.start + np.array([20.0, 0, 0])]), np.full(3, np.nan)


def test_ways_that_are_not_free_are_not_flown(world):
    """The check ahead stops it, whatever the mission says."""
    explored, _ = fly(3, Through(), replace(SHORT, seconds=90.0), world)
    assert explored.collided_s is None
    assert explored.goals == 3
    assert explored.clearance_m > SHORT.airframe.radius


def test_without_the_check_ahead_it_collides_and_that_is_told(world):
    """The control of the test above: a vehicle that takes all before it for its own place flies on."""
    explored, _ = fly(3, Through(), replace(SHORT, seconds=60.0, own_radius=50.0, camera_hz=2.0), world)
    assert explored.collided_s is not None
    assert explored.seconds == explored.collided_s
    assert explored.clearance_m < SHORT.airframe.radius
    assert not explored.done
