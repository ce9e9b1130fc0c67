# SPDX-License-Identifier: Apache-2.0
"""The steps of the calibration of a camera pair, each against a truth that shares no code with it."""

from __future__ import annotations

import builtins

import made_pairs as made
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.calibrate.odometry import CameraMotion, camera_motion
from stereovox.calibrate.pair import check_turning, hand_eye, reduced_points
from stereovox.calibrate.tracker import PoseTrack, find_offsets
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import MissingExtra, StereovoxError
from stereovox.frame import DepthImage, Reason
from stereovox.geometry.se3 import inverse
from stereovox.sources.poses.poses import Poses

RANDOM = np.random.default_rng(5)


def motions(count, axes=(1.0, 1.0, 1.0), size=0.5):
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(size * RANDOM.standard_normal((count, 3)) * axes).as_matrix()
    T[:, :3, 3] = RANDOM.standard_normal((count, 3))
    return T


def test_hand_eye_is_exact_without_noise_and_ignores_outliers():
    X = made.T_TRACKER_CAMERA
    B = motions(30)
    A = X @ B @ inverse(X)
    np.testing.assert_allclose(hand_eye(A, B), X, atol=1e-9)
    A[:4] = motions(4)
    np.testing.assert_allclose(hand_eye(A, B), X, atol=1e-9)


def test_turning_about_two_axes_is_needed():
    check_turning(0.3 * RANDOM.standard_normal((50, 3)) * [1, 0.3, 0])
    with pytest.raises(StereovoxError, match="one axis only"):
        check_turning(0.3 * RANDOM.standard_normal((50, 3)) * [0.02, 1, 0.02])
    with pytest.raises(StereovoxError, match="too small"):
        check_turning(0.01 * RANDOM.standard_normal((50, 3)))


def wall(camera, slope=0.0, offset=2.0):
    """Exact depth of the plane z = offset + slope x, by hand from the rays."""
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    return np.tile(offset / (1 - slope * x), (camera.height, 1)).astype(np.float32)


