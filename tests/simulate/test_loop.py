# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.simulate.simulation import Simulation


def poses_of(simulation: Simulation) -> np.ndarray:
    return np.array([simulation.true_pose(i) for i in range(len(simulation))])


def turns_deg(poses: np.ndarray) -> np.ndarray:
    traces = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    return np.degrees(np.arccos(((traces - 1) / 2).clip(-1, 1)))


@pytest.mark.parametrize("query", ["", "plan=1&laps=1", "plan=2&length=30&laps=1", "plan=3&length=150&laps=1"])
def test_the_walk_is_smooth_and_keeps_away_from_all_things(query):
    simulation = Simulation(f"sim:loop?{query}")
    poses = poses_of(simulation)
    eyes = poses[:, :3, 3]
    near = [solid.name for solid in simulation.scene.solids if solid.contains(eyes, margin=0.3).any()]
    assert near == []
    speed = np.linalg.norm(np.diff(eyes, axis=0), axis=1) * 10
    assert 0.5 < speed.min() < speed.max() < 1.5
    assert turns_deg(poses).max() < 8
    ahead = np.diff(eyes[:, :2], axis=0) / np.linalg.norm(np.diff(eyes[:, :2], axis=0), axis=1)[:, None]
    assert (poses[:-1, :2, 2] * ahead).sum(1).min() > 0.8  # it looks where it goes


def test_the_walk_goes_round_and_ends_a_little_beyond_its_start():
    simulation = Simulation("sim:loop?length=40&laps=3")
    eyes, one = (poses_of(Simulation(f"sim:loop?length=40&laps={laps}"))[:, :3, 3] for laps in (3, 1))
    back = np.linalg.norm(eyes[-1] - eyes[0])
    assert 1.5 < back < 3
    assert eyes[-1, 0] > eyes[0, 0]
    assert simulation.frame(1).stamp_ns == pytest.approx(100_000_000, rel=0.01)
    lengths = [np.linalg.norm(np.diff(way, axis=0), axis=1).sum() - back for way in (one, eyes)]
    assert lengths == pytest.approx([40 - 4 * 0.5, 3 * (40 - 4 * 0.5)], rel=0.03)  # corners are cut
    half = one[len(one) // 2]
    assert np.linalg.norm(half - one[0]) > 7  # the other side
    again = np.linalg.norm(eyes[len(eyes) // 2 :, None] - eyes[None, : len(eyes) // 3], axis=2).min(1)
    assert 0.05 < again.max() < 0.5  # the same corridors, not the same steps


def test_no_two_stretches_of_the_ring_are_alike():
    simulation = Simulation("sim:loop?noise=0&laps=1")
    images = np.array([simulation.true_depth(i)[::4, ::4] for i in range(0, len(simulation) - 40, 20)])
    differ = np.abs(images[:, None] - images[None]) > 0.05
    shares = differ.mean(axis=(2, 3))[~np.eye(len(images), dtype=bool)]
    assert shares.min() > 0.25
    again = Simulation("sim:loop?laps=1").scene.triangles
    np.testing.assert_array_equal(simulation.scene.triangles, again)
    other = Simulation("sim:loop?plan=1&laps=1").scene.triangles
    assert other.shape != again.shape or not np.allclose(other, again)


def test_walls_stand_where_the_faces_say():
    simulation = Simulation("sim:loop?plan=4")
    solids, faces = simulation.scene.part("walls"), simulation.faces
    assert [face.name for face in faces[:3]] == ["south outer", "south inner", "east outer"]
    assert len(faces) == 8
    random = np.random.default_rng(0)
    for face in faces:
        a, b, _, d = face.corners
        shares = random.uniform(0.005, 0.995, (300, 2))
        points = a + shares[:, :1] * (b - a) + shares[:, 1:] * (d - a)
        in_wall = np.any([solid.contains(points - 0.01 * face.normal) for solid in solids], axis=0)
        assert in_wall.mean() > 0.7, face.name  # the rest: niches and doors
        deep = np.any([solid.contains(points - 0.59 * face.normal) for solid in solids], axis=0)
        assert deep.all(), face.name
        assert not np.any([solid.contains(points + 0.01 * face.normal) for solid in solids]), face.name


def test_the_ring_is_closed():
    simulation = Simulation("sim:loop?image_width=64&laps=1&plan=5")
    seen = [simulation.true_depth(i) for i in range(0, len(simulation), 10)]
    assert np.isfinite(seen).all()
    assert np.max(seen) < 20
