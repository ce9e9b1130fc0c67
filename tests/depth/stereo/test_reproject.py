# SPDX-License-Identifier: Apache-2.0
"""Points of disparities by the printed formulas, and their uncertainty by throwing dice."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.config import NoiseConfig
from stereovox.depth.stereo.disparity import depth_sigma, point_sigma, reproject
from stereovox.sensors.noise import RangeNoise

BASELINE = 0.15
CAMERAS = {
    "pinhole": PinholeCamera(9, 7, 6.0, 6.5, 4.2, 2.9, BASELINE),
    "spherical": SphericalCamera(9, 7, 0.25, 0.3, 4.2, 2.9, BASELINE),
    "cylindrical": CylindricalCamera(9, 7, 5.0, 0.3, 4.2, 2.9, BASELINE),
}


def printed(camera, u, v, d, aligned):
    """Valenti 2018, Eq 4.1 and 4.3 to 4.4 with the brackets where they belong, pixel by pixel."""
    if isinstance(camera, PinholeCamera):
        y = (v - camera.cy) * BASELINE / d * camera.fx / camera.fy  # the thesis has square pixels
        return [(u - camera.cx) * BASELINE / d, y, camera.fx * BASELINE / d]
    if isinstance(camera, CylindricalCamera):
        away, down = camera.fx * BASELINE / d, (v - camera.cv) * camera.step_v
        return [(u - camera.cx) * BASELINE / d, away * np.sin(down), away * np.cos(down)]
    other = d if aligned == "right" else -d
    k = BASELINE / np.sin(camera.step_u * d) * np.cos(camera.step_u * (u - camera.cu + other))
    across, down = (u - camera.cu) * camera.step_u, (v - camera.cv) * camera.step_v
    return [k * np.sin(across), k * np.cos(across) * np.sin(down), k * np.cos(across) * np.cos(down)]


def pixels_of(camera, points):
    """Where the camera sees points (N, 3), by projection."""
    x, y, z = points.T
    if isinstance(camera, PinholeCamera):
        return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    v = np.arctan2(y, z) / camera.step_v + camera.cv
    if isinstance(camera, CylindricalCamera):
        return camera.fx * x / np.hypot(y, z) + camera.cx, v
    return np.arctan2(x, np.hypot(y, z)) / camera.step_u + camera.cu, v


@pytest.mark.parametrize("aligned", ["left", "right"])
@pytest.mark.parametrize("name", CAMERAS)
def test_points_are_those_of_the_printed_formulas(name, aligned):
    camera = CAMERAS[name]
    disparity = np.random.default_rng(1).uniform(0.2, 1.5, (7, 9))
    points = reproject(disparity, camera, aligned)
    for v in range(7):
        for u in range(9):
            other = disparity[v, u] if aligned == "right" else -disparity[v, u]
            wanted = printed(camera, u, v, disparity[v, u], aligned)
            if name == "spherical" and abs((u - camera.cu + other) * camera.step_u) >= np.pi / 2:
                assert np.isnan(points[v, u]).all()  # the other eye would have to look back
            else:
                np.testing.assert_allclose(points[v, u], wanted, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("aligned", ["left", "right"])
@pytest.mark.parametrize("name", CAMERAS)
def test_both_eyes_see_the_point_where_the_disparity_says(name, aligned):
    """The geometry itself, which no misprint can bend: project the point into both eyes."""
    camera, disparity = CAMERAS[name], np.full((7, 9), 0.4)
    points = reproject(disparity, camera, aligned)
    good = np.isfinite(points[..., 2])
    v, u = np.nonzero(good)
    to_other = BASELINE if aligned == "left" else -BASELINE
    for shift, moved in ((0.0, 0.0), (to_other, -0.4 if aligned == "left" else 0.4)):
        seen_u, seen_v = pixels_of(camera, points[good] - [shift, 0, 0])
        np.testing.assert_allclose(seen_u, u + moved, atol=1e-5)
        np.testing.assert_allclose(seen_v, v, atol=1e-5)
    assert len(v) > 40


def test_no_disparity_no_point():
    disparity = np.full((7, 9), 0.5)
    disparity[0, :4] = np.nan, 0, -1, np.inf
    for camera in CAMERAS.values():
        assert np.isnan(reproject(disparity, camera)[0, :4]).all()
        assert np.isnan(point_sigma(disparity, camera, 0.1)[0, :4]).all()
        assert np.isfinite(reproject(disparity, camera)[3, 3:6]).all()


@pytest.mark.parametrize("aligned", ["left", "right"])
@pytest.mark.parametrize(
    "camera",
    [
        PinholeCamera(40, 30, 250.0, 250.0, 20.0, 15.0, 0.1),
        SphericalCamera(40, 30, 0.05, 0.06, 20.0, 15.0, 0.1),
        CylindricalCamera(40, 30, 15.0, 0.06, 20.0, 15.0, 0.1),
    ],
    ids=["pinhole", "spherical", "cylindrical"],
)
def test_uncertainty_by_monte_carlo(camera, aligned):
    """Gaussian noise on the disparity gives the predicted standard deviations (Eq 4.2, 4.7) within some per cent."""
    random = np.random.default_rng(7)
    noise = 0.02 * camera.baseline / camera.step_u if isinstance(camera, SphericalCamera) else 0.02
    disparity = np.full((30, 40), 50 * noise)
    predicted = point_sigma(disparity, camera, noise, aligned)
    thrown = np.stack(
        [reproject(disparity + noise * random.standard_normal(disparity.shape), camera, aligned) for _ in range(3000)]
    )
    good = np.isfinite(thrown).all(axis=0) & (predicted > 0.01 * predicted[np.isfinite(predicted)].max())
    assert good.mean() > 0.6
    ratio = thrown.std(axis=0)[good] / predicted[good]
    assert np.median(ratio) == pytest.approx(1, abs=0.01)
    assert (np.abs(ratio - 1) < 0.06).mean() > 0.999  # 3000 throws tell a standard deviation to 1.3 %


@pytest.mark.parametrize("name", CAMERAS)
def test_range_noise_is_the_uncertainty_in_the_middle(name):
    """Valenti 2018, Eq 6.9 and 6.10 to 6.11: what the sensor models are given is Eq 4.2 and 4.7 at u = u0."""
    fine = {
        "pinhole": PinholeCamera(3, 1, 500.0, 500.0, 1.0, 0.0, 0.1),
        "spherical": SphericalCamera(3, 1, 2.5 / 1200, 2.5 / 1200, 1.0, 0.0, 0.1),
        "cylindrical": CylindricalCamera(3, 1, 500.0, 0.002, 1.0, 0.0, 0.1),
    }[name]
    noise = RangeNoise.of(NoiseConfig(subpixel=0.3), fine)
    for disparity in (2.0, 10.0, 60.0, 250.0):
        if name == "spherical" and disparity * fine.step_u > 1.4:
            continue
        d = np.full((1, 3), disparity)
        # the thesis's Eq 6.11, d = arctan(B / z) / dtheta, holds where the right eye looks straight ahead
        depth = fine.depth_of(d, "right")[0, 1]
        assert noise.sigma(depth) == pytest.approx(depth_sigma(d, fine, 0.3, "right")[0, 1], rel=1e-9)


def test_range_noise_of_a_spherical_camera_as_printed():
    camera, subpixel = SphericalCamera(3, 1, 2.5 / 1200, 2.5 / 1200, 1.0, 0.0, 0.1), 0.5
    noise = RangeNoise.of(NoiseConfig(subpixel=subpixel), camera)
    for z in (0.2, 1.0, 5.0):
        d = np.arctan(0.1 / z) / camera.step_u  # Eq 6.11
        printed_sigma = 0.1 * camera.step_u * (1 + 1 / np.tan(d * camera.step_u) ** 2) * subpixel  # Eq 6.10
        assert noise.sigma(z) == pytest.approx(printed_sigma)
    assert RangeNoise.of(NoiseConfig(s0=0.01, s2=0.002), camera) == RangeNoise(0.01, 0.0, 0.002)
