# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse, rigidity_error, transform_points
from stereovox.opening import open_source
from stereovox.simulate.scenes import hall, town
from stereovox.simulate.simulation import SCENES, Simulation
from stereovox.simulate.stage import Stage, rectangle

SMALL = "image_width=106"
SHORT = {"flight": "length=60", "aisle": "speed=1", "town": "frames=40&blocks=3"}
PART = {"flight": "&length=60", "town": "&blocks=2"}
"""Of scenes that take long to build, what is enough for a few frames."""


def short(scene: str) -> Simulation:
    return Simulation(f"sim:{scene}?{SMALL}&{SHORT.get(scene, 'frames=40')}")


def hits(simulation: Simulation, i: int) -> np.ndarray:
    """Where (N, 3) the rays of frame `i` meet the scene, in the frame of the poses."""
    points = simulation.camera.back_project(simulation.true_depth(i)).reshape(-1, 3)
    return transform_points(simulation.pose(i), points[np.isfinite(points).all(axis=1)])


@pytest.mark.parametrize("scene", SCENES)
def test_every_scene_opens_by_its_name(scene):
    location = f"sim:{scene}?frames=3&{SMALL}{PART.get(scene, '')}"
    source = open_source(location)
    assert (source.name, len(source)) == (location, 3)
    frame, again = source.frame(1), open_source(location).frame(-2)
    assert frame.depth.shape == (60, 106) == (frame.camera.height, frame.camera.width)
    assert (np.asarray(frame.depth, float) > 0).mean() > 0.5
    np.testing.assert_array_equal(frame.depth, again.depth)
    assert not np.array_equal(frame.depth, open_source(f"{location}&seed=1").frame(1).depth)
    assert f"sim:{scene}" in Simulation.layout


def test_other_scenes_can_be_registered(monkeypatch):
    monkeypatch.setitem(SCENES, "my_wall", f"{__name__}:my_wall")
    assert open_source("sim:my_wall?away=3&noise=0").frame(0).depth[0, 0] == pytest.approx(3)


def my_wall(*, away: float = 1.0) -> Stage:
    """Return a wall, by the function of the built-in one."""
    return hall.wall_stage(distance=away)


@pytest.mark.parametrize("scene", SCENES)
def test_the_camera_moves_rigidly_and_through_nothing(scene):
    simulation = short(scene)
    poses = np.array([simulation.pose(i) for i in range(len(simulation))])
    assert max(rigidity_error(T) for T in poses) < 1e-9
    hit = [solid.name for solid in simulation.scene.solids if solid.contains(poses[:, :3, 3], margin=0.09).any()]
    assert hit == []


@pytest.mark.parametrize("scene", SCENES)
def test_optical_axes_change_the_frame_and_nothing_else(scene):
    query = f"frames=5&{SMALL}{PART.get(scene, '')}"
    world, optical = Simulation(f"sim:{scene}?{query}"), Simulation(f"sim:{scene}?{query}&axes=optical")
    np.testing.assert_allclose(optical.pose(0), np.eye(4), atol=1e-12)
    np.testing.assert_allclose(optical.pose(3), inverse(world.pose(0)) @ world.pose(3), atol=1e-12)
    np.testing.assert_array_equal(world.frame(3).depth, optical.frame(3).depth)
    rays = optical._directions @ optical.pose(3)[:3, :3].T
    seen = optical.scene.cast(optical.pose(3)[:3, 3], rays).reshape(60, 106)
    differs = ~np.isclose(seen, optical.true_depth(3), rtol=1e-4)
    assert differs.mean() < 0.01  # rays that graze an edge
    for there, here in zip(optical.faces, world.faces, strict=True):
        np.testing.assert_allclose(there.normal, world.pose(0)[:3, :3].T @ here.normal, atol=1e-12)
        np.testing.assert_allclose(transform_points(world.pose(0), there.corners), here.corners, atol=1e-9)


