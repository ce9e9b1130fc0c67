# SPDX-License-Identifier: Apache-2.0
"""Images that depth cameras take along: depths of their pixels, and poses where depth alone says too little."""

from dataclasses import replace
from functools import lru_cache

import naive_tracking as naive
import numpy as np
import pytest
from made_tracks import CAMERA, LENS, PHOTO_CAMERA, T_DEPTH_PHOTO, aside, covered, hall, pictured, seen, track

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage, Photo
from stereovox.geometry.se3 import rotation_matrix
from stereovox.opening import open_source
from stereovox.simulate.scene import Scene, cylinder
from stereovox.track.color_images import PhotoLandmarks, inverse_depths
from stereovox.track.sightings import Corners, Sightings
from stereovox.track.tracker import Tracker

METRES, DEGREES = 0.02, 0.5
"""Bounds of the errors of 20 images."""
WALL = Scene(hall([]).solids[:1])
EXACT = np.zeros(1)
"""Standard deviations of depths without noise."""
BAYS = hall([(3 * k - 6, 0.12 * k) for k in range(6)])


@lru_cache(maxsize=4)
def before_a_wall(contrast=0.5, seed=0):
    return pictured(seen(WALL, aside(20), seed), WALL, seed, contrast)


def slanted(jump=0.0):
    """Return the depths of a plane that is seen from its side; beyond the middle column it lies farther by a jump."""
    x, y = CAMERA.ray_slopes()
    depth = 1 / (0.4 + 0.25 * x[None, :] + 0.1 * y[:, None])
    depth[:, CAMERA.width // 2 :] += jump
    return DepthImage(depth.astype(np.float32), np.zeros(depth.shape, np.uint8), CAMERA, np.eye(4))


def test_inverse_depths_in_another_image_are_those_of_the_surface():
    image = slanted()
    cell_px, found = inverse_depths(image, PHOTO_CAMERA, T_DEPTH_PHOTO, EXACT, 1.0)
    true = naive.inverse_depth_of_plane(np.array([0.25, 0.1, 0.4]), T_DEPTH_PHOTO, LENS, cell_px, found.shape)
    measured = found > 0
    assert measured.mean() > 0.7
    inner = np.zeros_like(measured)
    inner[3:-3, 3:-3] = measured[3:-3, 3:-3]
    np.testing.assert_allclose(found[inner], true[inner], rtol=0.02)


def test_beside_an_edge_no_depth_is_taken():
    cell_px, found = inverse_depths(slanted(jump=1.0), PHOTO_CAMERA, np.eye(4), EXACT, 1.0)
    _, flat = inverse_depths(slanted(), PHOTO_CAMERA, np.eye(4), EXACT, 1.0)
    edge = int((PHOTO_CAMERA.cx + 0.5) / cell_px)
    assert not found[:, edge - 1 : edge + 1].any()
    assert (flat[:, edge - 1 : edge + 1] > 0).mean() > 0.9
    assert (found[:, : edge - 6] > 0).mean() > 0.8


def test_equations_of_a_camera_that_is_carried_lead_to_the_pose_of_what_carries_it():
    random, T_sensor_camera = np.random.default_rng(0), np.eye(4)
    T_sensor_camera[:3, :3], T_sensor_camera[:3, 3] = rotation_matrix([0.1, -0.2, 0.05]), (0.3, -0.1, 0.2)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0.3, 0.1, -0.2]), (1, 2, 3)
    at = T @ T_sensor_camera
    ray = np.column_stack([random.uniform(-0.7, 0.7, (50, 2)), np.ones(50)]) @ at[:3, :3].T
    inverse = random.uniform(0.2, 1, 50)
    corners = Corners(np.zeros((50, 2), np.float32), np.tile(at[:3, 3], (50, 1)), ray, inverse, np.full(50, 1e-5))
    measured = np.array([(*naive.seen_at(p, at, LENS),) for p in corners.points])
    equations = PhotoLandmarks(
        Sightings(PHOTO_CAMERA, corners, measured, np.full(50, 0.003), 50), T_sensor_camera, np.zeros((6, 6))
    ).equations()
    off = T.copy()
    off[:3, :3], off[:3, 3] = rotation_matrix([0.01, -0.02, 0.01]) @ T[:3, :3], T[:3, 3] + (0.03, -0.02, 0.01)
    for _ in range(8):
        information, gradient = equations(off)
        motion = np.linalg.solve(information, gradient)
        off[:3, :3], off[:3, 3] = rotation_matrix(motion[:3]) @ off[:3, :3], off[:3, 3] + motion[3:]
    assert off == pytest.approx(T, abs=1e-5)


