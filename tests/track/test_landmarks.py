# SPDX-License-Identifier: Apache-2.0
"""Landmarks of stereo pairs: derivatives against finite differences, and small photographs from exact poses."""

from dataclasses import replace
from functools import lru_cache

import naive_tracking as naive
import numpy as np
import pytest
from made_photographs import BASELINE, CAMERA, LENS, PAIR, STEP_NS, corner, photographs, way, with_sticker
from made_tracks import simulated, track

from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.track.landmarks import DISPARITY
from stereovox.track.sightings import ALIKE, PIXEL, Corners, Sightings
from stereovox.track.tracker import Tracker

DEVIATION = DISPARITY / LENS.fx / BASELINE
"""Of an inverse depth, in 1/m."""
METRES, DEGREES = 0.03, 0.5
"""Bounds of the errors of 20 images, 1.2 m and 16 degrees."""


@lru_cache(maxsize=4)
def pairs(steps=20, x=0.0, seed=0):
    return photographs(corner(x), way(steps, x), seed=seed)


def at_even_times(taken):
    """Return frames with stamps of an even rate."""
    return [replace(frame, stamp_ns=i * STEP_NS) for i, frame in enumerate(taken)]


def dark(frame):
    return replace(frame, left=np.zeros_like(frame.left), right=np.zeros_like(frame.right))


def tracked(frames):
    return track(frames, Tracker(start=frames[0].T_world_sensor))


def pose(random):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(random.uniform(-1, 1, 3)), random.uniform(-3, 3, 3)
    return T


def some_corners(number, seed):
    """Return landmarks, a pose near that from which they were first seen, and what a pair there measures."""
    random = np.random.default_rng(seed)
    first, near = pose(random), np.eye(4)
    near[:3, :3], near[:3, 3] = rotation_matrix(random.uniform(-0.1, 0.1, 3)), random.uniform(-0.2, 0.2, 3)
    ray = np.column_stack([random.uniform(-0.7, 0.7, (number, 2)), np.ones(number)]) @ first[:3, :3].T
    centre, inverse = np.tile(first[:3, 3], (number, 1)), random.uniform(0.1, 1.0, number)
    variance = random.uniform(0.001, 0.02, number) ** 2
    corners = Corners(np.zeros((number, 2), np.float32), centre, ray, inverse, variance, np.ones(number))
    measured = random.uniform(0, 100, (number, 3)) * (1, 1, 0.01)
    return corners, measured, first @ near


def places(corners, T, inverse=None):
    inverse = corners.inverse if inverse is None else inverse
    points = corners.centre + corners.ray / inverse[:, None]
    return np.array([naive.seen_at(p, T, LENS) for p in points])


def sightings(corners, measured):
    return Sightings(CAMERA, corners, measured, np.full(len(corners), DEVIATION))


def moved(T, motion):
    out = T.copy()
    out[:3, :3], out[:3, 3] = rotation_matrix(motion[:3]) @ T[:3, :3], T[:3, 3] + motion[3:]
    return out


def test_residuals_and_their_derivatives_are_those_of_the_projection():
    corners, measured, T = some_corners(40, 1)
    squares, off, weight, by_motion, by_inverse = sightings(corners, measured).residuals(T)
    np.testing.assert_allclose(off, measured - places(corners, T), atol=1e-8)
    step = 1e-6
    slopes = [
        (places(corners, moved(T, step * k)) - places(corners, moved(T, -step * k))) / 2 / step for k in np.eye(6)
    ]
    np.testing.assert_allclose(by_motion, np.stack(slopes, axis=2), rtol=1e-5, atol=1e-4)
    more, less = (places(corners, T, corners.inverse + sign * step) for sign in (1, -1))
    np.testing.assert_allclose(by_inverse, (more - less) / 2 / step, rtol=1e-5, atol=1e-4)
    own = np.diag([2 * PIXEL**2, 2 * PIXEL**2, DEVIATION**2])
    for k in range(40):
        covariance = own + corners.variance[k] * np.outer(by_inverse[k], by_inverse[k])
        np.testing.assert_allclose(weight[k] @ covariance, np.eye(3), atol=1e-9)
        assert squares[k] == pytest.approx(off[k] @ np.linalg.solve(covariance, off[k]))


@pytest.mark.parametrize("reach", [9.0, 1e2, 1e5])
def test_equations_are_the_weighted_sums_of_the_residuals(reach):
    corners, measured, T = some_corners(60, 3)
    seen = sightings(corners, places(corners, T) + np.random.default_rng(4).normal(0, (2, 2, 0.02), measured.shape))
    squares, off, weight, by_motion, _ = seen.residuals(T)
    weight = weight / (ALIKE * (1 + squares / reach) ** 2)[:, None, None]
    by_all = np.swapaxes(by_motion, 1, 2) @ weight
    information, gradient = seen.equations(reach)(T)
    np.testing.assert_allclose(information, (by_all @ by_motion).sum(axis=0), rtol=1e-8)
    np.testing.assert_allclose(gradient, (by_all @ off[:, :, None]).sum(axis=0)[:, 0], rtol=1e-8)


def test_equations_lead_to_the_pose_from_which_the_landmarks_are_seen():
    corners, _, T = some_corners(40, 2)
    equations = sightings(corners, places(corners, T)).equations(100.0)
    off = np.array([0.01, -0.02, 0.01, 0.05, -0.04, 0.03])
    at = moved(T, off)
    for _ in range(8):
        information, gradient = equations(at)
        at = moved(at, np.linalg.solve(information, gradient))
    assert at == pytest.approx(T, abs=1e-6)
    assert equations(at)[1] == pytest.approx(0, abs=1e-3)


