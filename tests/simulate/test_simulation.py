# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.errors import SourceError
from stereovox.frame import Reason
from stereovox.geometry.se3 import look_at, rigidity_error, transform_points
from stereovox.opening import open_source
from stereovox.simulate.d435 import CAMERA, D435, beside_nearer_surface, hidden_from_right_eye
from stereovox.simulate.scene import Scene, box, cylinder
from stereovox.simulate.simulation import Simulation

SHAPE = (CAMERA.height, CAMERA.width)


@pytest.fixture(scope="module")
def simulation():
    return Simulation()


def test_the_source_says_what_it_is(simulation):
    assert Simulation.recognises("sim:room")
    assert not Simulation.recognises("recording/")
    assert simulation.name == "sim:room"
    assert len(simulation) >= 150
    assert (simulation.camera.width, simulation.camera.height, simulation.camera.baseline) == (848, 480, 0.05)
    assert simulation.camera.fx == pytest.approx(415.2, abs=0.1)


def test_unknown_scene_is_one_line_with_the_cure():
    with pytest.raises(SourceError, match=r"sim:rom.*did you mean 'room'"):
        Simulation("sim:rom")


def test_frames_do_not_depend_on_the_order_they_are_asked_for(simulation):
    first = simulation.frame(7)
    simulation.frame(3)
    again, other = simulation.frame(7), Simulation().frame(7)
    for frame in (again, other):
        np.testing.assert_array_equal(first.depth, frame.depth)
        np.testing.assert_array_equal(first.reason, frame.reason)
    assert not np.array_equal(first.depth, simulation.frame(8).depth)
    assert not np.array_equal(first.depth, Simulation(seed=1).frame(7).depth)


def test_it_opens_like_any_recording():
    picked = open_source("sim:room", "100:-100:20")
    assert [frame.name for frame in picked] == [f"sim:room frame {i}" for i in (100, 120)]
    np.testing.assert_array_equal(open_source("sim:room").frame(-140).depth, picked.frame(0).depth)


def test_frames_look_like_a_d435s(simulation):
    frame = simulation.frame(60)
    assert frame.depth.dtype == np.uint16
    assert frame.depth.shape == SHAPE
    assert frame.depth_scale == 0.001
    np.testing.assert_array_equal(frame.depth > 0, frame.reason == Reason.VALID)
    assert 0.005 < (frame.reason == Reason.UNMATCHED).mean() < 0.2
    assert (frame.reason == Reason.TOO_FAR).mean() > 0.01  # the window
    assert simulation.frame(61).stamp_ns - frame.stamp_ns == 33_333_333


def test_the_path_is_rigid_and_smooth(simulation):
    poses = np.array([simulation.pose(i) for i in range(len(simulation))])
    assert max(rigidity_error(T) for T in poses) < 1e-9
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.15
    turns = np.einsum("nij,nij->n", poses[1:, :3, :3], poses[:-1, :3, :3])
    assert np.degrees(np.arccos((turns.clip(-1, 3) - 1) / 2)).max() < 7
    for asked in (simulation.pose, simulation.frame):
        with pytest.raises(IndexError):
            asked(len(simulation))


def test_the_camera_never_flies_through_things(simulation):
    eyes = np.array([simulation.pose(i)[:3, 3] for i in range(len(simulation))])
    assert not any(solid.contains(eyes, margin=0.1).any() for solid in simulation.scene.solids)


def test_noise_free_frames_hold_the_exact_depth(simulation):
    exact, frame = simulation.true_depth(60), Simulation(noise=False).frame(60)
    valid = frame.reason == Reason.VALID
    np.testing.assert_array_equal(frame.depth[valid], exact[valid])
    assert (exact[frame.reason == Reason.TOO_FAR] > 10).all()
    assert not (frame.reason == Reason.UNMATCHED).any()


def test_rays_meet_a_box_where_geometry_says():
    scene = Scene([box("walls", "wall", (2.0, -5, -5), (2.5, 5, 5))])
    x, y = CAMERA.ray_slopes()
    T = look_at([0.0, 0, 0], [1.0, 0, 0])
    slopes = np.stack([x[[0, 424, 847]], y[[0, 240, 479]], np.ones(3, np.float32)], axis=1)
    np.testing.assert_allclose(scene.cast(T[:3, 3], slopes @ T[:3, :3].T), 2.0, rtol=1e-6)
    assert np.isinf(scene.cast([0, 0, 0], np.array([[-1.0, 0, 0]]))).all()


def test_a_turned_solid_is_convex_and_turned_about_its_middle():
    solid = box("chairs", "seat", (1, 1, 0), (2, 1.5, 0.1), turn=np.pi / 2)
    np.testing.assert_allclose(solid.bounds, [[1.25, 0.75, 0], [1.75, 1.75, 0.1]], atol=1e-12)
    bar = cylinder("poles", "pole", (0, 0, 0), (0, 0, 1), 0.04)
    assert bar.contains([[0.019, 0, 0.5], [0, 0, 1.0]]).all()
    assert not bar.contains([[0.021, 0, 0.5], [0, 0, 1.01]]).any()