@pytest.mark.parametrize("width", [100, 848])
def test_points_lie_on_the_slanted_wall_they_come_from(width):
    camera = PinholeCamera.from_field_of_view(width, width // 2, 90.0)
    depth = wall(camera, slope=0.6)
    points = reduced_points(DepthImage(depth, np.zeros(depth.shape, np.uint8), camera, np.eye(4)), 4.0)
    assert 0.3 * 106 * 53 < len(points) <= 106 * 53
    np.testing.assert_allclose(points[:, 2], 2.0 + 0.6 * points[:, 0], rtol=1e-5)
    assert points[:, 2].max() <= 4.0
    assert depth.max() > 4.5


def test_blocks_across_an_edge_and_without_values_give_no_point():
    camera = PinholeCamera.from_field_of_view(848, 480, 90.0)
    depth = np.full((480, 848), 2.0, np.float32)
    depth[:, 404:] = 3.0  # in the middle of a block
    reason = np.zeros(depth.shape, np.uint8)
    reason[:240], depth[:240] = Reason.UNMATCHED, np.nan
    points = reduced_points(DepthImage(depth, reason, camera, np.eye(4)), 5.0)
    assert len(points) == 105 * 30
    np.testing.assert_allclose(np.unique(points[:, 2].round(5)), [2, 3])


@pytest.fixture(scope="module")
def clouds():
    made.WIDTH, width = 212, made.WIDTH
    try:
        seconds, _ = made.times(12, 10)
        images = made.depth_images([made.waved(t) for t in seconds])
        camera = made.depth_camera(212)
    finally:
        made.WIDTH = width
    return [
        reduced_points(DepthImage((i / 1000).astype(np.float32), (i == 0).astype(np.uint8), camera, np.eye(4)), 5.0)
        for i in images
    ]


def test_the_camera_moves_as_it_did(clouds):
    seconds, stamps = made.times(12, 10)
    motion = camera_motion(zip(stamps, clouds, strict=True))
    assert motion.reference[0] == -1
    assert (motion.reference[1:] >= 0).all()
    for i in range(1, 12):
        true = inverse(made.waved(seconds[motion.reference[i]])) @ made.waved(seconds[i])
        error = inverse(motion.T_reference_camera[i]) @ true
        assert np.linalg.norm(error[:3, 3]) < 0.01
        assert Rotation.from_matrix(error[:3, :3]).magnitude() < np.radians(0.4)
        assert 1e-3 < np.sqrt(motion.covariance[i, 3, 3]) < 0.02
    step = inverse(made.waved(seconds[6])) @ made.waved(seconds[7])
    np.testing.assert_allclose(motion.steps[6], step, atol=0.02)


def test_an_image_without_points_starts_anew(clouds):
    _, stamps = made.times(12, 10)
    motion = camera_motion(zip(stamps, [*clouds[:5], np.empty((0, 3)), *clouds[6:]], strict=True))
    assert motion.reference[5:7].tolist() == [-1, -1]
    assert motion.reference[7] == 6
    assert np.isnan(motion.steps[4:6]).all()
    assert np.isfinite(motion.steps[6]).all()


def test_one_wall_says_nothing_about_sliding():
    x, y = np.meshgrid(np.linspace(-2, 2, 60), np.linspace(-1, 1, 40))
    flat = np.stack([x, y, np.full(x.shape, 2.0)], axis=-1).reshape(-1, 3)
    motion = camera_motion((k, flat + 0.002 * RANDOM.standard_normal(flat.shape)) for k in range(4))
    assert (motion.reference == -1).all()


def test_without_small_gicp_the_cure_is_told(monkeypatch):
    usual = builtins.__import__

    def without(name, *rest, **more):
        if name.startswith("small_gicp"):
            raise ImportError(name)
        return usual(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtra, match=r"stereovox\[pair\]"):
        camera_motion([])


def swung(seconds):
    """Turns about z whose speed never repeats itself."""
    angle = np.sin(1.3 * seconds) + 0.5 * np.sin(3.1 * seconds + 1) + 0.3 * np.sin(0.7 * seconds**1.5)
    T = np.tile(np.eye(4), (len(seconds), 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(np.outer(angle, [0, 0, 1])).as_matrix()
    return T


def camera_track(seconds, T, noise=0.0):
    """What `camera_motion` returns for a camera that sees its steps."""
    steps = np.linalg.inv(T[:-1]) @ T[1:]
    if noise:
        steps[:, :3, :3] = (
            steps[:, :3, :3] @ Rotation.from_rotvec(noise * RANDOM.standard_normal((len(steps), 3))).as_matrix()
        )
    none = np.full((1, 4, 4), np.nan)
    reference = np.arange(-1, len(T) - 1)
    return CameraMotion(np.rint(seconds * 1e9).astype(np.int64), reference, np.concatenate([none, steps]), np.zeros(0))


@pytest.mark.parametrize("offset", [-4.321, 0.0, 2.345])
def test_the_clock_offset_is_that_of_the_motion(offset):
    camera_seconds, track_seconds = np.arange(5, 15, 1 / 15), np.arange(3, 17, 1 / 200)
    X = made.T_TRACKER_CAMERA  # it plays no part
    camera = camera_track(camera_seconds, swung(camera_seconds), noise=0.003)
    poses = swung(track_seconds) @ np.linalg.inv(X)
    track = PoseTrack(Poses(np.rint((track_seconds - offset) * 1e9).astype(np.int64), poses), 2, 10, 720)
    starts = (int(camera.stamps_ns[0]) - track.start_ns) / 1e9
    found = find_offsets(camera, track)[0]
    assert found.seconds + starts == pytest.approx(offset, abs=0.01)
    assert found.correlation > 0.95
    near = find_offsets(camera, track, (found.seconds - 0.1, found.seconds + 0.1))
    assert len(near) == 1
    with pytest.raises(StereovoxError, match="clocks"):
        find_offsets(camera, track, (found.seconds + 1000, found.seconds + 1001))


def test_recordings_that_have_nothing_in_common_are_refused():
    a, b = np.arange(0, 8, 1 / 15), np.arange(100, 108, 1 / 200)
    poses = swung(b * np.pi)
    track = PoseTrack(Poses(np.rint(b * 1e9).astype(np.int64), poses), 2, 10, 7200)
    with pytest.raises(StereovoxError, match="do not overlap"):
        find_offsets(camera_track(a, swung(a)), track)


@pytest.mark.parametrize("seconds", [np.zeros(60), -np.arange(60) / 15, np.append(-1e9, np.arange(59) / 15)])
def test_times_that_cannot_be_are_refused_before_they_fill_the_memory(seconds):
    right = np.arange(0, 4, 1 / 15)
    track = PoseTrack(Poses(np.rint(right * 1e9).astype(np.int64), swung(right)), 2, 10, 7200)
    with pytest.raises(StereovoxError, match=r"clocks: the images span .* wrong time"):
        find_offsets(camera_track(seconds, swung(np.arange(60) / 15)), track)


def test_a_track_interpolates_as_poses_do_and_breaks_at_jumps_and_gaps():
    seconds = np.concatenate([np.arange(0, 1, 0.05), np.arange(1.5, 2.5, 0.05)])
    T = swung(seconds)
    T[:, 0, 3] = np.sin(seconds)
    T[30:, 0, 3] += 2.0  # a jump after 1.95 s
    stamps = np.rint(seconds * 1e9).astype(np.int64)
    poses = Poses(stamps, T)
    track = PoseTrack(poses, 2, 10, 720)
    for time in (0.0, 0.33, 0.95, 1.72, 2.4):
        np.testing.assert_allclose(track.at(np.array([time]))[0], poses.at(round(time * 1e9)), atol=1e-9)
    assert track.parts(np.array([-0.1, 0.3, 1.2, 1.6, 1.97, 2.2, 2.6])).tolist() == [-1, 0, -1, 0, -1, 1, -1]
    with pytest.raises(StereovoxError, match="fewer than two poses"):
        PoseTrack(Poses(stamps, T, np.ones(len(stamps))), 2, 10, 720)


def test_trembling_is_smoothed_without_delay():
    seconds = np.arange(0, 4, 0.005)
    T = swung(seconds)
    trembling = T.copy()
    trembling[:, :3, 3] += 0.002 * RANDOM.standard_normal((len(T), 3))
    track = PoseTrack(Poses(np.rint(seconds * 1e9).astype(np.int64), trembling), 2, 10, 720)
    found = track.at(seconds[50:-50])
    assert np.std(found[:, :3, 3]) < 0.0012
    angles = Rotation.from_matrix(np.swapaxes(T[50:-50, :3, :3], 1, 2) @ found[:, :3, :3]).magnitude()
    assert angles.max() < 1e-3


def test_the_step_between_two_images_of_one_reference_is_seen_from_the_first_of_them():
    T = np.tile(np.eye(4), (4, 1, 1))
    T[:, :3, :3] = Rotation.from_euler("zyx", np.arange(12).reshape(4, 3) / 9).as_matrix()
    T[:, :3, 3] = np.arange(12).reshape(4, 3) ** 2 / 50
    motion = CameraMotion(np.arange(4), np.array([-1, 0, 0, -1]), T, np.zeros((4, 6, 6)))
    first, between, lost = motion.steps
    np.testing.assert_array_equal(first, T[1])
    np.testing.assert_allclose(T[1] @ between, T[2], atol=1e-12)
    assert np.isnan(lost).all()
