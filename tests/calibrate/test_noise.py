# SPDX-License-Identifier: Apache-2.0
"""Noise of a depth camera: the figures against plain NumPy, and known noise found again."""

from itertools import product

import numpy as np
import pytest

from stereovox.calibrate.noise import calibrate_noise, fit_noise, noise_at
from stereovox.calibrate.surface import read_wall
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.errors import StereovoxError
from stereovox.frame import Frame, StereoFrame
from stereovox.opening import open_source

CAMERA = PinholeCamera(160, 100, 120.0, 120.0, 79.5, 49.5, 0.05)


def recorded(depths, camera=CAMERA, distance=None, name="wall"):
    frames = [Frame(depth, camera, np.full((4, 4), np.nan), name=f"f{i}") for i, depth in enumerate(depths)]
    return read_wall(frames, name, camera, distance)


def noisy(distance, sigma, frames=20, fixed=0.0, seed=0):
    """A square wall with depth noise from frame to frame and an error of each pixel that stays."""
    random = np.random.default_rng(seed)
    stays = distance + fixed * random.standard_normal((100, 160))
    return [stays + sigma * random.standard_normal((100, 160)) for _ in range(frames)]


def simulated(where):
    source = open_source(where)
    return read_wall(source, where, source.camera)


def test_the_figures_are_those_of_plain_numpy():
    depths = noisy(1.5, 0.004, fixed=0.003)
    for depth in depths[:5]:
        depth[40:60:7, 60:100:5] = 0
    depths[7][50, 80] = 9.0
    at = noise_at(recorded(depths, distance=1.49))
    stack = np.array(depths)
    stack[(stack == 0) | (stack > 5)] = np.nan
    u, v = np.arange(160) - 79.5, np.arange(100) - 49.5
    region = stack[:, np.abs(v) / 120 * 1.5 <= 0.2][:, :, np.abs(u) / 120 * 1.5 <= 0.3]
    assert at.pixels == region[0].size
    assert at.rmse_m == pytest.approx(np.sqrt(np.nanmean((region - 1.5) ** 2)), rel=0.01)
    assert at.temporal_m == pytest.approx(np.sqrt(np.nanmean(np.nanvar(region, axis=0, ddof=1))), rel=0.01)
    assert at.fixed_m == pytest.approx(0.003, rel=0.05)
    assert at.offset_m == pytest.approx(0.01, abs=5e-4)
    assert at.valid_share == pytest.approx(np.isfinite(region).mean(), abs=1e-6)
    assert at.image_share == pytest.approx(np.isfinite(stack).mean(), abs=1e-6)
    assert at.gross_share == pytest.approx(1 / (np.isfinite(stack).sum() + 1), rel=1e-6)
    assert at.subpixel == pytest.approx(at.rmse_m * 120 * 0.05 / 1.5**2, rel=1e-3)


def test_noise_alone_is_not_taken_for_a_fixed_error():
    at = noise_at(recorded(noisy(1.5, 0.01, frames=5)))
    assert at.fixed_m == 0
    assert at.temporal_m == pytest.approx(0.01, rel=0.02)


def test_a_wall_that_leans_is_no_error():
    x, y = (np.arange(160) - 79.5) / 120, (np.arange(100) - 49.5) / 120
    leaning = 2.0 / (1 + 0.1 * x[None, :] - 0.15 * y[:, None])
    random = np.random.default_rng(3)
    at = noise_at(recorded([leaning + 0.005 * random.standard_normal(leaning.shape) for _ in range(10)]))
    assert at.rmse_m == pytest.approx(0.005, rel=0.02)
    assert at.distance_m == pytest.approx(2.0, rel=1e-3)


def test_a_single_frame_cannot_be_taken_apart():
    at = noise_at(recorded(noisy(1.5, 0.01, frames=1)))
    assert (at.temporal_m, at.fixed_m) == (None, None)
    assert at.rmse_m == pytest.approx(0.01, rel=0.05)


def test_only_the_region_counts():
    depths = noisy(1.0, 0.002)
    for depth in depths:
        depth[:, :30] += 0.02 * np.sin(np.arange(100))[:, None]
    assert noise_at(recorded(depths), (0.6, 0.4)).rmse_m == pytest.approx(0.002, rel=0.03)
    assert noise_at(recorded(depths), (9, 9)).rmse_m > 0.004


@pytest.mark.parametrize("s", [(0.001, 0.002, 0.003), (0, 0, 0.004), (0.002, 0, 0.001), (0, 0.003, 0)])
def test_curves_are_found_exactly(s):
    z = np.array([0.7, 1.5, 3.0, 6.0])
    assert fit_noise(z, s[0] + s[1] * z + s[2] * z**2) == pytest.approx(s, abs=1e-9)


