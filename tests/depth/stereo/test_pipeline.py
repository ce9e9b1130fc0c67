# SPDX-License-Identifier: Apache-2.0
"""Stereo on rendered pairs whose disparity is known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.cameras.wide import SphericalCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.depth.stereo.matchers import MATCHERS, make_matcher
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.errors import ConfigError, FrameRefused, StereovoxError
from stereovox.frame import Reason, StereoFrame
from stereovox.geometry.se3 import look_at

HEIGHT, WIDTH = 120, 240
CAMERA = PinholeCamera(WIDTH, HEIGHT, 200.0, 200.0, 119.5, 59.5, baseline=0.2)
SCENES = Path(__file__).resolve().parents[4] / "shared/data/kitti_stereo2015"


def texture(seed):
    noise = np.random.default_rng(seed).normal(0, 1, (HEIGHT, WIDTH + 200)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.2)
    return 128 + 45 * smooth / smooth.std()


def seen(surface, shift):
    """Return the texture seen `shift` (a number, or one a row) columns further right, with the grain of a sensor."""
    u = np.arange(WIDTH) + 30 + np.broadcast_to(np.asarray(shift, float), (HEIGHT,))[:, None]
    rows = [np.interp(columns, np.arange(surface.shape[1]), line) for columns, line in zip(u, surface, strict=True)]
    return np.array(rows)


def as_image(values, seed):
    return np.clip(np.round(values + np.random.default_rng(seed).normal(0, 1.5, values.shape)), 0, 255).astype(np.uint8)


def plane(disparity, camera=CAMERA, **pair):
    surface = texture(1)
    left, right = as_image(seen(surface, 0), 2), as_image(seen(surface, disparity), 3)
    return StereoFrame(left, right, StereoPair(camera, **pair), np.eye(4), 5, name="plane")


BOX = slice(30, 90), slice(100, 160)
NEAR, FAR = 30, 10


def step():
    """Return a box at disparity NEAR before a wall at FAR, and the left disparity; (v, 80 to 99) is hidden right."""
    wall, box = texture(1), texture(7)
    left, right = seen(wall, 0), seen(wall, FAR)
    left[BOX] = seen(box, 0)[BOX]
    moved = BOX[0], slice(BOX[1].start - NEAR, BOX[1].stop - NEAR)
    right[moved] = seen(box, NEAR)[moved]
    truth = np.full((HEIGHT, WIDTH), FAR)
    truth[BOX] = NEAR
    return StereoFrame(as_image(left, 2), as_image(right, 3), StereoPair(CAMERA), np.eye(4)), truth


def stereo(**settings):
    small = {"disparities": 64, "speckle_size": 50}
    return load_config(**{f"stereo.{name}": value for name, value in {**small, **settings}.items()}).stereo


@pytest.mark.parametrize("aligned", ["left", "right"])
@pytest.mark.parametrize("halve", [False, True])
@pytest.mark.parametrize("disparity", [12.0, 20.4])
def test_a_plane_has_its_depth(aligned, halve, disparity):
    frame = replace(plane(disparity), T_world_sensor=look_at((1, 2, 3), (4, 4, 3)))
    result = StereoDepth(stereo(aligned=aligned, halve=halve))(frame)
    valid = result.reason == Reason.VALID
    assert valid.mean() > 0.8
    assert result.depth.dtype == np.float32
    np.testing.assert_array_equal(np.isfinite(result.depth), valid)
    found = 200 * 0.2 / result.depth[valid]
    assert abs(np.median(found) - disparity) < 0.2
    assert np.mean(np.abs(found - disparity) < 1) > 0.99
    assert replace(result.camera, subpixel=None) == CAMERA
    assert (result.stamp_ns, result.name, result.depth_scale) == (5, "plane", 1)
    eye = frame.T_world_sensor @ [0.2 if aligned == "right" else 0, 0, 0, 1]
    np.testing.assert_allclose(result.T_world_sensor[:, 3], eye)
    np.testing.assert_array_equal(result.T_world_sensor[:3, :3], frame.T_world_sensor[:3, :3])


@pytest.mark.parametrize("aligned", ["left", "right"])
def test_the_right_image_gets_the_right_images_disparity(aligned):
    frame, truth = step()
    found = StereoDepth(stereo(aligned=aligned)).disparity(frame)
    box = BOX if aligned == "left" else (BOX[0], slice(BOX[1].start - NEAR, BOX[1].stop - NEAR))
    inside = np.zeros(truth.shape, bool)
    inside[box] = True
    edge = cv2.dilate(inside.astype(np.uint8), np.ones((9, 9))) != cv2.erode(inside.astype(np.uint8), np.ones((9, 9)))
    for region, wanted in ((inside & ~edge, NEAR), (~inside & ~edge, FAR)):
        values = found.disparity[region & np.isfinite(found.disparity)]
        assert len(values) > 0.6 * region.sum()
        assert np.mean(np.abs(values - wanted) < 1) > 0.97


def test_what_one_eye_sees_alone_gets_no_value():
    frame, _ = step()
    hidden = slice(35, 85), slice(BOX[1].start - (NEAR - FAR) + 3, BOX[1].start - 3)
    loose = StereoDepth(stereo(left_right=0, uniqueness=0, speckle_size=0, min_confidence=0)).disparity(frame)
    strict = StereoDepth(stereo(min_confidence=0)).disparity(frame)
    assert np.isfinite(loose.disparity[hidden]).mean() > 0.3
    assert np.isfinite(strict.disparity[hidden]).mean() < 0.1
    assert (strict.reason[hidden] != Reason.TOO_FAR).all()


@pytest.mark.parametrize("aligned", ["left", "right"])
def test_nothing_is_matched_outside_of_the_other_image(aligned):
    found = StereoDepth(stereo(aligned=aligned, min_confidence=0)).disparity(plane(20.0))
    lost = slice(0, 19) if aligned == "left" else slice(WIDTH - 19, WIDTH)
    assert (found.reason[:, lost] != Reason.VALID).mean() > 0.9
    u = np.arange(WIDTH)
    partner = u - found.disparity if aligned == "left" else u + found.disparity
    assert np.nanmin(partner) >= -0.5
    assert np.nanmax(partner) <= WIDTH - 0.5
    beside = slice(24, 60) if aligned == "left" else slice(WIDTH - 60, WIDTH - 24)
    assert np.isfinite(found.disparity[:, beside]).mean() > 0.8  # no margin as wide as the search


@pytest.mark.parametrize("aligned", ["left", "right"])
def test_rcrop_drops_columns_at_the_border(aligned):
    whole = StereoDepth(stereo(aligned=aligned)).disparity(plane(12.0))
    cropped = StereoDepth(stereo(aligned=aligned, rcrop=40)).disparity(plane(12.0))
    lost = slice(0, 40) if aligned == "left" else slice(WIDTH - 40, WIDTH)
    assert (cropped.reason[:, lost] == Reason.MASKED).all()
    assert np.isnan(cropped.disparity[:, lost]).all()
    rest = slice(40, None) if aligned == "left" else slice(0, WIDTH - 40)
    np.testing.assert_array_equal(cropped.disparity[:, rest], whole.disparity[:, rest])


@pytest.mark.parametrize("eye", ["valid", "valid_right"])
@pytest.mark.parametrize("aligned", ["left", "right"])
def test_the_vehicle_is_masked(aligned, eye):
    valid = np.ones((HEIGHT, WIDTH), bool)
    valid[40:70, 100:150] = False
    found = StereoDepth(stereo(aligned=aligned)).disparity(plane(12.0, **{eye: valid}))
    wanted = np.zeros_like(valid)
    shift = {"left": 0, "right": 12}[aligned] - {"valid": 0, "valid_right": 12}[eye]
    wanted[40:70, 100 - shift : 150 - shift] = True
    assert np.mean((found.reason == Reason.MASKED) != wanted) < 0.005
    assert np.isnan(found.disparity[found.reason == Reason.MASKED]).all()
    with pytest.raises(StereovoxError, match=r"mask is \(3, 4\), its camera has \(120, 240\)"):
        StereoDepth(stereo()).disparity(plane(12.0, **{eye: np.ones((3, 4), bool)}))


def test_too_near_too_far_and_nothing_to_see():
    near = StereoDepth(stereo(disparities=16)).disparity(plane(15.4))
    assert (near.reason == Reason.TOO_NEAR).mean() > 0.5
    far = StereoDepth(stereo())(plane(0.0))
    assert (far.reason == Reason.TOO_FAR).mean() > 0.9
    far.depth[0, 0], far.reason[0, 0] = 5.0, Reason.VALID  # else the second would be refused
    for max_range, wanted in ((79.0, Reason.TOO_FAR), (81.0, Reason.UNKNOWN)):  # half a pixel is at 80 m
        image = prepare(far, load_config(max_range=max_range, voxel_size=0.2))
        assert (image.reason[far.reason == Reason.TOO_FAR] == wanted).all()
    blank = np.full((HEIGHT, WIDTH), 200, np.uint8)
    sky = StereoDepth(stereo())(replace(plane(0.0), left=blank, right=blank))
    assert (sky.reason == Reason.UNMATCHED).all()  # clears nothing
    grain = as_image(np.full((HEIGHT, WIDTH), 200.0), 8)  # even where the grain is the same in both
    sky = StereoDepth(stereo())(replace(plane(0.0), left=grain, right=grain))
    assert (sky.reason == Reason.UNMATCHED).mean() > 0.99


def test_confidence_is_low_where_disparity_is_wrong():
    frame, truth = step()
    right = frame.right.copy()
    right[60:, 120:] = np.random.default_rng(0).integers(60, 200, right[60:, 120:].shape)
    loose = stereo(uniqueness=0, left_right=0, speckle_size=0, min_confidence=0)
    found = StereoDepth(loose).disparity(replace(frame, right=right))
    kept = np.isfinite(found.disparity)
    wrong = np.abs(found.disparity - truth)[kept] > 3
    sure = found.confidence[kept]
    assert 0.02 < wrong.mean() < 0.5
    assert (sure > 0).all()
    assert sure.max() <= 1
    assert wrong[sure > np.median(sure)].mean() < 0.5 * wrong.mean()
    assert (found.confidence[~kept] == 0).all()
    strict = StereoDepth(loose.model_copy(update={"min_confidence": 0.8})).disparity(replace(frame, right=right))
    np.testing.assert_array_equal(np.isfinite(strict.disparity), found.confidence >= np.float32(0.8))


@pytest.mark.parametrize("method", sorted(set(MATCHERS) - {"onnx"}))
def test_every_method_finds_the_plane(method):
    left, right = plane(20.4).left, plane(20.4).right
    raw = make_matcher(stereo(method=method, block_size=7))(left, right)
    assert (raw.dtype, raw.shape) == (np.float32, left.shape)
    assert np.isfinite(raw).mean() > 0.6
    assert abs(np.nanmedian(raw) - 20.4) < 0.2


@pytest.mark.parametrize("from_below", [False, True])
def test_the_path_does_not_drag_slanted_planes(from_below):
    truth = 10 + 0.33 * np.arange(HEIGHT)
    frame = plane(truth)
    raw = make_matcher(stereo(from_below=from_below))(frame.left, frame.right)
    matcher = make_matcher(stereo(from_below=from_below))
    matcher.lag_rows = 0.0
    uncorrected = matcher(frame.left, frame.right)
    bias, dragged = (np.nanmedian((d - truth[:, None])[10:-10, 70:-10]) for d in (raw, uncorrected))
    assert abs(bias) < 0.06 < abs(dragged)
    assert (dragged > 0) == from_below


def test_fractions_of_a_pixel_are_spread():
    truth = 10 + 0.02 * np.arange(HEIGHT)
    frame = plane(truth)
    errors = {
        unlock: (make_matcher(stereo(unlock=unlock))(frame.left, frame.right) - truth[:, None])[10:-10, 70:-10]
        for unlock in (False, True)
    }
    assert np.nanstd(errors[True]) < 0.8 * np.nanstd(errors[False])
    assert abs(np.nanmean(errors[True])) < 0.05


def test_colour_is_seen_as_grey():
    frame = plane(12.0)
    shade = frame.left.astype(int)
    red, green, blue = (np.clip(shade + more, 0, 255).astype(np.uint8) for more in (20, 0, -20))
    left = np.stack([red, green, blue], axis=-1)
    grey = np.round(0.299 * red + 0.587 * green + 0.114 * blue).astype(np.uint8)
    right = np.repeat(frame.right[..., None], 3, axis=2)
    colour = StereoDepth(stereo()).disparity(replace(frame, left=left, right=right)).disparity
    plain = StereoDepth(stereo()).disparity(replace(frame, left=grey)).disparity
    assert np.mean(np.isfinite(colour) == np.isfinite(plain)) > 0.99
    assert np.nanmedian(np.abs(colour - plain)) < 0.01


def test_depth_is_what_the_camera_says():
    camera = SphericalCamera.from_field_of_view(WIDTH, HEIGHT, 120, 60, baseline=0.2)
    maker = StereoDepth(stereo(aligned="right"))
    frame = plane(12.0, camera)
    wanted = camera.depth_of(maker.disparity(frame).disparity, "right")
    np.testing.assert_allclose(maker(frame).depth, wanted, rtol=1e-6)
    assert np.isfinite(wanted).mean() > 0.5


@pytest.mark.parametrize("method", ["census", "sgm"])
@pytest.mark.parametrize("halve", [False, True])
def test_the_number_of_threads_changes_nothing(method, halve):
    frame, before = plane(20.4), cv2.getNumThreads()
    one, three = (StereoDepth(stereo(threads=n, method=method, halve=halve))(frame) for n in (1, 3))
    np.testing.assert_array_equal(one.depth, three.depth)
    np.testing.assert_array_equal(one.reason, three.reason)
    assert cv2.getNumThreads() == before


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"fault": "unreadable", "fault_detail": "no file"}, "unreadable"),
        ({"left": np.zeros((HEIGHT, WIDTH), np.uint16)}, "bad_dtype"),
        ({"right": np.zeros((HEIGHT, WIDTH - 1), np.uint8)}, "bad_shape"),
        ({"left": None}, "bad_dtype"),
    ],
)
def test_bad_frames_are_refused(change, reason):
    with pytest.raises(FrameRefused) as error:
        StereoDepth(stereo())(replace(plane(12.0), **change))
    assert error.value.reason == reason
    assert "\n" not in str(error.value)


def test_a_pair_needs_a_baseline():
    with pytest.raises(StereovoxError, match="no baseline"):
        StereoDepth(stereo())(plane(12.0, replace(CAMERA, baseline=None)))


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"disparities": 100}, "disparities"),
        ({"block_size": 4}, "odd"),
        ({"p1": 50.0, "p2": 20.0}, "p1"),
        ({"aligned": "middle"}, "aligned"),
        ({"min_confidence": 1.5}, "min_confidence"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, word):
    with pytest.raises(ConfigError, match=word):
        stereo(**settings)


def test_an_unknown_method_is_named():
    with pytest.raises(ConfigError, match="unknown matcher 'smg'"):
        StereoDepth(stereo(method="smg"))


@pytest.mark.skipif(not SCENES.exists(), reason="no KITTI stereo 2015 scenes in ../shared/data")
def test_a_street_scene_against_lidar():
    name = "training/{}/000010_10.png"
    left, right = (cv2.imread(str(SCENES / name.format(side)), 0) for side in ("image_2", "image_3"))
    truth = cv2.imread(str(SCENES / name.format("disp_occ_0")), -1) / 256.0
    height, width = left.shape
    camera = PinholeCamera(width, height, 721.5, 721.5, 609.6, 172.9, 0.5327)
    found = StereoDepth(load_config().stereo).disparity(StereoFrame(left, right, StereoPair(camera), np.eye(4)))
    kept = (truth > 0) & np.isfinite(found.disparity)
    wrong = np.abs(found.disparity - truth)[kept] > 3
    sure = found.confidence[kept]
    assert kept.sum() > 0.8 * (truth > 0).sum()
    assert wrong.mean() < 0.015
    assert wrong[sure > np.median(sure)].mean() < 0.25 * wrong.mean()


def test_only_large_images_are_halved_unless_told_otherwise(monkeypatch):
    from stereovox.depth.stereo import pipeline as module

    frame = plane(20.4)
    whole, half, open_ = (StereoDepth(stereo(halve=halve)) for halve in (False, True, None))
    found = {name: make.disparity(frame).disparity for name, make in (("whole", whole), ("half", half))}
    assert not np.array_equal(found["whole"], found["half"], equal_nan=True)
    np.testing.assert_array_equal(open_.disparity(frame).disparity, found["whole"])
    monkeypatch.setattr(module, "LARGE", HEIGHT * WIDTH - 1)
    np.testing.assert_array_equal(open_.disparity(frame).disparity, found["half"])


@pytest.mark.parametrize("method", ["sgm", "sgm8", "hh4"])
def test_windows_whose_costs_overflow_are_refused(method):
    StereoDepth(stereo(method=method, block_size=15))
    with pytest.raises(ConfigError, match="block_size 21 with p2 64: too large"):
        StereoDepth(stereo(method=method, block_size=21))


def test_images_smaller_than_the_window_are_refused():
    camera = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5, baseline=0.1)
    image = np.zeros((24, 32), np.uint8)
    with pytest.raises(FrameRefused, match="smaller than stereo"):
        StereoDepth(stereo(method="block", block_size=51))(StereoFrame(image, image, StereoPair(camera), np.eye(4)))