def test_looks_improve_the_distance_of_a_landmark():
    random = np.random.default_rng(3)
    corners, _, T = some_corners(60, 3)
    true = corners.inverse.copy()
    corners.variance[:] = DEVIATION**2
    corners.inverse = true + np.sqrt(corners.variance) * random.standard_normal(60)
    before = corners.inverse - true
    after = sightings(corners, places(corners, T, true)).improved(T)
    assert len(after) > 50
    kept = np.isin(corners.centre[:, 0] + corners.ray[:, 0], after.centre[:, 0] + after.ray[:, 0])
    assert np.std(after.inverse - true[kept]) < 0.7 * np.std(before[kept])
    assert np.all(after.looks == 2)


def test_poses_are_right_and_no_worse_than_their_covariances_say():
    nees = []
    for seed in range(2):
        found = tracked(pairs(seed=seed))
        assert found.lost == [0]
        assert np.all(found.errors() < (METRES, DEGREES))
        nees.extend(found.nees())
    assert 0.003 < np.mean(nees) < 2
    sigma = np.sqrt(np.diag(found.found[-1].covariance))
    assert np.all(sigma[:3] < np.radians(0.5))
    assert np.all(sigma[3:] < 0.02)


def test_the_same_pairs_give_the_same_poses_whatever_poses_they_bring():
    taken = pairs()[:8]
    wrong = [replace(frame, T_world_sensor=frame.T_world_sensor + 5) for frame in taken]
    by = Tracker(start=taken[0].T_world_sensor)
    for one, other in zip(tracked(taken).found, map(by.add, wrong), strict=True):
        assert np.array_equal(one.T_world_sensor, other.T_world_sensor)
        assert one.lost == other.lost


@pytest.mark.parametrize("missing", [1, 4])
def test_over_missing_images_the_camera_is_taken_to_move_evenly(missing):
    found = tracked([*pairs()[:8], *pairs()[8 + missing :]])
    assert found.lost == [0]
    assert np.all(found.errors() < (METRES, DEGREES))


def test_after_darkness_it_is_found_again_by_the_looks_of_a_view():
    """What was kept is a second and half a metre ago; the image is another one, with its own noise."""
    found = tracked(at_even_times([*pairs()[:12], *map(dark, pairs()[:4]), *pairs(12, seed=1)]))
    assert set(range(12, 16)) <= set(found.lost)
    assert all(one.lost for one in found.found[16:21])
    assert set(range(23, 28)) <= set(found.tracked)
    assert np.all(found.errors() < (METRES, DEGREES))


def test_in_a_place_of_the_same_shape_with_other_looks_it_is_lost_and_stays_so():
    found = tracked(at_even_times([*pairs()[:8], *pairs(12, x=60.0)]))
    assert found.tracked == list(range(1, 8))


def test_images_of_noise_are_lost():
    random = np.random.default_rng(0)
    grey = [(120 + 2 * random.standard_normal((2, *frame.left.shape))).astype(np.uint8) for frame in pairs()[:6]]
    found = tracked([replace(f, left=a, right=b) for f, (a, b) in zip(pairs(), grey, strict=False)])
    assert found.tracked == []


def masked(frames, valid):
    return [replace(frame, pair=replace(PAIR, valid=valid)) for frame in frames]


def test_what_a_mask_hides_is_not_used():
    """Something that moves with the camera fills the lowest two fifths: what it says is that the camera stands."""
    valid = np.ones((LENS.height, LENS.width), bool)
    valid[-56:] = False
    hidden = [with_sticker(frame, 56, 10) for frame in pairs()]
    found = tracked(masked(hidden, valid))
    assert found.lost == [0]
    assert np.all(found.errors() < (0.04, 1))
    assert tracked(hidden).errors()[-1, 0] > 0.5  # the mask does it


def test_no_landmark_is_followed_behind_a_mask():
    valid = np.ones((LENS.height, LENS.width), bool)
    valid[:, 150:] = False
    by = Tracker(start=pairs()[0].T_world_sensor)
    for frame in masked(pairs(), valid):
        by.add(frame)
        columns, rows = np.rint(by._evidence._landmarks._corners.pixels).astype(int).T
        assert len(columns) > 30
        assert np.all(valid[rows, columns])


def test_a_depth_image_among_pairs_is_lost():
    taken = pairs()[:4]
    found = tracked([*taken[:2], simulated("room").frame(0), *taken[2:]])
    assert "no stereo pair" in found.found[2].lost


def test_pairs_of_another_camera_and_with_a_mask_of_another_size_are_lost():
    frames = pairs(4)
    camera = replace(PAIR.camera, fx=1.3 * PAIR.camera.fx)
    wider = replace(frames[2], pair=replace(PAIR, camera=camera))
    masked_off = replace(frames[3], pair=replace(PAIR, valid=np.ones((3, 3), bool)))
    by = Tracker()
    said = [by.add(frame).lost for frame in (*frames[:2], wider, masked_off)]
    assert not said[1]
    assert "another camera" in said[2]
    assert "mask" in said[3]


def test_a_pair_without_a_baseline_is_refused():
    pair = replace(PAIR, camera=replace(PAIR.camera, baseline=None))
    with pytest.raises(StereovoxError, match="baseline"):
        Tracker().add(replace(pairs(1)[0], pair=pair))
