# SPDX-License-Identifier: Apache-2.0
from itertools import groupby, pairwise

import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import Transform, look_at
from stereovox.opening import open_source
from stereovox.simulate.scenes.offices import BACK, BAY, HALF, SHIFT, office_pose, place
from stereovox.simulate.simulation import Simulation


def poses_of(simulation: Simulation) -> np.ndarray:
    return np.array([simulation.true_pose(i) for i in range(len(simulation))])


def offices_of(simulation: Simulation) -> list[str]:
    """The offices that are visited, in order."""
    return [where for where, _ in groupby(map(place, poses_of(simulation))) if where.startswith("office")]


def seen_from(simulation: Simulation, T_world_camera: Transform) -> np.ndarray:
    return simulation._cast(T_world_camera)


@pytest.mark.parametrize("query", ["", "walk=1&visits=4", "walk=2&offices=2&visits=3", "walk=3&offices=16&speed=1.5"])
def test_the_walk_is_smooth_and_keeps_away_from_all_things(query):
    simulation = Simulation(f"sim:offices?{query}")
    poses = poses_of(simulation)
    near = [s.name for s in simulation.scene.solids if s.contains(poses[:, :3, 3], margin=0.3).any()]
    assert near == []
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 10
    assert speed.max() < 1.3 * (1.5 if "speed" in query else 1)
    assert np.abs(np.diff(speed)).max() < 0.8  # m/s in a tenth of a second
    traces = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    assert np.degrees(np.arccos(((traces - 1) / 2).clip(-1, 1))).max() < 8.5
    np.testing.assert_allclose(poses[-1, :2, 3], poses[0, :2, 3], atol=1e-6)
    np.testing.assert_allclose(poses[0, :3, 2], [1, 0, 0], atol=1e-6)
    assert poses[-1, 0, 2] > 0.95


def test_offices_are_visited_again_and_never_twice_running():
    visited = offices_of(Simulation("sim:offices?visits=12"))
    assert len(visited) == 12 > len(set(visited)) > 3
    assert all(one != other for one, other in pairwise(visited))
    assert offices_of(Simulation("sim:offices?visits=12")) == visited
    assert offices_of(Simulation("sim:offices?visits=12&walk=1")) != visited
    assert offices_of(Simulation("sim:offices?offices=2&visits=3")) in (
        ["office 0", "office 1", "office 0"],
        ["office 1", "office 0", "office 1"],
    )


def test_nobody_walks_the_same_steps_twice():
    simulation = Simulation("sim:offices?offices=2&visits=5")
    visits = groupby(poses_of(simulation), key=place)
    deepest = [max(T[1, 3] for T in poses) for where, poses in visits if where == "office 0"]
    assert len(deepest) >= 2
    assert np.ptp(deepest) > 0.01


def test_the_same_is_seen_in_every_office():
    simulation = Simulation("sim:offices?offices=6")
    random = np.random.default_rng(0)
    for _ in range(8):
        eye = np.append(random.uniform((1.8, -0.5), (3.1, 0.5)), 1.35)
        yaw = random.uniform(-1.0, 1.0)  # not back to the door: the corridor's ends may be seen there
        T_office_camera = look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), -0.1]))
        images = [seen_from(simulation, office_pose(number) @ T_office_camera) for number in range(6)]
        for image in images[1:]:
            assert (np.abs(image - images[0]) > 1e-4).mean() < 0.001  # rays that graze an edge
        here = [place(office_pose(number) @ T_office_camera) for number in range(6)]
        assert here == [f"office {number}" for number in range(6)]


def test_all_bays_of_the_corridor_are_alike_in_both_directions_up_to_its_end():
    simulation = Simulation("sim:offices?offices=10")
    T_bay_camera = look_at((0.1, -0.2, 1.35), (0.1, -1.2, 1.3))  # along the corridor, towards +x from a left office
    images = [seen_from(simulation, office_pose(number) @ T_bay_camera) for number in (0, 2, 4, 6, 7, 5)]
    for bays, image in zip((5, 4, 3, 2, 4, 3), images, strict=True):
        reach = (bays - 0.5) * BAY - 0.3
        near = (image < reach) & (images[0] < reach)
        assert near.mean() > 0.8
        assert (np.abs(image - images[0])[near] > 1e-3).mean() < 0.001
        beyond = image.max()
        assert beyond == pytest.approx(reach + 0.1, rel=0.02)  # the end


def test_places_are_told_in_the_corridor_and_in_offices():
    def at(x: float, y: float) -> str:
        eye = SHIFT + np.array([x, y, 1])
        return place(look_at(eye, eye + np.array([1, 0, 0])))

    assert [at(0.1, 0), at(BAY - 0.1, 0.9), at(BAY + 0.1, -0.9)] == ["bay 0", "bay 0", "bay 1"]
    assert [at(0.1, 2), at(0.1, -2), at(3.5 * BAY, HALF + 0.05)] == ["office 0", "office 1", "office 6"]
    assert at(3.5 * BAY, 0.1 - BACK) == "office 7"


def test_the_corridors_walls_stand_where_the_faces_say():
    simulation = Simulation("sim:offices")
    walls = simulation.scene.part("walls")
    random = np.random.default_rng(0)
    assert [face.name for face in simulation.faces] == ["left wall", "right wall", "start wall", "end wall"]
    for face in simulation.faces:
        a, b, _, d = face.corners
        shares = random.uniform(0.005, 0.995, (300, 2))
        points = a + shares[:, :1] * (b - a) + shares[:, 1:] * (d - a)
        assert np.any([solid.contains(points - 0.01 * face.normal) for solid in walls], axis=0).mean() > 0.7
        assert not np.any([solid.contains(points + 0.01 * face.normal) for solid in walls])


def test_an_odd_number_of_offices_is_refused():
    with pytest.raises(SourceError, match="offices=7 must be even"):
        open_source("sim:offices?offices=7")