@pytest.mark.parametrize("seed", [0, 1])
def test_before_a_wall_with_a_pattern_poses_are_right_and_errors_as_their_covariances_say(seed):
    frames = before_a_wall(seed=seed)
    found = track(frames)
    assert found.lost == [0]
    assert np.all(found.errors() < (METRES, DEGREES))
    assert 0.02 < np.mean(found.nees()) < 2
    assert track([replace(frame, photo=None) for frame in frames]).tracked == []  # the image does it


def test_where_depth_leaves_the_pose_open_pictures_hold_it():
    """Along walls of an apartment: what depth holds less than nothing of must not be taken off what pictures hold."""
    frames = list(open_source("sim:apartment?image_width=212&photo=0.3", "225:285"))
    tracker = Tracker(start=frames[0].T_world_sensor)
    found = [tracker.add(frame) for frame in frames]
    assert [i for i, one in enumerate(found) if one.lost] == [0]
    for frame, one in zip(frames, found, strict=True):
        assert np.linalg.norm(one.T_world_sensor[:3, 3] - frame.T_world_sensor[:3, 3]) < 0.03


def test_before_a_bare_wall_images_of_noise_hold_nothing():
    assert track(before_a_wall(contrast=0.01)).tracked == []


def test_images_that_tell_nothing_leave_poses_as_depth_alone_has_them():
    frames = seen(BAYS, aside(12))
    random = np.random.default_rng(0)
    noise = [
        replace(p, photo=replace(p.photo, pixels=(120 + 2 * random.standard_normal(p.photo.pixels.shape)).astype("u1")))
        for p in pictured(frames, BAYS)
    ]
    for one, other in zip(track(frames).found, track(noise).found, strict=True):
        assert np.array_equal(one.T_world_sensor, other.T_world_sensor)


def unreadable():
    raise FrameRefused("unreadable", "no such file")


FAR = np.eye(4)
FAR[:3, 3] = 25, 0, 0  # millimetres, taken for metres


@pytest.mark.parametrize(
    "spoil",
    [
        lambda photo: photo.pixels,
        lambda photo: replace(photo, camera=None),
        lambda photo: replace(photo, T_sensor_camera=FAR),
        lambda photo: replace(photo, T_sensor_camera=[[1, 2], [3]]),
        lambda photo: replace(photo, T_sensor_camera=np.eye(4) * np.nan),
        lambda photo: replace(photo, T_sensor_camera=np.eye(4).astype(str)),
    ],
)
def test_what_is_no_image_with_a_camera_is_left_out_and_told(spoil):
    frames = [replace(frame, photo=spoil(frame.photo)) for frame in pictured(seen(BAYS, aside(4)), BAYS)]
    tracker = Tracker()
    assert [bool(tracker.add(frame).lost) for frame in frames] == [True, False, False, False]
    assert tracker.picture_use().startswith("4 of 4 pictures next to depth images are not used; the first: ")


def test_a_place_that_is_a_list_is_a_place():
    frames = pictured(seen(BAYS, aside(4)), BAYS)
    tracker = Tracker()
    for frame in frames:
        tracker.add(replace(frame, photo=replace(frame.photo, T_sensor_camera=frame.photo.T_sensor_camera.tolist())))
    assert tracker.picture_use() == "4 pictures next to depth images are used"


def test_only_images_whose_pose_is_asked_for_are_counted_and_each_once():
    """Others may be expected; of many that are, some are seen twice."""
    frames, tracker = pictured(seen(BAYS, aside(5)), BAYS), Tracker()
    for frame in frames[:4]:
        tracker.add(frame)
        for _ in range(2):
            for other in frames:
                tracker.expect(other)
    assert tracker.picture_use() == "4 pictures next to depth images are used"


