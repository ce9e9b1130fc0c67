# SPDX-License-Identifier: Apache-2.0
"""Lenses against OpenCV's and against themselves, there and back."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from stereovox.cameras.wide import Lens
from stereovox.errors import StereovoxError

NARROW = {
    "none": (),
    "barrel": (-0.32, 0.12, 0.0011, -0.0007, -0.02),
    "pincushion": (0.11, 0.04, -0.002, 0.001),
    "rational": (0.9, 0.4, 0.0007, -0.0004, 0.03, 1.25, 0.6, 0.09),
}
WIDE = {"none": (), "usual": (-0.02, 0.011, -0.008, 0.0014), "strong": (0.12, -0.05, 0.01, -0.001)}


def narrow(name):
    return Lens("pinhole", 640, 480, 530.0, 527.0, 322.4, 236.1, NARROW[name])


def wide(name):
    return Lens("fisheye", 1280, 720, 390.0, 392.0, 645.0, 352.0, WIDE[name])


def matrix(lens):
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])


def points_within(degrees, count=500):
    rng = np.random.default_rng(3)
    off, turn = np.radians(degrees) * np.sqrt(rng.random(count)), rng.uniform(0, 2 * np.pi, count)
    rays = np.column_stack([np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn), np.cos(off)])
    return rays, rays * rng.uniform(0.2, 30, (count, 1))


def opencv_pixels(lens, points):
    k, project = np.array(lens.distortion or (0.0, 0, 0, 0)), cv2.projectPoints
    still = np.zeros((3, 1))
    if lens.model == "fisheye":
        return cv2.fisheye.projectPoints(points[:, None], still, still, matrix(lens), k.reshape(-1, 1))[0].reshape(
            -1, 2
        )
    return project(points[:, None], still, still, matrix(lens), k)[0].reshape(-1, 2)


@pytest.mark.parametrize("name", NARROW)
def test_a_narrow_lens_is_opencvs(name):
    _, points = points_within(38)
    np.testing.assert_allclose(narrow(name).project(points), opencv_pixels(narrow(name), points), atol=1e-8)


@pytest.mark.parametrize("name", WIDE)
def test_a_fisheye_is_opencvs(name):
    _, points = points_within(89)
    np.testing.assert_allclose(wide(name).project(points), opencv_pixels(wide(name), points), atol=1e-8)


@pytest.mark.parametrize("name", NARROW)
def test_there_and_back_through_a_narrow_lens(name):
    lens = narrow(name)
    rays, points = points_within(38)
    np.testing.assert_allclose(lens.directions(lens.project(points)), rays, atol=1e-9)


@pytest.mark.parametrize(("name", "degrees"), [("none", 179), ("usual", 110), ("strong", 95)])
def test_there_and_back_through_a_fisheye_beyond_90_degrees(name, degrees):
    lens = wide(name)
    rays, points = points_within(degrees)
    assert np.degrees(lens.widest) > degrees
    assert (rays[:, 2] < 0).any()
    np.testing.assert_allclose(lens.directions(lens.project(points)), rays, atol=1e-8)


def test_the_axis_falls_on_the_centre_and_back():
    for lens in (narrow("barrel"), wide("usual")):
        np.testing.assert_allclose(lens.project([[0.0, 0, 2]]), [[lens.cx, lens.cy]])
        np.testing.assert_allclose(lens.directions([[lens.cx, lens.cy]]), [[0, 0, 1]], atol=1e-12)


def test_an_even_fisheye_shows_angles_as_radii():
    lens = Lens.from_field_of_view("fisheye", 1281, 720, 175)
    pixels = lens.project([[np.sin(a), 0, np.cos(a)] for a in np.radians([10, 80, 95])])
    np.testing.assert_allclose(pixels[:, 0] - lens.cx, np.array([10, 80, 95]) * 1281 / 175)


def test_what_a_lens_does_not_see_is_nan():
    lens = narrow("barrel")
    behind = [[0.0, 0, -1], [0.1, 0.2, -3], [0, 0, 0], [1, 0, 0]]
    assert np.isnan(lens.project(behind)).all()
    beyond = np.tan(lens.widest) * 1.05
    assert np.isnan(lens.project([[beyond, 0, 1]])).all(), "the model folds back there"
    assert np.isfinite(lens.project([[np.tan(lens.widest) * 0.99, 0, 1]])).all()
    assert np.isnan(lens.directions([[lens.cx + 3000.0, lens.cy]])).all()
    fisheye = Lens("fisheye", 640, 480, 200.0, 200.0, 320.0, 240.0, (-0.1, 0.0, 0.0, 0.0))
    assert fisheye.widest == pytest.approx(np.sqrt(1 / 0.3))
    assert np.isnan(fisheye.project([[0, 0, -1.0], [0, 0, 0]])).all()
    assert np.isnan(fisheye.directions([[320 + 200 * 1.3, 240.0]])).all()


def test_nobody_finds_two_pixels_of_a_lens_in_one_direction():
    radial = [replace(narrow(name), distortion=(*NARROW[name][:2], 0, 0, *NARROW[name][4:])) for name in NARROW]
    for lens in (*radial, wide("usual"), wide("strong")):
        angles = np.linspace(0, lens.widest * 0.9999, 3000)
        radius = lens.project(np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)]))[:, 0]
        assert (np.diff(radius) > 0).all()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"model": "fishye"}, "did you mean 'fisheye'"),
        ({"fx": 0.0}, "fx must be a number from"),
        ({"fx": 1e300}, "fx must be a number from"),
        ({"fy": 1e-3}, "fy must be a number from"),
        ({"width": 10**6, "height": 10**6}, "pixels; check width and height"),
        ({"cx": np.nan}, "cx must be a number from"),
        ({"model": "fisheye", "distortion": (1, 2, 3, 4, 5)}, "at most 4"),
        ({"distortion": (np.inf,)}, "finite"),
        ({"distortion": (1e300, 1e300)}, "up to 1e"),
    ],
)
def test_what_is_no_lens(change, said):
    good = {"model": "pinhole", "width": 64, "height": 48, "fx": 50.0, "fy": 50.0, "cx": 31.5, "cy": 23.5}
    with pytest.raises(StereovoxError, match=said) as caught:
        Lens(**{**good, **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("model", "degrees"), [("pinhole", 180), ("fisheye", 361), ("fisheye", -3)])
def test_fields_of_view_that_cannot_be(model, degrees):
    with pytest.raises(StereovoxError, match="deg"):
        Lens.from_field_of_view(model, 64, 48, degrees)