def test_the_fit_is_the_best_of_those_that_are_not_negative():
    z, rmse = np.array([1.0, 2.0, 4.0, 8.0]), np.array([0.003, 0.02, 0.05, 0.26])  # plain least squares: s0 < 0
    found = np.array(fit_noise(z, rmse))

    def loss(s):
        return np.sum(((s[0] + s[1] * z + s[2] * z**2) / rmse - 1) ** 2)

    assert (found >= 0).all()
    for step in product((-1e-5, 0, 1e-5), repeat=3):
        nearby = found + step
        assert (nearby < 0).any() or loss(nearby) >= loss(found) - 1e-12


def test_terms_left_out_are_zero():
    z = np.array([1.0, 2.0, 4.0])
    s0, s1, s2 = fit_noise(z, 0.01 + 0.003 * z**2, ("s0", "s2"))
    assert (s0, s1, s2) == pytest.approx((0.01, 0, 0.003))


@pytest.mark.parametrize("subpixel", [0.05, 0.08])
def test_a_known_s2_is_found_within_five_percent(subpixel):
    where = f"sim:wall?image_width=424&tilt=3&frames=8&subpixel={subpixel}&distance="
    found = calibrate_noise([simulated(f"{where}{distance}") for distance in (1, 2.5, 5)])
    true = subpixel / (found.focal_px * 0.05)
    assert found.s2 == pytest.approx(true, rel=0.05)
    assert found.subpixel == pytest.approx(subpixel, rel=0.05)
    assert found.worst_percent < 3
    assert [round(point.distance_m, 1) for point in found.points] == [1, 2.5, 5]
    assert found.sigma(np.array([2.0]))[0] == pytest.approx(4 * true, rel=0.05)


def test_a_fixed_error_goes_into_sigma():
    walls = [recorded(noisy(d, 0.002 * d * d, fixed=0.003 * d * d), name=str(d)) for d in (0.8, 1.6, 2.4)]
    found = calibrate_noise(walls)
    assert found.sigma(np.array([1.6]))[0] == pytest.approx(1.6**2 * np.hypot(0.002, 0.003), rel=0.03)


def test_too_few_distances_say_what_can_be_fitted():
    near, also_near, far = (recorded(noisy(d, 0.01)) for d in (1.0, 1.05, 2.5))
    with pytest.raises(StereovoxError, match=r"record 1 more, or fit less with --terms s0,s2 or --terms s2") as refused:
        calibrate_noise([near, also_near, far])
    assert "\n" not in str(refused.value)
    with pytest.raises(StereovoxError, match=r"record 2 more, or fit less with --terms s2$"):
        calibrate_noise([near])
    assert calibrate_noise([near, far], fitted=("s0", "s2")).s1 == 0
    assert calibrate_noise([near], fitted=("s2",)).s2 == pytest.approx(0.01, rel=0.03)


def test_nothing_in_the_middle_is_one_line():
    depths = noisy(1.5, 0.002)
    for depth in depths:
        depth[30:70, 50:110] = np.nan
    with pytest.raises(StereovoxError, match=r"hole: only 0 pixels of the middle 0.3 x 0.2 m show the wall"):
        noise_at(recorded(depths, name="hole"), (0.3, 0.2))


def test_a_wall_without_any_noise_is_refused():
    with pytest.raises(StereovoxError, match="exact: shows no noise at all"):
        calibrate_noise([recorded([np.full((100, 160), 1.5)] * 3, name="exact")], fitted=("s2",))


def test_another_camera_and_no_recording_are_refused():
    with pytest.raises(StereovoxError, match="no recording"):
        calibrate_noise([])
    other = PinholeCamera(160, 100, 121.0, 120.0, 79.5, 49.5, 0.05)
    with pytest.raises(StereovoxError, match="another camera"):
        calibrate_noise([recorded(noisy(1, 0.01)), recorded(noisy(2, 0.01), other)])


def test_without_a_baseline_there_is_no_subpixel():
    blind = PinholeCamera(160, 100, 120.0, 120.0, 79.5, 49.5)
    found = calibrate_noise([recorded(noisy(d, 0.01), blind) for d in (1, 2, 4)])
    assert found.subpixel is None
    assert "baseline is not known" in " ".join(found.notes)


def test_brightness_is_that_of_the_pixels_with_a_value():
    """As Chien 2020, 2.2.4.1, counts it, frame by frame."""
    depths, pair = noisy(1.5, 0.004, frames=3), StereoPair(CAMERA)
    grey = np.full((100, 160), 50, np.uint8)
    grey[:40] = 200
    for depth in depths:
        depth[:40] = 0
    stereo = [StereoFrame(grey + np.uint8(i), grey, pair, np.eye(4), name=str(i)) for i in range(3)]
    wall = read_wall(
        stereo, "pair", CAMERA, matched=lambda frame: Frame(depths[int(frame.name)], CAMERA, np.eye(4)), condition="dim"
    )
    at = noise_at(wall)
    assert at.grey == pytest.approx(51)
    assert at.condition == "dim"
