# SPDX-License-Identifier: Apache-2.0
"""Take the noise of stereo matching out of a depth image and leave its edges where they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.depth import _denoise
from stereovox.rigs import VirtualCamera
from stereovox.sensors.noise import RangeNoise

FINE = 0.15
"""Noise of this share of a cell does not thicken a surface noticeably."""
WORTH = 0.5
"""Where no noise exceeds this share of a cell, raw depth maps as well: in the demo at 0.2 m even a little better."""
WIDTHS = (5.0, 6.0)
"""A neighbour counts less the more it differs, and not at all from so many sigma on: in the first and second pass."""
LIMIT = 6.0
"""Nor from so many cells on: what the map can tell apart is not mixed, however noisy the camera is."""


def denoise(depth_m: NDArray[np.float32], camera: VirtualCamera, config: Config) -> None:
    """Average each depth with its like neighbours, in place.

    depth_m: (height, width) float32 metres with REP 117's special values, contiguous. Pixels without value stay as they
    are and count nowhere; values stay within min_range and max_range.

    A sigma filter (Lee 1983) whose weights (1 - (difference / (k sigma))^2)^4 fall smoothly. It works on inverse depth,
    in which stereo noise is the same everywhere and a plane is linear, so a mean over symmetric neighbours is true to
    it. sigma is the noise model's: the configured one, or the camera's. A pixel is averaged with up to 3 neighbours on
    each side in its row and in its column, and the result once more. A pixel asks for no more neighbours than it takes
    to bring its noise down to FINE cells: the s-th on each side only where sigma(depth) > (2 s - 1) FINE voxel_size. So
    what is near keeps every detail. Nothing is done where even the farthest noise is less than WORTH cells.

    Row and column together keep what is thin: a pole finds its like along the column while its row shows the wall
    behind, and a wire the other way round; in the second pass what noise is left no longer hides the step. Were the
    row averaged alone first, a pole two sigma before its wall would be gone.

    What it cannot do: neighbouring errors of real stereo matching are alike over about the matching window, and what
    they have in common stays in the mean. A step of less than about two sigma is smoothed over some pixels.
    """
    if not config.depth.denoise:
        return
    noise, farthest = RangeNoise.of(config.noise, camera), config.max_range
    if noise.s0 + (noise.s1 + noise.s2 * farthest) * farthest > WORTH * config.voxel_size:
        _run(depth_m, noise, FINE * config.voxel_size, config)


def _run(depth_m: NDArray[np.float32], noise: RangeNoise, fine: float, config: Config) -> None:
    raw, once = np.empty((2, _denoise.RING, depth_m.shape[1] + 2 * _denoise.RADIUS), np.float32)
    coefficients = np.array([noise.s0, noise.s1, noise.s2], np.float32)
    low, high, limit = np.float32(config.min_range), np.float32(config.max_range), np.float32(LIMIT * config.voxel_size)
    _denoise.denoise(
        depth_m, coefficients, np.float32(fine), np.array(WIDTHS, np.float32), limit, low, high, raw, once
    )  # fmt: skip
