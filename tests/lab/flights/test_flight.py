"""One short flight, with and without prevention, and that what it says is so."""

from dataclasses import replace

import numpy as np
import pytest
from flights import changed, told

from stereovox import StereovoxError
from stereovox_lab.flights.flight import START_ROOM, Setup, Sticks, World, fly

SHORT = Setup(seconds=12.0)


@pytest.fixture(scope="module")
def world():
    return World("sim:hall?plan=5")


@pytest.fixture(scope="module")
def flight(world):
    return fly(5, SHORT, world)


def test_with_prevention_it_flies_and_touches_nothing(flight):
    assert flight.collided_s is None
    assert flight.metres > 1
    assert flight.clearance_m > SHORT.airframe.radius
    assert flight.refused == 0
    assert flight.frames > 250
    assert flight.seconds == pytest.approx(12)


def test_the_same_sticks_without_it_end_in_a_wall(world):
    crash = fly(5, replace(SHORT, prevention=False, seconds=40), world)
    assert crash.collided_s is not None
    assert crash.clearance_m < SHORT.airframe.radius
    assert crash.frames == 0


def test_a_flight_is_the_same_each_time(world, flight):
    assert fly(5, SHORT, world) == flight


def test_without_sectors_it_does_not_move(world):
    late = replace(SHORT, seconds=2, delay_s=100.0)
    assert fly(5, late, world).metres < 0.01


def test_starts_are_inside_and_have_room(world):
    random = np.random.default_rng(0)
    for _ in range(5):
        place = world.start(random)
        assert world.clearance.at(place) >= START_ROOM
        low, high = world.camera.scene.part("walls")[0].bounds
        assert low[1] < place[1] < high[1]


def test_scenes_without_room_are_refused():
    world = World("sim:wall")
    with pytest.raises(StereovoxError, match="no place with"):
        world.start(np.random.default_rng(0))


def test_sticks_turn_once_and_then_wish():
    sticks = Sticks(np.random.default_rng(1), 1.5)
    assert sticks.at(1.0, 0.0)[0].tolist() == [0, 0]
    wishes = [sticks.at(t, 0.3)[0] for t in np.arange(8, 100, 0.5)]
    speeds = np.linalg.norm(wishes, axis=1)
    assert 0.4 < speeds.min() < speeds.max() <= 1.5
    assert len(np.unique(np.round(speeds, 6))) > 20


def test_the_benchmark_sums_up_and_reads_its_settings(flight):
    crash = replace(flight, collided_s=9.0, metres=0.5)
    summary = told([flight, crash])
    assert summary["flights"] == 2
    assert summary["collisions"] == 1
    assert summary["metres"]["under_1"] == 1
    setup = changed(Setup(), ["speed=3", "rules.half_height=0.2", "pose_sigma=[0.02, 0.01]"])
    assert (setup.speed, setup.rules.half_height, list(setup.pose_sigma)) == (3, 0.2, [0.02, 0.01])
    with pytest.raises(StereovoxError, match="no wings"):
        changed(Setup(), ["wings=4"])
