# SPDX-License-Identifier: Apache-2.0
"""Block minima against loops over single pixels."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.frame import Frame, Reason
from stereovox.sensors.noise import RangeNoise

WITHOUT = dict.fromkeys(Reason, np.nan) | {Reason.TOO_NEAR: -np.inf, Reason.TOO_FAR: np.inf}


def slow(image, n):
    height, width = image.depth_m.shape
    rows, columns = -(-height // n), -(-width // n)
    depth, reason = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.uint8)
    for i in range(rows):
        for j in range(columns):
            d = image.depth_m[i * n : (i + 1) * n, j * n : (j + 1) * n]
            why = image.reason[i * n : (i + 1) * n, j * n : (j + 1) * n]
            if (why == Reason.VALID).any():
                depth[i, j] = d[why == Reason.VALID].min()
                continue
            order = [Reason.TOO_NEAR, Reason.MASKED, Reason.UNMATCHED, Reason.UNKNOWN]
            reason[i, j] = next((r for r in order if (why == r).any()), Reason.TOO_FAR)
            depth[i, j] = WITHOUT[Reason(reason[i, j])]
    return depth, reason


@pytest.mark.parametrize("n", [1, 2, 4, 8, 10])
def test_equals_the_slow_one(n):
    random = np.random.default_rng(n)
    camera = PinholeCamera.from_field_of_view(94, 61, 80, 0.05)
    depth = random.uniform(0.05, 7, (61, 94)).astype(np.float32)
    blocks = np.kron(random.integers(0, 9, (7, 10)), np.ones((10, 10), int))[:61, :94]
    given = np.where(blocks < 6, blocks, 0).astype(np.uint8)
    depth[given == Reason.TOO_FAR] = 0
    given[random.random(given.shape) < 0.02] = 0
    given[random.random(given.shape) < 0.02] = Reason.UNMATCHED
    frame = Frame(depth, camera, np.eye(4), reason=given)
    full = prepare(frame, load_config("default"))
    small = prepare(frame, load_config("default", **{"depth.downsample": n}))
    wanted_depth, wanted_reason = slow(full, n)
    np.testing.assert_array_equal(small.depth_m, wanted_depth)
    np.testing.assert_array_equal(small.reason, wanted_reason)
    assert n > 2 or set(np.unique(small.reason)) == set(Reason)


def test_the_binned_camera_sees_where_its_blocks_are():
    camera = PinholeCamera(94, 61, 50.0, 51.0, 46.3, 29.8, 0.05)
    small = camera.binned(8)
    u, v = 5, 3
    middle = (8 * u + 3.5 - camera.cx) / camera.fx, (8 * v + 3.5 - camera.cy) / camera.fy
    np.testing.assert_allclose(((u - small.cx) / small.fx, (v - small.cy) / small.fy), middle)
    noise = load_config("default").noise
    assert RangeNoise.of(noise, small) == RangeNoise.of(noise, camera)  # the sensor is the same
