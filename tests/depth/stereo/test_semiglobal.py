# SPDX-License-Identifier: Apache-2.0
"""The own matcher against semi-global matching in plain NumPy, one pixel after the other."""

import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.depth.stereo.disparity import match_aligned
from stereovox.depth.stereo.semiglobal import STRIP, WARM, Census
from stereovox.errors import ConfigError

NONE = -16


def stereo(**settings):
    wanted = {"method": "census", "disparities": 32, "speckle_size": 0, **settings}
    return load_config(**{f"stereo.{name}": value for name, value in wanted.items()}).stereo


def pair(height, width, seed=0, shift=7):
    """Return a smooth random image and the same seen `shift` columns further right, with grain."""
    random = np.random.default_rng(seed)
    wide = np.kron(random.integers(0, 256, (height // 2 + 2, (width + shift) // 3 + 2)), np.ones((2, 3)))
    wide = wide[:height, : width + shift] * 0.6 + random.integers(0, 80, (height, width + shift))
    left, right = wide[:, :width], wide[:, shift:] + random.normal(0, 4, (height, width))
    return tuple(np.ascontiguousarray(np.clip(image, 0, 255).astype(np.uint8)) for image in (left, right))


def at(image, v, u):
    return int(image[min(max(v, 0), image.shape[0] - 1), min(max(u, 0), image.shape[1] - 1)])


def soft(image, v, u):
    """Return the mean of 3 by 3 pixels, those in the middle counted twice along both axes."""
    around = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    return (8 + sum((2 - abs(y)) * (2 - abs(x)) * at(image, v + y, u + x) for y, x in around)) // 16


def slope(image, v, u):
    total = sum(weight * (at(image, v + y, u + 1) - at(image, v + y, u - 1)) for y, weight in ((-1, 1), (0, 2), (1, 1)))
    return min(max(total, -63), 63)


def half_a_pixel(values):
    """Return the value in the middle of three, and the least and the most within half a pixel of it."""
    before, here, after = values
    around = here, (here + before) // 2, (here + after) // 2
    return here, min(around), max(around)


def unlike(a, b):
    """Return the difference of Birchfield and Tomasi (1998)."""
    return min(max(0, a[0] - b[2], b[1] - a[0]), max(0, b[0] - a[2], a[1] - b[0]))


def described(image, columns):
    """Return of each row and column what it is compared by; columns may lie beyond the image."""
    found = {}
    rows, wider = range(-3, image.shape[0] + 3), range(columns.start - 3, columns.stop + 3)
    softer = {(v, u): soft(image, v, u) for v in rows for u in wider}
    steps = [(y, x) for y in range(-3, 4) for x in range(-3, 4) if (y + x) % 2 == 0 and (y, x) != (0, 0)]
    for v in range(image.shape[0]):
        for u in columns:
            slopes = half_a_pixel([slope(image, v, u + x) + 63 for x in (-1, 0, 1)])
            greys = half_a_pixel([at(image, v, u + x) for x in (-1, 0, 1)])
            found[v, u] = slopes, greys, [softer[v + y, u + x] < softer[v, u] for y, x in steps]
    return found


def pixel_costs(left, right, n):
    height, width = left.shape
    ours, theirs = described(left, range(width)), described(right, range(-n, width))
    costs = np.zeros((height, width, n), int)
    for v, u, d in np.ndindex(costs.shape):
        (slopes, greys, bits), (slopes_right, greys_right, bits_right) = ours[v, u], theirs[v, u - d]
        other = sum(one != two for one, two in zip(bits, bits_right, strict=True))
        costs[v, u, d] = unlike(slopes, slopes_right) // 2 + unlike(greys, greys_right) // 4 + other
    return costs


def window_costs(costs, side, share):
    height, width, _ = costs.shape
    around = range(-(side // 2), side // 2 + 1)
    rows = sum(costs[np.clip(np.arange(height) + y, 0, height - 1)] for y in around)
    total = sum(rows[:, np.clip(np.arange(width) + x, 0, width - 1)] for x in around)
    return total * share >> 16


def jump(p1, p2, grey, before):
    """Return what a jump costs between neighbours: less than p2 in proportion where they differ by more than 16."""
    return max(p1, p2 * 16 // max(16, abs(int(grey) - int(before))))


def one_path(costs, image, p1, most):
    """Return the path costs along the first axis of (length, w, n); image: (length, w)."""
    found = [costs[0]]
    for i, here in enumerate(costs[1:], 1):
        before = found[-1]
        p2 = np.array([[jump(p1, most, *greys)] for greys in zip(image[i], image[i - 1], strict=True)])
        low = before.min(axis=-1, keepdims=True)
        beyond = np.full_like(low, 10**6)
        fewer = np.concatenate([beyond, before[..., :-1]], axis=-1)
        more = np.concatenate([before[..., 1:], beyond], axis=-1)
        found.append(here + np.minimum.reduce([before, fewer + p1, more + p1, low + p2 + 0 * before]) - low)
    return np.array(found)


def choose(total, unique, left_right):
    height, width, n = total.shape
    raw = np.full((height, width), NONE)
    for v, u in np.ndindex(raw.shape):
        costs = total[v, u]
        best = int(np.argmin(costs))
        others = [costs[d] for d in range(n) if abs(d - best) > 1]
        if others and min(others) * (100 - unique) < costs[best] * 100:
            continue
        raw[v, u] = 16 * best
        if 0 < best < n - 1:
            before, here, after = (int(costs[best + x]) for x in (-1, 0, 1))
            bend = max(before + after - 2 * here, 1)
            raw[v, u] += ((before - after) * 16 + bend) // (2 * bend)
    if left_right < 0:
        return raw
    kept = raw.copy()
    for v, u in np.ndindex(raw.shape):
        d = (raw[v, u] + 8) // 16
        if raw[v, u] < 0:
            continue
        seen = [(total[v, x, x - (u - d)], x - (u - d)) for x in range(width) if 0 <= x - (u - d) < n]
        if abs(min(seen)[1] - d) > left_right:
            kept[v, u] = NONE
    return kept


def slow(left, right, config):
    """Return the raw disparities by the obvious way; see the docstrings of `Census` and its settings."""
    p1, p2 = 0.75 * config.p1, 0.75 * config.p2
    scale = min(1, 252 / (150 + p1 + p2))
    n, padded = config.disparities, -(-config.disparities // 64) * 64
    share = int(65536 * scale / config.block_size**2)
    costs = window_costs(pixel_costs(left, right, padded), config.block_size, share)
    p1, p2 = round(scale * p1), max(1, round(scale * p2))
    height = len(left)
    down = np.empty_like(costs)
    strips = max(1, round(height / STRIP))
    for strip in range(strips):
        first, end = height * strip // strips, height * (strip + 1) // strips
        start = max(0, first - WARM)
        down[first:end] = one_path(costs[start:end], left[start:end], p1, p2)[first - start :]
    across = costs.swapaxes(0, 1)
    to_right = one_path(across, left.T, p1, p2).swapaxes(0, 1)
    to_left = one_path(across[::-1], left.T[::-1], p1, p2)[::-1].swapaxes(0, 1)
    assert max(path.max() for path in (down, to_right, to_left)) <= 255 - p1
    most = max(1, round(config.left_right)) if config.left_right else -1
    return choose((down + to_right + to_left)[..., :n], round(config.uniqueness * 2 / 3), most)


@pytest.mark.parametrize(
    ("size", "settings"),
    [
        ((19, 33), {}),
        ((11, 21), {"disparities": 80, "block_size": 3}),
        ((13, 18), {"block_size": 1, "left_right": 0, "uniqueness": 0}),
        ((10, 25), {"p1": 90.0, "p2": 390.0, "left_right": 3}),
        ((4, 5), {"block_size": 9, "disparities": 16}),
        ((1, 1), {"disparities": 16}),
        ((3, 40), {"disparities": 64, "uniqueness": 60}),
    ],
)
def test_it_is_semi_global_matching(size, settings):
    config = stereo(**settings)
    left, right = pair(*size, seed=size[1])
    raw = Census(config)._raw(left, right)
    np.testing.assert_array_equal(raw, slow(left, right, config))
    assert size[1] < 10 or (raw != NONE).mean() > 0.1


def test_strips_start_a_few_rows_before():
    left, right = pair(2 * STRIP, 9)
    config = stereo(disparities=16, block_size=3)
    np.testing.assert_array_equal(Census(config)._raw(left, right), slow(left, right, config))


def test_threads_and_frames_before_change_nothing():
    config = stereo(disparities=64)
    frames = [pair(300, 61, 1), pair(300, 61, 2), pair(120, 40, 3), pair(300, 61, 1)]
    one, four = Census(config), Census(config.model_copy(update={"threads": 4}))
    found = [one._raw(*frame) for frame in frames]
    for frame, raw in zip(frames, found, strict=True):
        np.testing.assert_array_equal(four._raw(*frame), raw)
    np.testing.assert_array_equal(found[0], found[3])
    assert (found[0] != found[1]).any()


def test_the_vertical_path_may_come_from_below():
    left, right = pair(40, 50)
    above, below = (Census(stereo(from_below=value)) for value in (False, True))
    turned = above._raw(np.ascontiguousarray(left[::-1]), np.ascontiguousarray(right[::-1]))[::-1]
    below.lag_rows = above.lag_rows = 0.0
    upside = above(np.ascontiguousarray(left[::-1]), np.ascontiguousarray(right[::-1]))[::-1]
    np.testing.assert_array_equal(below(left, right), upside)
    assert (turned != above._raw(left, right)).any()


@pytest.mark.parametrize(("gain", "offset"), [(0.7, 0), (1.0, 25)])
def test_eyes_may_be_exposed_differently(gain, offset):
    left, right = pair(90, 160, shift=12)
    other = np.clip(right * gain + offset, 0, 255).astype(np.uint8)
    for aligned in ("left", "right"):
        found = match_aligned(Census(stereo()), left, other, aligned)
        kept = np.isfinite(found)
        assert kept[:, 20:-20].mean() > 0.9
        assert np.mean(np.abs(found[kept] - 12) < 1) > 0.97


def test_bright_lines_are_not_taken_for_what_is_behind_them():
    import cv2

    random, lines = np.random.default_rng(3), np.arange(60, 300, 20)
    smooth = cv2.GaussianBlur(random.normal(size=(100, 330)), (0, 0), 1.5)
    wall = 120 + 20 * smooth / smooth.std()
    left, right = wall[:, :320].copy(), wall[:, 5:325].copy()
    left[:, lines], right[:, lines - 20] = 200, 200
    eyes = (np.clip(eye + random.normal(0, 2, eye.shape), 0, 255).astype(np.uint8) for eye in (left, right))
    found = Census(stereo(disparities=64))(*eyes)
    assert np.mean(np.abs(found[:, lines - 10] - 5) < 1) > 0.9
    assert np.mean(found[:, lines] < 12) < 0.3  # 0.97 where every jump costs the same


def test_small_patches_are_dropped():
    left, right = pair(60, 120, shift=12)
    right[20:30, 60:70] = pair(60, 120, seed=9)[1][20:30, 60:70]
    loose, strict = (Census(stereo(speckle_size=size, left_right=0, uniqueness=0))(left, right) for size in (0, 200))
    assert np.isnan(strict).sum() > np.isnan(loose).sum()


def test_windows_whose_costs_overflow_are_refused():
    Census(stereo(block_size=19))
    with pytest.raises(ConfigError, match="block_size 21: too large"):
        Census(stereo(block_size=21))