@pytest.mark.parametrize(
    ("location", "complaint"),
    [
        ("sim:boxx", r"sim:boxx: unknown scene 'boxx' \(did you mean 'box'\?\)"),
        ("sim:box?distanse=2", r"unknown parameter 'distanse' \(did you mean 'distance'\?\)"),
        ("sim:box?size=medium", "size=medium is unknown; use large or small"),
        ("sim:box?distance=9", "distance=9 must be between 0.2 and 3.78"),
        ("sim:box?y=1.1", "puts the box into the floor"),
        ("sim:wall?tilt=80", "tilt=80 must be between -25 and 25"),
        ("sim:room?distance=2", "unknown parameter 'distance'"),
        ("sim:room?axes=xyz", "axes=xyz is unknown; use world or optical"),
        ("sim:room?image_width=3", "image_width=3 must be between 16 and 1920"),
        ("sim:flight?length=1", "length=1 must be between"),
    ],
)
def test_wrong_use_is_one_line(location, complaint):
    with pytest.raises(SourceError, match=complaint) as caught:
        open_source(location)
    assert str(caught.value).startswith(f"{location}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size", ["large", "small"])
def test_a_box_looks_as_geometry_says(size):
    simulation = Simulation(f"sim:box?size={size}&distance=1.7&x=0.31&y=-0.12&wall=3.5&height=1.1&image_width=424")
    width, height = {"large": (0.47, 0.365), "small": (0.25, 0.185)}[size]
    x, y = (slopes.astype(float) for slopes in simulation.camera.ray_slopes())
    on_box = (abs(x * 1.7 - 0.31)[None, :] < width / 2) & (abs(y * 1.7 + 0.12)[:, None] < height / 2)
    floor = np.where(y > 0, 1.1 / np.maximum(y, 1e-9), np.inf)[:, None]
    expected = np.where(on_box, 1.7, np.minimum(3.5, floor))
    wrong = ~np.isclose(simulation.true_depth(0), expected, rtol=1e-5)
    side = wrong & (simulation.true_depth(0) > 1.7) & (simulation.true_depth(0) < 2.1)  # seen past the front
    assert not (wrong & ~side).any()
    assert side.sum() < 0.5 * on_box.sum()
    assert on_box.sum() > 500


def test_the_box_hides_the_wall_behind_it():
    simulation = Simulation("sim:box?axes=optical")
    low, high = simulation.scene.part("box")[0].bounds
    np.testing.assert_allclose([low, high], [[-0.235, -0.1825, 2], [0.235, 0.1825, 2.32]], atol=1e-9)
    assert len(simulation) >= 100
    np.testing.assert_array_equal(simulation.pose(0), simulation.pose(len(simulation) - 1))


def test_a_camera_that_stands_looks_once_but_its_noise_goes_on():
    simulation = Simulation(f"sim:box?{SMALL}")
    assert simulation.true_depth(0) is simulation.true_depth(7)
    assert not np.array_equal(simulation.frame(0).depth, simulation.frame(7).depth)
    with pytest.raises(ValueError, match="read-only"):
        simulation.true_depth(0)[0, 0] = 1


@pytest.mark.parametrize(("tilt", "turn"), [(0, 0), (4, 0), (0, -7), (6, 20), (25, 25)])
def test_a_wall_is_flat_fills_the_view_and_leans_as_asked(tilt, turn):
    simulation = Simulation(f"sim:wall?distance=1.4&tilt={tilt}&turn={turn}&image_width=101&axes=optical")
    depth = simulation.true_depth(0)
    points = simulation.camera.back_project(depth).reshape(-1, 3)
    (face,) = simulation.faces
    np.testing.assert_allclose((points - [0, 0, 1.4]) @ face.normal, 0, atol=1e-5)
    across, up = face.normal[0] / face.normal[2], face.normal[1] / face.normal[2]
    assert np.degrees(np.arctan(across)) == pytest.approx(-turn, abs=1e-6)
    assert np.degrees(np.arctan(up * np.cos(np.radians(turn)))) == pytest.approx(tilt, abs=1e-6)
    assert np.sign(round(float(depth[0, 50] - depth[-1, 50]), 5)) == np.sign(tilt)
    assert np.sign(round(float(depth[28, -1] - depth[28, 0]), 5)) == np.sign(turn)


