# SPDX-License-Identifier: Apache-2.0
"""Corrected depth: the kernels against plain NumPy, and what becomes of pixels that a correction moves out of range."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.cameras.pinhole import DepthCorrection, PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.depth.prepare import correct
from stereovox.errors import StereovoxError
from stereovox.frame import Frame, Reason

CAMERA = PinholeCamera(40, 30, 30.0, 32.0, 18.7, 15.2, 0.05)
ROW = PinholeCamera(6, 1, 50.0, 50.0, 2.5, 0.0)
V, U, N, F = Reason.VALID, Reason.UNKNOWN, Reason.TOO_NEAR, Reason.TOO_FAR


def slowly(correction, depth, camera):
    """The formulas of DepthCorrection, pixel by pixel."""
    result = np.full(depth.shape, np.nan)
    for v, u in np.ndindex(depth.shape):
        x, y, z = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, float(depth[v, u])
        c = correction.coefficients
        terms = np.array([1, x, y, x**2, x * y, y**2])
        if correction.model == "thesis":
            X = x * z
            true = z - (c[0] * X**2 + c[1] * X + c[2])
        elif correction.model == "scale":
            true = z / (1 + terms @ c)
        elif correction.model == "disparity":
            true = 1 / (1 / z + terms @ c)
        else:
            true = 1 / (1 / z + terms @ c[:6] / z + terms @ c[6:])
        result[v, u] = true if true > 0 else np.nan
    return result


def example(model, size):
    return DepthCorrection(model, tuple(np.random.default_rng(size).normal(0, 0.15, size)))


@pytest.mark.parametrize(("model", "size"), [("scale", 6), ("disparity", 6), ("scale+disparity", 12), ("thesis", 3)])
def test_kernels_say_what_the_formulas_say(model, size):
    correction = example(model, size)
    depth = np.random.default_rng(1).uniform(0.3, 6, (30, 40)).astype(np.float32)
    depth[3, 5:9] = np.nan, np.nan, np.inf, -np.inf
    got = depth.copy()
    correct(got, replace(CAMERA, correction=correction))
    wanted = np.where(np.isinf(depth), depth, slowly(correction, np.where(np.isinf(depth), 1, depth), CAMERA))
    np.testing.assert_allclose(got, wanted, rtol=2e-5)
    np.testing.assert_array_equal(got[3, 5:9], depth[3, 5:9])
    assert np.nanmax(np.abs(got[4:] / depth[4:] - 1)) > 0.05, "the example must change something"


def test_without_correction_nothing_changes():
    depth = np.full((30, 40), 1.5, np.float32)
    correct(depth, CAMERA)
    assert (depth == np.float32(1.5)).all()


def image_of(depth, correction, **changes):
    config = load_config(min_range=0.5, max_range=5.0, **changes.pop("settings", {}))
    camera = replace(ROW, correction=correction)
    return prepare(Frame(np.array([depth]), camera, np.eye(4), **changes), config)


def test_the_limits_hold_for_corrected_depths():
    tenth_nearer = DepthCorrection("scale", (1 / 9, 0, 0, 0, 0, 0))
    image = image_of(np.array([5400, 5600, 540, 570, 0, 65535], np.uint16), tenth_nearer, depth_scale=0.001)
    assert image.reason.tolist() == [[V, F, N, V, U, U]]
    expected = [[4.86, np.inf, -np.inf, 0.513, np.nan, np.nan]]
    np.testing.assert_allclose(image.depth_m, np.array(expected, np.float32), rtol=1e-5)


def test_a_pixel_may_become_too_far_or_leave_too_near():
    tenth_farther = DepthCorrection("scale", (-1 / 11, 0, 0, 0, 0, 0))
    image = image_of(np.array([4.7, 4.5, 0.46, 0.44, np.nan, np.inf]), tenth_farther)
    assert image.reason.tolist() == [[F, V, V, N, U, U]]


def test_what_no_depth_comes_out_of_clears_nothing():
    beyond_infinity = DepthCorrection("disparity", (-0.25, 0, 0, 0, 0, 0))
    image = image_of(np.array([4.5, 3.9, 2.0, 1.0, 0.5, 6.0], np.float32), beyond_infinity)
    assert image.reason.tolist() == [[U, F, V, V, V, U]]
    away = DepthCorrection("thesis", (0, 0, 3.0))
    assert image_of(np.array([2.0, 4.0, 3.0, 5.0, 1.0, 8.5]), away).reason.tolist() == [[U, V, U, V, U, F]]


def test_the_sources_reason_still_comes_first():
    given = np.array([[F, Reason.MASKED, F, N, 0, U]], np.uint8)
    nothing_much = DepthCorrection("scale", (0.001, 0, 0, 0, 0, 0))
    image = image_of(np.array([0.0, 1.0, 1.0, 1.0, 9.0, 1.0]), nothing_much, reason=given)
    assert image.reason.tolist() == [[F, Reason.MASKED, U, N, F, U]]


def test_blocks_take_their_smallest_corrected_depth():
    left_nearer = DepthCorrection("scale", (0, -5.0, 0, 0, 0, 0))  # the left column was seen too far
    raw = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.5])
    corrected = image_of(raw, left_nearer)
    halved = image_of(raw, left_nearer, settings={"depth.downsample": 2})
    np.testing.assert_array_equal(halved.depth_m, corrected.depth_m.reshape(1, 3, 2).min(axis=2))


@pytest.mark.parametrize(
    ("model", "numbers", "said"),
    [
        ("tesis", (0, 0, 0), "did you mean 'thesis'"),
        ("thesis", (0, 0), "needs 3 finite coefficients"),
        ("scale", (0, 0, 0, 0, 0, float("nan")), "needs 6 finite"),
    ],
)
def test_impossible_corrections(model, numbers, said):
    with pytest.raises(StereovoxError, match=said) as refused:
        DepthCorrection(model, numbers)
    assert "\n" not in str(refused.value)


def test_corrections_are_values():
    one, other = DepthCorrection("thesis", (1, 2, 3)), DepthCorrection("thesis", [1.0, 2.0, 3.0])
    assert one == other
    assert len({one, other}) == 1
    assert replace(CAMERA, correction=one) in {replace(CAMERA, correction=other)}