def test_disparity_noise_has_the_stated_sigma_and_no_bias():
    depth, reason = D435().measure(np.full(SHAPE, 2.0, np.float32), seed=1)
    valid = reason == Reason.VALID
    disparity = CAMERA.fx * 0.05 / (depth[valid] * 0.001)
    assert valid.mean() > 0.95
    assert disparity.std() == pytest.approx(0.08, rel=0.05)
    assert disparity.mean() == pytest.approx(CAMERA.fx * 0.05 / 2.0, abs=0.002)


def test_noise_is_independent_between_neighbours():
    depth, _ = D435().measure(np.full(SHAPE, 2.0, np.float32), seed=2)
    inner = depth[:, 20:].astype(float)
    assert abs(np.corrcoef(inner[:, 1:].ravel(), inner[:, :-1].ravel())[0, 1]) < 0.01


def test_near_and_far_get_their_own_reasons():
    camera = D435()
    assert (camera.measure(np.full(SHAPE, 0.15, np.float32), seed=0)[1] == Reason.TOO_NEAR).all()
    _, reason = camera.measure(np.full(SHAPE, np.inf, np.float32), seed=0)
    assert (reason == Reason.TOO_FAR).mean() > 0.99  # the rest: the right eye sees nothing of the left margin
    assert (camera.measure(np.full(SHAPE, 20.0, np.float32), seed=0)[1] == Reason.TOO_FAR).mean() > 0.99


def test_the_right_eye_misses_the_background_left_of_a_near_thing():
    truth = np.full((20, 200), 4.0, np.float32)
    truth[:, 100:140] = 1.0
    disparity = CAMERA.fx * 0.05 / truth
    hidden = hidden_from_right_eye(disparity)[10]
    shift = int(disparity[0, 100] - disparity[0, 0])  # 15 pixels
    assert hidden[100 - shift + 1 : 99].all()
    assert not hidden[100:].any()
    assert not hidden[int(disparity[0, 0]) + 1 : 100 - shift - 2].any()
    assert hidden[: int(disparity[0, 0])].all()  # left of the right eye's image


def test_a_thin_pole_hides_a_strip_as_wide_as_itself():
    truth = np.full((5, 200), 4.0, np.float32)
    truth[:, 100:104] = 1.0
    hidden = hidden_from_right_eye(CAMERA.fx * 0.05 / truth)[2, 20:]
    assert 3 <= hidden.sum() <= 6
    assert hidden[100 - 20 - 15 : 100 - 20 - 10].any()


def test_only_the_background_beside_an_edge_loses_its_match():
    disparity = np.full((9, 9), 5.0, np.float32)
    disparity[:, 4] = 9.0
    lost = beside_nearer_surface(disparity, 2)
    np.testing.assert_array_equal(lost, np.tile([0, 0, 1, 1, 0, 1, 1, 0, 0], (9, 1)).astype(bool))


def test_measured_points_lie_on_the_scenes_surfaces(simulation):
    frame = simulation.frame(200)
    depth = np.where(frame.reason == Reason.VALID, frame.depth * 0.001, np.nan)
    points = frame.camera.back_project(depth).reshape(-1, 3)
    near = points[points[:, 2] < 1.5]
    world = transform_points(frame.T_world_sensor, near)[::50]
    in_solid = np.any([solid.contains(world, margin=0.06) for solid in simulation.scene.solids], axis=0)
    deep = np.any([solid.contains(world, margin=-0.06) for solid in simulation.scene.solids], axis=0)
    assert in_solid.mean() > 0.99
    assert deep.mean() < 0.01


def test_what_is_too_far_is_free_as_far_as_the_camera_measures_and_no_farther():
    frame = open_source("sim:room").frame(60)
    assert (frame.reason == Reason.TOO_FAR).mean() > 0.01
    for max_range, kept in ((9.9, True), (10.0, True), (10.1, False)):
        reason = prepare(frame, load_config(max_range=max_range)).reason
        told = reason[frame.reason == Reason.TOO_FAR]
        assert (told == (Reason.TOO_FAR if kept else Reason.UNKNOWN)).all()


def test_fewer_frames_are_as_long_apart_as_the_way_takes():
    """Else a drone would seem to fly ten times as fast, and no gate would let it pass."""
    all_of_them, few = Simulation(), Simulation(frames=20)
    assert few.frame(19).stamp_ns == pytest.approx(all_of_them.frame(-1).stamp_ns, abs=1000)
    np.testing.assert_allclose(few.upright_pose_at(few.frame(7).stamp_ns), few.pose(7), atol=1e-6)