def test_the_aisle_ends_where_it_should():
    standing, walking = Simulation(f"sim:aisle?{SMALL}"), Simulation(f"sim:aisle?{SMALL}&speed=2&length=9")
    middle = standing.camera.height // 2, standing.camera.width // 2
    assert standing.true_depth(100)[middle] == pytest.approx(11.9)
    far = np.asarray(Simulation("sim:aisle").frame(0).depth, float)[220:260, 410:440]
    assert 11_000 < np.median(far) < 13_000  # Chien trusted his up to 16 m
    assert walking.true_depth(0)[middle] == pytest.approx(8.9)
    assert walking.true_depth(len(walking) - 1)[middle] == pytest.approx(2.0, abs=1e-5)
    steps = np.diff([walking.pose(i)[0, 3] for i in range(len(walking))])
    np.testing.assert_allclose(steps, 2 / 30, rtol=0.02)
    left, right, _ = standing.faces
    assert left.corners[0, 1] - right.corners[0, 1] == pytest.approx(1.27)


def test_apartment_walls_stand_where_the_faces_say():
    simulation = Simulation("sim:apartment")
    solids = simulation.scene.part("walls")
    random = np.random.default_rng(0)
    for face in simulation.faces:
        a, b, _, d = face.corners
        shares = random.uniform(0.01, 0.99, (200, 2))
        points = a + shares[:, :1] * (b - a) + shares[:, 1:] * (d - a)
        behind, before = points - 0.01 * face.normal, points + 0.01 * face.normal
        in_wall = np.any([solid.contains(behind) for solid in solids], axis=0)
        assert in_wall.mean() > 0.55, face.name  # the rest: doors
        assert not np.any([solid.contains(before) for solid in solids]), face.name


def test_apartment_rooms_have_four_right_angles():
    faces = {face.name: face.normal for face in Simulation("sim:apartment").faces}
    assert len(faces) == 24
    for room in {name.rpartition(" ")[0] for name in faces}:
        west, east, south, north = (faces[f"{room} {side}"] for side in ("west", "east", "south", "north"))
        np.testing.assert_allclose([west @ south, north @ east], 0, atol=1e-12)
        np.testing.assert_allclose([west, south], [-east, -north], atol=1e-12)
        np.testing.assert_allclose(west, [1, 0, 0], atol=1e-12)


def test_the_walk_shows_every_wall():
    simulation = Simulation("sim:apartment?image_width=64&frames=180")
    points = np.concatenate([hits(simulation, i) for i in range(len(simulation))])
    for face in simulation.faces:
        a, b, _, d = face.corners
        on = points[np.abs((points - a) @ face.normal) < 0.003] - a
        along = on @ (b - a) / np.linalg.norm(b - a)
        up = on @ (d - a) / np.linalg.norm(d - a)
        heights, lengths = (along, up) if abs((b - a)[2]) > 1 else (up, along)
        wide = np.ptp(face.corners, axis=0)[:2].max()
        seen = np.unique(
            (lengths[(lengths > 0) & (lengths < wide) & (heights > 1.0) & (heights < 2.0)] / 0.1).astype(int)
        )
        assert len(seen) > 0.4 * wide / 0.1, face.name


def test_the_walk_is_level_at_first_slow_and_ends_where_it_began():
    simulation = Simulation("sim:apartment")
    assert 600 <= len(simulation) <= 950
    poses = np.array([simulation.pose(i) for i in range(len(simulation))])
    np.testing.assert_allclose(poses[0, :3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-12)
    np.testing.assert_allclose(poses[0, :2, 3], poses[-1, :2, 3], atol=1e-9)
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) * 15
    assert speed.max() < 1.4
    turns = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    assert np.degrees(np.arccos(((turns - 1) / 2).clip(-1, 1))).max() < 9
    assert simulation.frame(1).stamp_ns == 66_666_667


