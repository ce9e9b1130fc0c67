# SPDX-License-Identifier: Apache-2.0
"""Noise goes, edges stay, and nothing is made up."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.depth.prepare import denoise
from stereovox.frame import Frame, Reason
from stereovox.simulate.d435 import smooth_noise
from stereovox.track.surfaces import Surfaces

CAMERA = PinholeCamera(64, 48, 415.0, 415.0, 31.5, 23.5, baseline=0.05)
S2 = 0.08 / (415.0 * 0.05)
CONFIG = load_config(voxel_size=0.05, min_range=0.2, max_range=6.0, **{"depth.keep_lines": True})


def slow_denoise(depth_m, s0, s1, s2, voxel_size, low, high, apart=1, lines=True):
    """The same in plain words and float64: three passes, pixel by pixel, neighbour by neighbour; then the lines."""
    inverse = {vu: 1.0 / d for vu, d in np.ndenumerate(depth_m.astype(float)) if 0 < d < np.inf}
    raw, untouched = inverse, {vu for vu, c in inverse.items() if s0 + s1 / c + s2 / c**2 <= 0.15 * voxel_size}
    for far, least, k in ((1, 1, 4.5), (2, 1, 4.5), (4, 3, 4.0)):
        averaged = {}
        for (v, u), centre in inverse.items():
            z = 1 / centre
            noise = s0 + s1 * z + s2 * z**2
            reach = k * min(noise, 1.3 * voxel_size) / z**2
            step = far * apart
            beside = [(v, u - step), (v, u + step), (v - step, u), (v + step, u)]
            if noise <= least * 0.15 * voxel_size:
                beside = []
            values = [centre, *(inverse[vu] for vu in beside if vu in inverse)]
            weights = [max(1 - ((w - centre) / reach) ** 2, 0) ** 4 for w in values]
            averaged[v, u] = sum(w * g for w, g in zip(values, weights, strict=True)) / sum(weights)
        inverse = averaged
    result = depth_m.astype(float).copy()
    for vu, value in inverse.items():
        noise = s0 + s1 / value + s2 / value**2
        if lines and noise > 3 * 0.15 * voxel_size:
            value = max([value, *slow_lines(vu, raw, inverse, noise * value**2, apart)])
        result[vu] = depth_m[vu] if vu in untouched else np.clip(1 / value, low, high)
    return result


def slow_lines(vu, raw, averaged, sigma, apart):
    """Yield the mean of each line of five measured values through a pixel that stands before both its sides."""
    (v, u), a = vu, apart
    for (dv, du), (side_v, side_u) in (
        ((a, 0), (0, 3 * a)), ((0, a), (3 * a, 0)), ((a, a), (-2 * a, 2 * a)), ((a, -a), (2 * a, 2 * a)),
    ):  # fmt: skip
        line = [(v + k * dv, u + k * du) for k in (-2, -1, 0, 1, 2)]
        sides = [averaged[at] for at in ((v + side_v, u + side_u), (v - side_v, u - side_u)) if at in averaged]
        if sides and all(at in raw for at in line):
            values = np.array([raw[at] for at in line])
            stands = min(values[:3].mean(), values[2:].mean()) > max(sides) + 1.5 * sigma
            if stands and values[2] > values.mean() - 2 * sigma:
                yield values.mean()


def measured(true_depth_m, seed=0, s2=S2):
    """Depths whose inverse has Gaussian noise of s2."""
    random = np.random.default_rng(seed)
    return (1 / (1 / true_depth_m + s2 * random.standard_normal(true_depth_m.shape))).astype(np.float32)


def cleaned(depth_m, config=CONFIG, camera=CAMERA):
    result = depth_m.copy()
    denoise(result, camera, config)
    return result


def steps_and_holes(shape, seed):
    random = np.random.default_rng(seed)
    v, u = np.mgrid[: shape[0], : shape[1]]
    true = np.where((u // 5 + v // 9) % 2, 2.0 + 0.03 * u, 3.4 - 0.02 * v)
    depth = measured(true, seed)
    for value in (np.nan, np.inf, -np.inf):
        depth[random.random(shape) < 0.06] = value
    return depth


@pytest.mark.parametrize("noise", [{}, {"s0": 0.01, "s1": 0.004}, {"s0": 0.03, "s2": 0.0}, {"s1": 0.01, "s2": 0.0}])
@pytest.mark.parametrize("shape", [(48, 64), (1, 9), (9, 1), (2, 3), (1, 1)])
def test_same_as_the_slow_one(shape, noise):
    config = load_config(CONFIG, **{f"noise.{name}": value for name, value in noise.items()})
    depth = steps_and_holes(shape, seed=sum(shape))
    depth.flat[0] = 4.0  # at least one far value, whatever the shape
    numbers = (noise.get("s0", 0.0), noise.get("s1", 0.0), noise.get("s2", S2))
    np.testing.assert_allclose(cleaned(depth, config), slow_denoise(depth, *numbers, 0.05, 0.2, 6.0), rtol=2e-5)


@pytest.mark.parametrize(("correlation_px", "apart"), [(0.3, 1), (0.7, 2), (1.0, 2), (1.5, 4), (5.0, 4)])
@pytest.mark.parametrize("shape", [(48, 64), (1, 9), (40, 3)])
def test_same_as_the_slow_one_where_errors_are_alike(shape, correlation_px, apart):
    config = load_config(CONFIG, **{"noise.correlation_px": correlation_px})
    depth = steps_and_holes(shape, seed=sum(shape))
    depth.flat[0] = 4.0
    np.testing.assert_allclose(
        cleaned(depth, config), slow_denoise(depth, 0.0, 0.0, S2, 0.05, 0.2, 6.0, apart), rtol=2e-5
    )


@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("correlation_px", [0.7, 1.5])
def test_correlated_noise_goes_about_as_far_as_independent_noise_does(correlation_px, seed):
    """Told how alike errors are, the filter leaves a fifth of them; not told, up to half."""
    camera = PinholeCamera(200, 200, 415.0, 415.0, 99.5, 99.5, baseline=0.05)
    noise = S2 * smooth_noise((200, 200), correlation_px, np.random.default_rng(seed))
    depth = (1 / (1 / 4.0 + noise)).astype(np.float32)

    def left(told):
        config = load_config(CONFIG, **{"noise.correlation_px": told})
        return (1 / cleaned(depth, config, camera))[30:-30, 30:-30].std() / S2

    assert left(correlation_px) < 0.23
    assert left(correlation_px) < 0.75 * left(0.0)


def rods(shape, sigmas, seed=0):
    """Return depths of a wall at 4 m with four rods of a pixel before it, one in each direction, and where those are.

    sigmas: by which the rods stand before the wall.
    """
    v, u = np.mgrid[: shape[0], : shape[1]]
    rod = (u == 7) | (v == 40) | (u - v == 24) | (u + v == 60)
    return measured(1 / (1 / 4.0 + np.where(rod, sigmas * S2, 0.0)), seed), rod


@pytest.mark.parametrize(("correlation_px", "apart"), [(0.0, 1), (0.7, 2)])
def test_same_as_the_slow_one_where_lines_stand_out(correlation_px, apart):
    config = load_config(CONFIG, **{"noise.correlation_px": correlation_px})
    depth, _ = rods((48, 64), 3.0)
    random = np.random.default_rng(1)
    for value in (np.nan, np.inf, -np.inf):
        depth[random.random(depth.shape) < 0.02] = value
    slow, without = (slow_denoise(depth, 0.0, 0.0, S2, 0.05, 0.2, 6.0, apart, lines) for lines in (True, False))
    assert (slow < without).sum() > 30
    np.testing.assert_allclose(cleaned(depth, config), slow, rtol=2e-5)
    plain = load_config(config, **{"depth.keep_lines": False})
    np.testing.assert_allclose(cleaned(depth, plain), without, rtol=2e-5)


def test_registration_goes_without_lines():
    assert CONFIG.depth.keep_lines
    assert not Surfaces(CONFIG)._depth._config.depth.keep_lines


@pytest.mark.parametrize("sigmas", [2.3, 2.6, 3.0])
def test_a_rod_a_few_sigma_before_its_wall_is_not_averaged_into_it(sigmas):
    """By the mean over neighbours alone it stands half as far before the wall, and its own cells are called free."""
    found = []
    for seed in range(4):
        depth, rod = rods((48, 64), sigmas, seed)
        found.append((1 / cleaned(depth)[rod] - 0.25) / S2)
    assert np.mean(found) > sigmas - 0.5


def test_a_wall_alone_stays_as_flat_as_its_mean_over_neighbours():
    wall = np.full((48, 64), 4.0)
    for seed in range(4):
        depth = measured(wall, seed)
        slow = slow_denoise(depth, 0.0, 0.0, S2, 0.05, 0.2, 6.0, lines=False)
        assert (abs(cleaned(depth) / slow - 1) > 1e-4).mean() < 0.003


def test_a_slit_between_two_surfaces_keeps_its_depth():
    true = np.full((48, 64), 3.5)
    true[:, 30] = 4.5
    result = cleaned(measured(true))[:, 30]
    assert (abs(1 / result - 1 / 4.5) < 4 * S2).all()


def test_a_slanted_wall_loses_its_noise_and_stays_where_it_is():
    true = 1 / np.linspace(1 / 3.5, 1 / 4.5, 64)[None, :].repeat(48, 0)
    raw = 1 / measured(true) - 1 / true
    after = (1 / cleaned(measured(true)) - 1 / true)[3:-3, 3:-3]
    assert raw.std() == pytest.approx(S2, rel=0.05)
    assert after.std() < raw.std() / 4
    assert abs(after.mean()) < raw.std() / 20


def test_no_value_appears_between_two_surfaces():
    near, far = 2.0, 4.0
    true = np.full((48, 64), far)
    true[:, 20:40] = near
    result = cleaned(measured(true))
    assert (np.abs(1 / result - 1 / true) < 4 * S2).all()


@pytest.mark.parametrize("width_px", [1, 2, 4])
def test_a_thin_pole_keeps_its_depth(width_px):
    true = np.full((48, 64), 4.0)
    true[:, 30 : 30 + width_px] = 2.0
    raw = measured(true)
    pole, raw_pole = (1 / image[:, 30 : 30 + width_px] - 0.5 for image in (cleaned(raw), raw))
    assert np.abs(pole).max() <= np.abs(raw_pole).max() + 1e-6
    assert np.abs(pole).std() < np.abs(raw_pole).std() / 1.05


def test_pixels_without_value_stay_without_and_count_nowhere():
    depth = np.full((48, 64), 4.0, np.float32)
    depth[10:30:2] = np.nan
    depth[:, 7::5], depth[:, 8::5] = np.inf, -np.inf
    np.testing.assert_array_equal(np.isfinite(cleaned(depth)), np.isfinite(depth))
    np.testing.assert_allclose(cleaned(depth), depth, rtol=1e-6)


def test_reasons_stay_and_only_values_change():
    true = np.full((48, 64), 4.0)
    true[:10], true[10:20] = 0.1, 9.0
    depth = measured(true)
    depth[25, 30] = np.nan
    plain = prepare(Frame(depth, CAMERA, np.eye(4)), load_config(CONFIG, **{"depth.denoise": False}))
    image = prepare(Frame(depth, CAMERA, np.eye(4)), CONFIG)
    np.testing.assert_array_equal(image.reason, plain.reason)
    valid = plain.reason == Reason.VALID
    np.testing.assert_array_equal(image.depth_m[~valid], plain.depth_m[~valid])
    assert image.depth_m[valid].std() < plain.depth_m[valid].std() / 3


def test_near_pixels_keep_every_bit():
    config = load_config(CONFIG, voxel_size=0.1)
    nearest_noisy = np.sqrt(0.15 * 0.1 / S2)
    depth = measured(np.linspace(1.0, 3.0, 64)[None, :].repeat(48, 0), s2=1e-5)
    changed = cleaned(depth, config) != depth
    assert not changed[depth < nearest_noisy].any()
    assert changed[depth > nearest_noisy + 0.05].mean() > 0.9


def test_noise_of_less_than_half_a_cell_is_left_alone():
    depth = steps_and_holes((48, 64), 3)
    farthest = S2 * 6.0**2
    np.testing.assert_array_equal(cleaned(depth, load_config(CONFIG, voxel_size=2.05 * farthest)), depth)
    assert (cleaned(depth, load_config(CONFIG, voxel_size=1.95 * farthest)) != depth).any()


@pytest.mark.parametrize("settings", [{"voxel_size": 1.0}, {"depth.denoise": False}, {"noise.s2": 0.0}])
def test_nothing_is_done_where_noise_is_small_or_it_is_switched_off(settings):
    depth = steps_and_holes((48, 64), 3)
    np.testing.assert_array_equal(cleaned(depth, load_config(CONFIG, **settings)), depth)


def test_values_stay_within_the_range():
    depth = measured(np.full((48, 64), 5.9)).clip(0.2, 6.0)
    config = load_config(CONFIG, **{"noise.subpixel": 0.3})
    assert cleaned(depth, config).max() <= np.float32(6.0)
    assert (cleaned(np.full((48, 64), 6.0, np.float32), config) <= np.float32(6.0)).all()


def test_a_binned_camera_has_the_noise_of_its_sensor():
    """Disparity is measured in the sensor's own pixels, so binning changes neither noise nor result."""
    depth = measured(np.full((48, 64), 4.0))
    binned = PinholeCamera(128, 96, 830.0, 830.0, 63.5, 47.5, baseline=0.025).binned(2)
    np.testing.assert_allclose(cleaned(depth, camera=binned), cleaned(depth), rtol=1e-6)
