# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera: pixels to rays and back, and cameras that cannot be."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import StereovoxError

cameras = st.builds(
    PinholeCamera,
    width=st.integers(1, 40),
    height=st.integers(1, 40),
    fx=st.floats(20, 500),
    fy=st.floats(20, 500),
    cx=st.floats(0, 40),
    cy=st.floats(0, 40),
)


@given(cameras, st.floats(0.1, 50))
def test_back_projected_points_project_onto_their_pixels(camera, depth):
    points = camera.back_project(np.full((camera.height, camera.width), depth))
    assert points.shape == (camera.height, camera.width, 3)
    x, y, z = np.moveaxis(points, -1, 0)
    v, u = np.mgrid[: camera.height, : camera.width]
    np.testing.assert_allclose(camera.fx * x / z + camera.cx, u, atol=1e-9)
    np.testing.assert_allclose(camera.fy * y / z + camera.cy, v, atol=1e-9)
    np.testing.assert_array_equal(z, depth)


@given(cameras)
def test_ray_slopes_are_the_points_at_depth_one(camera):
    columns, rows = camera.ray_slopes()
    assert columns.dtype == rows.dtype == np.float32
    points = camera.back_project(np.ones((camera.height, camera.width)))
    np.testing.assert_allclose(np.broadcast_to(columns, points.shape[:2]), points[..., 0], atol=1e-6)
    np.testing.assert_allclose(np.broadcast_to(rows[:, None], points.shape[:2]), points[..., 1], atol=1e-6)


def test_no_value_stays_no_value():
    camera = PinholeCamera(3, 2, 50, 50, 1, 0.5)
    depth = np.ones((2, 3))
    depth[1, 2] = np.nan
    points = camera.back_project(depth)
    assert np.isnan(points[1, 2]).all()
    assert np.isfinite(points).sum() == 15


def test_field_of_view_of_the_d435():
    camera = PinholeCamera.from_field_of_view(848, 480, 91.2, baseline=0.05)
    assert camera.fx == camera.fy == pytest.approx(415.2, abs=0.1)
    columns, _ = camera.ray_slopes()
    half_a_pixel = 0.5 / camera.fx
    assert 2 * math.degrees(math.atan(columns[-1] + half_a_pixel)) == pytest.approx(91.2, abs=1e-4)
    assert columns[0] == -columns[-1], "the axis is in the middle"
    assert camera.baseline == 0.05


GOOD = {"width": 64, "height": 48, "fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5}
BAD = [
    {"width": 0},
    {"height": -1},
    {"fx": 0.0},
    {"fy": -5.0},
    {"fx": math.nan},
    {"fy": math.inf},
    {"cx": math.nan},
    {"cy": math.inf},
    {"baseline": -0.05},
    {"baseline": math.nan},
    {"fx": 1.0},
    {"cx": 1e6},
    {"cy": -1e6},
]


@pytest.mark.parametrize("wrong", BAD, ids=str)
def test_impossible_cameras_are_refused_in_one_line(wrong):
    PinholeCamera(**GOOD)
    with pytest.raises(StereovoxError) as refused:
        PinholeCamera(**{**GOOD, **wrong})
    assert "\n" not in str(refused.value)
    assert f"{next(iter(wrong))}=" in str(refused.value), "the message shows the camera's numbers"
