# SPDX-License-Identifier: Apache-2.0
"""Rectification of a textured plane, rendered through two distorted, toed-in lenses: rows agree and depth is true.

The rendering shares nothing with the code under test but the lens model, which is tested against OpenCV's.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import Eyes, StereoPair
from stereovox.cameras.wide import Lens
from stereovox.depth.stereo.pipeline import rectified
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import StereoFrame
from stereovox.geometry.se3 import inverse, rotation_matrix, transform_points

NARROW = Lens("pinhole", 400, 300, 330.0, 332.0, 203.0, 147.0, (-0.28, 0.09, 0.0009, -0.0006))
OTHER = Lens("pinhole", 400, 300, 327.0, 326.0, 196.0, 152.0, (-0.25, 0.07, -0.0004, 0.0008))
WIDE = Lens("fisheye", 440, 300, 145.0, 145.5, 221.0, 148.0, (-0.02, 0.011, -0.008, 0.0014))
OTHER_WIDE = Lens("fisheye", 440, 300, 144.0, 143.5, 217.0, 151.0, (-0.015, 0.008, -0.006, 0.001))
T_LEFT_RIGHT = np.eye(4)
T_LEFT_RIGHT[:3, :3] = rotation_matrix([0.013, -0.05, 0.02])
T_LEFT_RIGHT[:3, 3] = 0.148, 0.004, -0.006
PAIRS = {
    "pinhole": StereoPair.from_eyes(Eyes(NARROW, OTHER, T_LEFT_RIGHT)),
    "spherical": StereoPair.from_eyes(Eyes(WIDE, OTHER_WIDE, T_LEFT_RIGHT), "spherical", hfov_deg=150, vfov_deg=110),
    "cylindrical": StereoPair.from_eyes(
        Eyes(WIDE, OTHER_WIDE, T_LEFT_RIGHT), "cylindrical", hfov_deg=130, vfov_deg=110
    ),
}
NORMAL, DISTANCE = np.array([0.1, -0.15, 0.98]) / np.linalg.norm([0.1, -0.15, 0.98]), 1.5
"""A plane in the frame of the left eye, in front of it."""


def texture(points):
    """A smooth random pattern of the place: waves of 0.1 to 0.5 m, different in each direction."""
    rng = np.random.default_rng(1)
    waves = rng.normal(size=(10, 3))
    waves *= (2 * np.pi / rng.uniform(0.1, 0.5, 10) / np.linalg.norm(waves, axis=1))[:, None]
    sum_of_waves = np.sin(points @ waves.T + rng.uniform(0, 6, 10)).sum(axis=1)
    return np.clip(128 + 22 * sum_of_waves, 0, 255)


def seen(lens, T_left_lens):
    """The plane as `lens` sees it; grey 90 where it looks past it."""
    v, u = np.mgrid[: lens.height, : lens.width]
    rays = lens.directions(np.column_stack([u.ravel(), v.ravel()])) @ T_left_lens[:3, :3].T
    eye = T_left_lens[:3, 3]
    along = (DISTANCE - NORMAL @ eye) / (rays @ NORMAL)
    hit = np.isfinite(along) & (along > 0) & (along < 12)
    grey = np.full(len(rays), 90.0)
    grey[hit] = texture(eye + along[hit, None] * rays[hit])
    return np.round(grey).astype(np.uint8).reshape(lens.height, lens.width)


@lru_cache
def images_of(eyes):
    return seen(eyes.left, np.eye(4)), seen(eyes.right, eyes.T_left_right)


def frame_of(pair):
    return StereoFrame(*images_of(pair.eyes), pair, np.eye(4), name="plane")


def plane_depth(pair):
    """True depth (height, width) of the plane in the rectified left image, from the rays; NaN where it is far off."""
    columns, rows = (part.astype(float) for part in pair.camera.rays())
    rays = np.stack(np.broadcast_arrays(columns, rows[:, :1], rows[:, 1:]), axis=-1)
    normal = pair.T_body_camera[:3, :3].T @ NORMAL
    with np.errstate(divide="ignore"):
        depth = DISTANCE / (rays @ normal)
    return np.where((depth > 0) & (depth * np.linalg.norm(rays, axis=-1) < 6), depth, np.nan)


def in_right_image(pair, depth):
    """Columns (height, width) at which the right eye's rectified image shows what the left one has here."""
    camera = pair.camera
    columns, _ = camera.rays()
    slope = columns - camera.baseline / depth
    if hasattr(camera, "step_u"):
        return np.arctan(slope) / camera.step_u + camera.cu
    return slope * camera.fx + camera.cx


