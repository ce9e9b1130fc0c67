# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import look_at
from stereovox.simulate.scenes.racks import HALF, SHIFT
from stereovox.simulate.simulation import Simulation


def test_from_one_bay_to_the_next_the_same_is_seen():
    simulation = Simulation("sim:racks?bays=12&bay=1.5&image_width=96")
    eye, ahead = SHIFT + np.array([0, 0.1, 1.35]), np.array([1, 0.7, -0.15])
    eyes = [eye + np.array([x, 0, 0]) for x in (3.0, 4.5, 6.0)]
    images = [simulation._cast(look_at(eye, eye + ahead)) for eye in eyes]
    near = (images[0] < 6) & (images[0] > 0)
    assert near.mean() > 0.5
    for image in images[1:]:
        assert (np.abs(image - images[0])[near] > 1e-3).mean() < 0.001


def test_the_walk_goes_to_and_fro_between_the_shelves():
    simulation = Simulation("sim:racks?bays=10&passes=3")
    poses = np.array([simulation.true_pose(i) for i in range(len(simulation))])
    x, y = poses[:, 0, 3] - SHIFT[0], poses[:, 1, 3] - SHIFT[1]
    assert np.abs(y).max() < HALF - 0.4
    turns = np.flatnonzero(np.diff(np.sign(poses[:, 0, 2])))
    assert len(turns) == 2
    assert x[turns].tolist() == pytest.approx([10, 1], abs=2)
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 10
    assert speed.max() < 1.5 * 1.2


def test_values_out_of_range_are_refused():
    with pytest.raises(SourceError, match="bays=2"):
        Simulation("sim:racks?bays=2")
