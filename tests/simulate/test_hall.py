"""Halls at random: closed, each plan another one, a way that touches nothing, frames from anywhere."""

import numpy as np
import pytest

from stereovox import Mapper, StereovoxError
from stereovox.simulate.simulation import Simulation
from stereovox_lab.flights.clearance import Clearance


@pytest.mark.parametrize("plan", [0, 1, 17])
def test_the_way_is_clear_and_all_round_is_closed(plan):
    simulation = Simulation(f"sim:hall?plan={plan}&noise=off")
    clearance = Clearance(simulation.scene)
    for i in range(0, len(simulation), 40):
        place = simulation.true_pose(i)[:3, 3]
        assert clearance.at(place) > 0.3
        assert np.isfinite(simulation.true_depth(i)).all()


def test_plans_differ_and_repeat():
    first, again, other = (Simulation(f"sim:hall?plan={plan}").scene.triangles for plan in (1, 1, 2))
    assert np.array_equal(first, again)
    assert first.shape != other.shape or not np.allclose(first, other)
    with pytest.raises(StereovoxError, match="plan=-1"):
        Simulation("sim:hall?plan=-1")


def test_it_can_be_mapped():
    mapper = Mapper("default", voxel_size=0.1)
    simulation = Simulation("sim:hall")
    for i in range(10):
        assert mapper.add(simulation.frame(i)).refused is None
    assert len(mapper.map.occupied()) > 500


def test_frames_from_anywhere_are_those_of_the_way_there():
    simulation = Simulation("sim:hall?plan=2")
    own = simulation.frame(3)
    same = simulation.frame_from(own.T_world_sensor, 3, own.stamp_ns)
    assert np.array_equal(own.depth, same.depth)
    assert np.array_equal(own.reason, same.reason)
    reported = own.T_world_sensor.copy()
    reported[0, 3] += 0.01
    other = simulation.frame_from(own.T_world_sensor, 4, 7, reported)
    assert not np.array_equal(own.depth, other.depth)
    assert np.array_equal(other.T_world_sensor, reported)
    assert (other.stamp_ns, other.name) == (7, "sim:hall?plan=2 look 4")