def test_images_narrower_than_a_corner_hold_nothing():
    frames, camera = pictured(seen(BAYS, aside(4)), BAYS), PinholeCamera(160, 3, 160, 160, 79.5, 1)
    random = np.random.default_rng(0)
    thin = [Photo(random.integers(0, 255, (3, 160), np.uint8), camera) for _ in frames]
    found = track([replace(frame, photo=photo) for frame, photo in zip(frames, thin, strict=True)])
    assert found.lost == [0]


def test_images_that_cannot_be_used_are_left_out():
    frames = pictured(seen(BAYS, aside(12)), BAYS)
    wide = np.zeros((3, 5), np.uint8)
    for pixels in (unreadable, wide, wide.astype(float)):
        spoiled = [
            replace(frame, photo=replace(frame.photo, pixels=pixels)) if 4 <= i < 8 else frame
            for i, frame in enumerate(frames)
        ]
        found = track(spoiled)
        assert found.lost == [0]
        assert np.all(found.errors() < (METRES, DEGREES))


def test_colour_is_as_good_as_grey_and_a_function_as_an_array():
    frames = before_a_wall()[:6]
    grey = track(frames)
    colour = [
        replace(f, photo=replace(f.photo, pixels=lambda f=f: np.repeat(f.photo.pixels[..., None], 3, axis=2)))
        for f in frames
    ]
    for one, other in zip(grey.found, track(colour).found, strict=True):
        np.testing.assert_allclose(one.T_world_sensor, other.T_world_sensor, atol=1e-6)


def test_where_the_image_is_wrong_about_its_place_depth_holds_the_pose():
    """Colour that is mounted elsewhere than its file says: a turn of two degrees."""
    wrong = np.eye(4)
    wrong[:3, :3] = rotation_matrix([0, np.radians(2), 0])
    frames = [replace(f, photo=replace(f.photo, T_sensor_camera=wrong)) for f in pictured(seen(BAYS, aside(20)), BAYS)]
    assert np.all(track(frames).errors()[:, 0] < 0.04)


def test_behind_a_finger_it_is_found_again_before_a_wall():
    """No depth tells one part of the wall from another: the pattern does."""
    frames = before_a_wall()
    back = [*frames[:8], *map(covered, frames[8:11]), *frames[7::-1], *frames[:8]]
    found = track([replace(frame, stamp_ns=i * 33_000_000) for i, frame in enumerate(back)])
    assert set(range(8, 11)) <= set(found.lost)
    assert set(range(20, 27)) <= set(found.tracked)
    assert np.all(found.errors() < (METRES, DEGREES))


@lru_cache(maxsize=1)
def somebody():
    """Somebody comes in from where nothing was seen before, fills a quarter of the view and walks across it."""

    def person(i):
        y = 1.8 + 0.02 * i
        return Scene([cylinder("person", "person", (1.2, y, 0), (1.2, y, 1.9), 0.45, sections=16)]) if i >= 5 else None

    frames = seen(BAYS, aside(40), moving=person)
    return frames, pictured(frames, BAYS, moving=person)


def test_somebody_who_comes_in_takes_the_camera_along_less_far_than_by_depth_alone():
    alone, frames = somebody()
    worst = track(frames).errors()[:, 0].max()
    assert worst < 0.1
    assert track(alone).errors()[:, 0].max() > 2 * worst


@pytest.mark.parametrize("strength", [20, 60])
def test_a_projected_pattern_that_moves_with_the_camera_does_not_hold_it(strength):
    """Where depth tells the pose, pictures that have never agreed with it while it moved do not contradict it."""
    random = np.random.default_rng(1)
    dots = strength * np.repeat(np.repeat(random.standard_normal((LENS.height // 4, LENS.width // 4)), 4, 0), 4, 1)
    frames = [
        replace(f, photo=replace(f.photo, pixels=np.clip(f.photo.pixels * 0.3 + 80 + dots, 0, 255).astype(np.uint8)))
        for f in pictured(seen(BAYS, aside(20)), BAYS)
    ]
    found = track(frames)
    assert len(found.tracked) > 15
    assert np.all(found.errors()[:, 0] < 0.04)