def sampled(image, rows, columns):
    """Bilinear, plain."""
    v, u = np.clip(rows, 0, image.shape[0] - 2).astype(int), np.clip(columns, 0, image.shape[1] - 2).astype(int)
    a, b = rows - v, columns - u
    at = image.astype(float)
    above, below = at[v, u] * (1 - b) + at[v, u + 1] * b, at[v + 1, u] * (1 - b) + at[v + 1, u + 1] * b
    return above * (1 - a) + below * a


def shift(left, right, pair):
    """How far (columns, rows) the right image is off from where the true depth puts it: least squares over windows."""
    depth = plane_depth(pair)
    columns = in_right_image(pair, depth)
    v, u = np.nonzero(np.isfinite(columns))
    columns = columns[v, u]
    inside = (columns > 6) & (columns < pair.camera.width - 7) & (u > 6) & (u < pair.camera.width - 7)
    inside &= (v > 6) & (v < pair.camera.height - 7)
    v, u, columns = v[inside], u[inside], columns[inside]
    whole = pair_valid_around(rectified(frame_of(pair)).pair, v, u, columns)
    v, u, columns = v[whole], u[whole], columns[whole]
    across = (sampled(right, v, columns + 1) - sampled(right, v, columns - 1)) / 2
    down = (sampled(right, v + 1, columns) - sampled(right, v - 1, columns)) / 2
    missing = left[v, u].astype(float) - sampled(right, v, columns)
    found = []
    for part in np.array_split(np.arange(len(v)), 24):  # bands from top to bottom
        for half in (columns[part] < pair.camera.width / 2, columns[part] >= pair.camera.width / 2):
            slopes = np.column_stack([across[part][half], down[part][half]])
            if len(slopes) > 500:
                found.append(np.linalg.lstsq(slopes, missing[part][half], rcond=None)[0])
    assert len(found) > 30
    return np.array(found), np.abs(missing)


def pair_valid_around(pair, v, u, columns):
    ok = np.ones(len(v), bool)
    for shift_v in (-2, 2):
        for shift_u in (-2, 2):
            ok &= pair.valid[v + shift_v, u + shift_u]
            ok &= pair.valid_right[v + shift_v, np.round(columns).astype(int) + shift_u]
    return ok


@pytest.mark.parametrize("model", PAIRS)
def test_rows_agree_and_the_disparity_is_the_true_depth(model):
    pair = PAIRS[model]
    done = rectified(frame_of(pair))
    assert done.left.shape == done.right.shape == (pair.camera.height, pair.camera.width)
    off, missing = shift(done.left, done.right, pair)
    assert np.abs(off[:, 1]).max() < 0.1, "rows"
    assert np.abs(off[:, 0]).max() < 0.1, "columns, which is the disparity"
    assert np.median(missing) < 3


@pytest.mark.parametrize("model", PAIRS)
def test_points_seen_by_both_lie_on_one_row_and_give_their_depth(model):
    pair = PAIRS[model]
    camera = pair.camera
    rng = np.random.default_rng(2)
    v, u = np.divmod(rng.choice(camera.height * camera.width, 400, replace=False), camera.width)
    depth = rng.uniform(0.6, 9, 400)
    columns, rows = (part.astype(float) for part in camera.rays())
    points = depth[:, None] * np.column_stack([columns[u], rows[v]])
    from stereovox.depth.stereo.pipeline import _prepared

    left, right, _ = _prepared(pair)
    in_left = transform_points(pair.T_body_camera, points)
    pixels = pair.eyes.left.project(in_left)
    seen_there = left.valid[v, u]
    assert seen_there.sum() > 250
    mapped = np.column_stack([left.columns[v, u], left.rows[v, u]])
    np.testing.assert_allclose(mapped[seen_there], pixels[seen_there], atol=1e-3)
    there = in_right_image(pair, np.broadcast_to(depth[:, None], (400, camera.width)))[np.arange(400), u]
    disparity = np.zeros((camera.height, camera.width))
    for k in range(400):
        disparity[v[k], u[k]] = u[k] - there[k]
    found = camera.depth_of(np.where(disparity > 0, disparity, np.nan))[v, u]
    near = np.isfinite(found)
    np.testing.assert_allclose(found[near], depth[near], rtol=1e-4)
    whole = np.round(there).astype(int)
    fits = (whole >= 0) & (whole < camera.width) & (np.abs(there - whole) < 0.1)
    fits[fits] &= right.valid[v[fits], whole[fits]]
    assert fits.sum() > 20
    in_right = pair.eyes.right.project(transform_points(inverse(pair.eyes.T_left_right), in_left))
    step = np.abs(
        np.column_stack([right.columns[v[fits], whole[fits]], right.rows[v[fits], whole[fits]]]) - in_right[fits]
    )
    assert step.max() < 0.25, "within the rounding of the column"


