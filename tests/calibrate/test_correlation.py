# SPDX-License-Identifier: Apache-2.0
"""How alike neighbouring errors are: against plain NumPy, and known Gaussians found again."""

import numpy as np
import pytest

from stereovox.calibrate.noise import calibrate_noise, noise_at
from stereovox.calibrate.surface import LAGS, Correlation, add_products, read_wall
from stereovox.opening import open_source
from stereovox.sensors.noise import kept_by_means, looks
from stereovox.simulate.d435 import smooth_noise


def correlated(sigma, seed=0, shape=(400, 500), frames=3, shape_of_wall=0.0):
    products = np.zeros((2, LAGS + 1, 2))
    for i in range(frames):
        add_products(products, smooth_noise(shape, sigma, np.random.default_rng([seed, i])) + shape_of_wall)
    return Correlation.of(products)


def simulated(where):
    source = open_source(where)
    return read_wall(source, where, source.camera)


def test_products_are_those_of_plain_python():
    errors = np.random.default_rng(0).standard_normal((9, 24))
    errors[2, 3:7] = errors[8, 20] = np.nan
    products = np.zeros((2, LAGS + 1, 2))
    add_products(products, errors)
    for axis, lag in ((0, 0), (0, 1), (0, 5), (1, 0), (1, 2), (1, 8)):
        lines = errors if axis == 0 else errors.T
        pairs = [line[i] * line[i + lag] for line in lines for i in range(len(line) - lag)]
        known = [pair for pair in pairs if np.isfinite(pair)]
        assert products[axis, lag] == pytest.approx([sum(known), len(known)], rel=1e-5)
    assert not products[1, 9:].any()


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("sigma", [0.0, 0.5, 0.7, 1.0, 1.5, 2.5])
def test_a_known_gaussian_is_found(sigma, seed):
    found = correlated(sigma, seed)
    assert found.length_px == pytest.approx(sigma, rel=0.05, abs=0.02)
    if sigma >= 0.7:
        assert found.falls_to_1_e_px == pytest.approx((2 * sigma, 2 * sigma), rel=0.07)


@pytest.mark.parametrize("sigma", [0.0, 0.7, 1.5, 2.5])
@pytest.mark.parametrize("side", [4, 8])
def test_looks_are_the_inverse_variance_of_means(side, sigma):
    noise = smooth_noise((1600, 1600), sigma, np.random.default_rng(7))
    means = noise.reshape(1600 // side, side, 1600 // side, side).mean((1, 3))
    assert looks(side, sigma) == pytest.approx(1 / means.var(), rel=0.07)
    assert correlated(sigma).looks(side) == pytest.approx(1 / means.var(), rel=0.07)


def test_means_of_many_keep_what_correlation_adds():
    assert kept_by_means(0) == 1
    line = smooth_noise((4000, 2000), 1.5, np.random.default_rng(1))[::20]  # rows far apart: one axis only
    assert kept_by_means(1.5) == pytest.approx(2000 * line.mean(1).var(), rel=0.2)
    assert kept_by_means(3.0) == pytest.approx(2 * np.sqrt(np.pi) * 3.0, rel=1e-3)


def test_the_shape_of_the_image_is_no_correlation():
    assert correlated(0.7, shape_of_wall=0.5).length_px == pytest.approx(0.7, rel=0.05)


def test_no_errors_count_as_independent():
    found = Correlation.of(np.zeros((2, LAGS + 1, 2)))
    assert (found.length_px, found.looks(8)) == (0.0, 64.0)


@pytest.mark.parametrize("seed", [0, 3])
@pytest.mark.parametrize(("subpixel", "correlation"), [(0.08, 0.0), (0.05, 0.7), (0.12, 1.5)])
def test_what_the_camera_was_given_is_measured_on_walls(subpixel, correlation, seed):
    where = f"sim:wall?image_width=424&frames=6&subpixel={subpixel}&correlation={correlation}&seed={seed}&distance="
    found = calibrate_noise([simulated(f"{where}{distance}") for distance in (1, 2.5, 5)], region=(2.0, 1.2))
    assert found.subpixel == pytest.approx(subpixel, rel=0.06)
    assert found.correlation_px == pytest.approx(correlation, rel=0.06, abs=0.02)


@pytest.mark.parametrize("seed", [1, 4])
def test_an_honest_camera_is_measured_too(seed):
    at = noise_at(simulated(f"sim:wall?camera=d435&frames=5&distance=1.5&seed={seed}"))
    assert at.correlation_px == pytest.approx(1.8, rel=0.1)
    assert at.subpixel == pytest.approx(0.08, rel=0.08)
    assert at.looks < 4
    assert 0.3 < at.fixed_m / at.rmse_m < 0.6  # a fifth of the variance stays where the camera stands
    assert 0.7 < at.valid_share < 0.99