def test_the_flight_goes_out_and_back_at_even_speed():
    simulation = Simulation("sim:flight?length=90&speed=4")
    eyes = np.array([simulation.pose(i)[:3, 3] for i in range(len(simulation))])
    steps = np.linalg.norm(np.diff(eyes[:, :2], axis=0), axis=1)
    assert steps.sum() == pytest.approx(90, rel=1e-3)
    np.testing.assert_allclose(steps, 4 / 30, rtol=5e-3)
    np.testing.assert_allclose(eyes[[0, -1]], [[0, -2, 1.6], [0, 2, 1.6]], atol=1e-9)
    ahead = np.array([simulation.pose(i)[:3, 2] for i in range(len(simulation))])
    heading = np.diff(eyes[:, :2], axis=0) / steps[:, None]
    assert ((ahead[:-1, :2] * heading).sum(1) > 0.999).all()
    out, back = eyes[eyes[:, 1] == -2, 0], eyes[eyes[:, 1] > 1.999, 0]
    assert (out.min(), back.min()) == (0, pytest.approx(0, abs=1e-9))
    assert out.max() == pytest.approx(back.max(), abs=0.3)


def test_no_two_bays_of_the_flight_are_equal_but_all_have_the_same_things():
    simulation = Simulation("sim:flight?length=400")
    boxes = np.array([solid.bounds for solid in simulation.scene.part("boxes")])
    sizes = boxes[:, 1] - boxes[:, 0]
    assert len(np.unique(sizes.round(6), axis=0)) == len(sizes) >= 40
    again = Simulation("sim:flight?length=400").scene.triangles
    np.testing.assert_array_equal(simulation.scene.triangles, again)
    longer = Simulation("sim:flight?length=800").scene
    per_metre = [len(scene.solids) / np.ptp(scene.triangles[..., 0]) for scene in (simulation.scene, longer)]
    assert per_metre[0] == pytest.approx(per_metre[1], rel=0.03)


@pytest.mark.parametrize("drive", range(4))
def test_drives_through_the_town_stay_on_its_streets_at_even_speed(drive):
    simulation = Simulation(f"sim:town?drive={drive}&length=600&speed=8&blocks=3")
    poses = np.array([simulation.pose(i) for i in range(len(simulation))])
    eyes = poses[:, :3, 3] - town.SHIFT
    np.testing.assert_allclose(np.linalg.norm(np.diff(eyes, axis=0), axis=1), 0.8, rtol=5e-3)
    off_street = np.abs((eyes[:, :2] + 75 + 25) % 50 - 25)  # from the middle of the nearest streets
    assert off_street.min(axis=1).max() < 1.5 < off_street.max(axis=1).max()
    assert np.abs(eyes[:, :2]).max() < 80
    heading = np.diff(eyes[:, :2], axis=0) / 0.8
    assert ((poses[:-1, :2, 2] * heading).sum(1) > 0.99).all()
    assert len(np.unique(heading.round(3), axis=0)) > 20  # it has turned


def test_a_town_is_the_same_for_all_drives_and_another_for_another_seed():
    scenes = [Simulation(f"sim:town?blocks=2&{more}").scene for more in ("drive=0", "drive=5", "town=1")]
    np.testing.assert_array_equal(scenes[0].triangles, scenes[1].triangles)
    assert not np.array_equal(scenes[0].triangles[:900], scenes[2].triangles[:900])
    parts = {"ground", "pavements", "houses", "lamps", "trees", "signs", "bollards", "cars"}
    assert set(scenes[0].parts()) == parts == set(scenes[2].parts())
    houses = np.array([solid.bounds for solid in scenes[0].part("houses")])
    assert (np.ptp(houses, axis=1) > 0.29).all()


def test_rectangles_face_the_way_they_should():
    for axis in range(3):
        for sign in (1.0, -1.0):
            towards = tuple(sign if k == axis else 0.0 for k in range(3))
            high = tuple(0.0 if k == axis else 2.0 + k for k in range(3))
            face = rectangle("side", (0, 0, 0), high, towards)
            np.testing.assert_allclose(face.normal, towards, atol=1e-12)
            assert len(np.unique(face.corners, axis=0)) == 4