def test_a_rectified_pair_is_left_as_it_is():
    pair = StereoPair(PinholeCamera(40, 30, 30.0, 30.0, 19.5, 14.5, 0.1))
    frame = StereoFrame(np.zeros((30, 40), np.uint8), np.zeros((30, 40), np.uint8), pair, np.eye(4))
    assert rectified(frame) is frame


def test_what_no_lens_sees_is_not_valid_and_own_masks_stay():
    pair = StereoPair.from_eyes(PAIRS["pinhole"].eyes, hfov_deg=85)
    mask = np.ones((pair.camera.height, pair.camera.width), bool)
    mask[40:60, 50:90] = False
    done = rectified(frame_of(pair)).pair
    masked = rectified(frame_of(replace(pair, valid=mask))).pair
    assert done.eyes is None
    assert done.camera is pair.camera
    assert 0.3 < done.valid.mean() < 1, "the corners are beyond the lens"
    np.testing.assert_array_equal(masked.valid, done.valid & mask)
    np.testing.assert_array_equal(masked.valid_right, done.valid_right)
    assert (rectified(frame_of(pair)).left[~done.valid] == 0).all()


def test_all_frames_of_a_pair_share_one_rectified_pair():
    first, second = (rectified(frame_of(PAIRS["pinhole"])) for _ in range(2))
    assert first.pair is second.pair


def test_colour_images_and_frames_with_a_fault():
    frame = frame_of(PAIRS["pinhole"])
    grey = rectified(frame)
    colour = rectified(
        replace(frame, left=np.stack([frame.left] * 3, axis=-1), right=np.stack([frame.right] * 3, axis=-1))
    )
    np.testing.assert_array_equal(colour.left, np.stack([grey.left] * 3, axis=-1))
    broken = replace(frame, left=np.empty((0, 0), np.uint8), fault="unreadable")
    assert rectified(broken) is broken


def test_images_of_another_size_are_refused():
    frame = frame_of(PAIRS["pinhole"])
    with pytest.raises(FrameRefused, match="the right image is") as caught:
        rectified(replace(frame, right=frame.right[:-1]))
    assert caught.value.reason == "bad_shape"


def test_eyes_that_cannot_be():
    swapped = T_LEFT_RIGHT.copy()
    swapped[0, 3] = -0.148
    with pytest.raises(StereovoxError, match="exchange the eyes"):
        Eyes(NARROW, OTHER, swapped)
    with pytest.raises(StereovoxError, match="not a rigid motion"):
        Eyes(NARROW, OTHER, 2 * np.eye(4))


def test_virtual_cameras_by_default():
    eyes = Eyes(NARROW, OTHER, T_LEFT_RIGHT)
    camera = PAIRS["pinhole"].camera
    assert (camera.width, camera.height) == (400, 300)
    assert camera.fx == camera.fy == pytest.approx(328.5)
    assert camera.baseline == pytest.approx(np.linalg.norm([0.148, 0.004, 0.006]))
    half = StereoPair.from_eyes(eyes, size=(200, 150)).camera
    assert half.fx == pytest.approx(camera.fx / 2)
    assert (rectified(frame_of(PAIRS["pinhole"])).pair.valid).mean() > 0.85, "centred on what both eyes see"
    wide = StereoPair.from_eyes(Eyes(WIDE, OTHER_WIDE, T_LEFT_RIGHT), "spherical").camera
    assert 1 / wide.step_u == pytest.approx(144.5, rel=0.01), "the resolution in the middle is kept"
    assert np.degrees(wide.width * wide.step_u) == pytest.approx(170, abs=1)
    assert 100 < np.degrees(wide.height * wide.step_v) < 125, "no more than the lens sees"
    given = StereoPair.from_eyes(eyes, "cylindrical", size=(100, 60), hfov_deg=60, vfov_deg=30).camera
    assert (given.width, given.height, given.step_v) == (100, 60, pytest.approx(np.radians(0.5)))
    with pytest.raises(StereovoxError, match="did you mean 'spherical'"):
        StereoPair.from_eyes(eyes, "spheric")


def test_the_mounting_pose_is_that_of_the_left_eye_as_it_is():
    T_body_left = np.eye(4)
    T_body_left[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T_body_left[:3, 3] = 0.2, 0.05, -0.1
    pair = StereoPair.from_eyes(Eyes(NARROW, OTHER, T_LEFT_RIGHT), T_body_left=T_body_left)
    R = PAIRS["pinhole"].T_body_camera[:3, :3]
    np.testing.assert_allclose(pair.T_body_camera[:3, :3], T_body_left[:3, :3] @ R, atol=1e-12)
    np.testing.assert_allclose(pair.T_body_camera[:3, 3], T_body_left[:3, 3])
