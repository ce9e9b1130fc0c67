# SPDX-License-Identifier: Apache-2.0
"""Disparity kernels against loops over single pixels."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.depth.stereo import _disparity
from stereovox.depth.stereo.disparity import (
    DOUBTFUL_PX,
    FAR_PX,
    RADIUS,
    SEEN,
    SURE,
    TALL,
    confidence,
    doubled,
    explained,
    halved,
    texture,
)
from stereovox.frame import Reason

HEIGHT, WIDTH = 37, 53


def made(seed, most=20.0, holes=0.3):
    random = np.random.default_rng(seed)
    disparity = random.uniform(0, most, (HEIGHT, WIDTH)).astype(np.float32)
    disparity[random.random(disparity.shape) < holes] = np.nan
    disparity[5:9, 10:40] = np.nan
    return disparity


def slow_pixels(raw, fractions, lag):
    out = np.full(raw.shape, np.nan)
    for v in range(raw.shape[0]):
        for u in range(raw.shape[1]):
            around = [int(raw[w, u]) for w in (max(v - 1, 0), v, min(v + 1, raw.shape[0] - 1))]
            above, here, below = around
            if here < 0:
                continue
            slope = 0.0
            if min(around) >= 0 and abs(above - here) < 16 and abs(below - here) < 16:
                slope = (below - above) / 32
            out[v, u] = max(here // 16 + fractions[here % 16] + lag * slope, 0)
    return out


def test_counts_become_pixels():
    random = np.random.default_rng(0)
    raw = (random.integers(0, 40, (HEIGHT, WIDTH)) + 8 * np.arange(HEIGHT)[:, None]).astype(np.int16)
    raw[random.random(raw.shape) < 0.2] = -16
    fractions = np.sort(random.uniform(-0.5, 1, 16)).astype(np.float32)
    out = np.empty(raw.shape, np.float32)
    _disparity.pixels(raw, fractions, np.float32(0.4), out)
    np.testing.assert_allclose(out, slow_pixels(raw, fractions, 0.4), atol=1e-5)
    assert np.isnan(out).any()


def slow_cross_check(disparity, side, most):
    out = disparity.copy()
    for v in range(HEIGHT):
        partners = [
            None if np.isnan(d) else min(max(int(np.float32(u) + np.float32(side) * d + np.float32(0.5)), 0), WIDTH - 1)
            for u, d in enumerate(disparity[v])
        ]
        for u, partner in enumerate(partners):
            rivals = [disparity[v, k] for k, other in enumerate(partners) if other == partner and other is not None]
            if rivals and max(rivals) - disparity[v, u] > most:
                out[v, u] = np.nan
    return out


@pytest.mark.parametrize("side", [-1, 1])
def test_of_two_with_one_partner_the_nearer_stays(side):
    disparity = made(1)
    wanted = slow_cross_check(disparity, side, 1.0)
    assert np.isnan(wanted).sum() > np.isnan(disparity).sum() + 50
    _disparity.cross_check(disparity, side, np.float32(1), np.empty(WIDTH, np.float32))
    np.testing.assert_array_equal(disparity, wanted)


def slow_say(disparity, v, u, rows, columns):
    window = disparity[max(v - rows, 0) : v + rows + 1, max(u - columns, 0) : u + columns + 1]
    have, d = window[np.isfinite(window)].astype(float), disparity[v, u]
    return (have.size / window.size) ** 3 / (1 + abs(d - have.mean()) / (1 + 0.1 * d))


def slow_confidence(disparity):
    out = np.zeros(disparity.shape)
    for v, u in zip(*np.nonzero(np.isfinite(disparity)), strict=True):
        out[v, u] = np.mean([slow_say(disparity, v, u, *reach) for reach in ((RADIUS, RADIUS), (TALL, 1))])
    return out


@pytest.mark.parametrize("shape", [(HEIGHT, WIDTH), (7, 60), (60, 7), (3, 2), (1, 1)])
def test_confidence_equals_the_slow_one(shape):
    disparity = np.resize(made(2), shape).copy()
    np.testing.assert_allclose(confidence(disparity), slow_confidence(disparity), atol=2e-2)  # sums are of 1/64 px
    fine = np.round(disparity * 64) / np.float32(64)
    np.testing.assert_allclose(confidence(fine), slow_confidence(fine), atol=1e-5)


def slow_texture(image):
    out = np.zeros(image.shape)
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            steps = [
                abs(float(image[i, j + 1]) - float(image[i, j - 1])) if 0 < j < image.shape[1] - 1 else 0
                for i in range(max(v - 3, 0), min(v + 4, image.shape[0]))
                for j in range(max(u - 7, 0), min(u + 8, image.shape[1]))
            ]
            out[v, u] = np.mean(steps)
    return out


@pytest.mark.parametrize("shape", [(25, 40), (3, 30), (30, 5), (9, 1)])
def test_texture_equals_the_slow_one(shape):
    image = np.random.default_rng(8).integers(0, 255, shape, np.uint8)
    np.testing.assert_allclose(texture(image), slow_texture(image), rtol=1e-5)


def slow_explained(raw, sure, image, valid, other, config):
    steps = slow_texture(image)
    right = config.aligned == "right"
    reason = np.zeros(raw.shape, np.uint8)
    for v in range(HEIGHT):
        for u in range(WIDTH):
            d, x = raw[v, u], raw[v, u] * (1 if right else -1) + u
            cropped = u >= WIDTH - config.rcrop if right else u < config.rcrop
            if np.isnan(d) or x < -0.5 or x > WIDTH - 0.5:
                reason[v, u] = Reason.UNMATCHED
            elif d >= config.disparities - 1.1:
                reason[v, u] = Reason.TOO_NEAR
            elif sure[v, u] < config.min_confidence or steps[v, u] < (SEEN if d < DOUBTFUL_PX else config.texture):
                reason[v, u] = Reason.UNMATCHED
            elif d < FAR_PX:
                reason[v, u] = Reason.TOO_FAR if sure[v, u] >= SURE else Reason.UNMATCHED
            matched = np.isnan(d) or other[v, min(max(int(x + 0.5), 0), WIDTH - 1)]
            if cropped or not (valid[v, u] and matched):
                reason[v, u] = Reason.MASKED
    return reason


@pytest.mark.parametrize("aligned", ["left", "right"])
def test_reasons_equal_the_slow_ones(aligned):
    settings = {"aligned": aligned, "rcrop": 4, "disparities": 16, "left_right": 0, "min_confidence": 0.2}
    settings["texture"] = 3
    config = load_config(**{f"stereo.{name}": value for name, value in settings.items()}).stereo
    raw = made(3, 16.0, 0.05)
    raw[20:, 20:] = np.random.default_rng(4).uniform(0, 1, (HEIGHT - 20, WIDTH - 20))
    valid, other = np.random.default_rng(5).random((2, *raw.shape)) > 0.1
    image = np.random.default_rng(6).integers(100, 107, raw.shape, np.uint8)
    image[:, 30:] = np.random.default_rng(7).integers(100, 120, image[:, 30:].shape)
    sure, original = confidence(raw), raw.copy()
    found = explained(raw, image, valid, other, config)
    np.testing.assert_array_equal(found.reason, slow_explained(original, sure, image, valid, other, config))
    assert set(np.unique(found.reason)) == set(Reason) - {Reason.UNKNOWN}
    kept = found.reason == Reason.VALID
    np.testing.assert_array_equal(found.disparity, np.where(kept, original, np.nan))
    np.testing.assert_array_equal(found.confidence, np.where(kept, sure, 0))


def test_halved_images_are_means_and_double_back():
    image = np.random.default_rng(6).integers(0, 255, (7, 9), np.uint8)
    half = halved(image)
    assert half.shape == (4, 5)
    assert abs(int(half[1, 2]) - image[2:4, 4:6].mean()) <= 0.5
    assert abs(int(half[3, 4]) - int(image[6, 8])) <= 1
    ramp = np.arange(20, dtype=np.float32).reshape(4, 5) / 8
    ramp[1, 1] = np.nan
    ramp[:, 4] += 7
    full = doubled(ramp, (7, 9))
    assert full.shape == (7, 9)
    np.testing.assert_array_equal(np.isnan(full), np.kron(np.isnan(ramp), np.ones((2, 2)))[:7, :9])
    np.testing.assert_allclose(full[6, 4], 2 * (ramp[3, 2] - 0.25 / 8 - 0.25 * 5 / 8), atol=1e-6)
    np.testing.assert_allclose(full[5, 4], 2 * (ramp[2, 2] - 0.25 / 8 + 0.25 * 5 / 8), atol=1e-6)
    assert full[6, 7] == 2 * ramp[3, 3]  # nothing in between at a step
    assert full[6, 8] == 2 * ramp[3, 4]


def slow_doubled(half, shape):
    """Return the bilinear disparity of full pixels, whose centres lie a quarter next to those of halved ones."""
    full = np.empty(shape)
    for v, u in np.ndindex(shape):
        y, x = (np.clip((i + 0.5) / 2 - 0.5, 0, n - 1) for i, n in zip((v, u), half.shape, strict=True))
        rows, columns = ([int(np.floor(i)), int(np.ceil(i))] for i in (y, x))
        (a, b), (c, d) = half[rows][:, columns].astype(float)
        linear = 2 * ((a * (1 - x % 1) + b * (x % 1)) * (1 - y % 1) + (c * (1 - x % 1) + d * (x % 1)) * (y % 1))
        nearest = 2 * float(half[v // 2, u // 2])
        full[v, u] = linear if abs(linear - nearest) < 1 else nearest
    return full


@pytest.mark.parametrize("shape", [(14, 18), (13, 17), (1, 2)])
def test_halved_disparities_are_doubled(shape):
    half = made(3, most=3.0)[: (shape[0] + 1) // 2, : (shape[1] + 1) // 2]
    np.testing.assert_allclose(doubled(half, shape), slow_doubled(half, shape), atol=1e-5)


@pytest.mark.parametrize("threads", [2, 5])
def test_rows_may_be_shared_by_threads(threads):
    disparity, image = made(4), np.random.default_rng(5).integers(0, 255, (HEIGHT, WIDTH), np.uint8)
    np.testing.assert_array_equal(doubled(disparity, (73, 105), threads), doubled(disparity, (73, 105)))
    np.testing.assert_array_equal(confidence(disparity, threads), confidence(disparity))
    np.testing.assert_array_equal(texture(image, threads), texture(image))
