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
STEPS = np.array([1, 2, 4])
"""How many pixels away the neighbours are, pass by pass."""
FROM = np.array([1, 1, 3])
"""In which pass a pixel takes part: where its noise is more than so many times FINE cells."""
WIDTHS = np.array([4.5, 4.5, 4.0], np.float32)
"""A neighbour counts less the more it differs, and not at all from so many sigma on."""
LIMIT = 1.3
"""Sigma counts for no more than so many cells: what the map can tell apart is not mixed, however noisy the camera."""


def denoise(depth_m: NDArray[np.float32], camera: VirtualCamera, config: Config) -> None:
    """Average each depth with its like neighbours, in place.

    depth_m: (height, width) float32 metres with REP 117's special values, contiguous. Pixels without value stay as they
    are and count nowhere; values stay within min_range and max_range.

    A sigma filter (Lee 1983) whose weights (1 - (difference / (k sigma))^2)^4 fall smoothly, in passes with holes
    ("a trous", Dammertz 2010): with the next neighbours to the left and right, above and below, then with those 2
    pixels away, then 4. So few neighbours go far, and the noise of stereo, which is alike over about its matching
    window, is taken out as well. It works on inverse depth, in which stereo noise is the same everywhere and a plane is
    linear, so a mean over symmetric neighbours is true to it. sigma is the noise model's: the configured one, or the
    camera's. A pixel asks for no more passes than it takes: it is left alone where sigma(depth) is at most FINE cells,
    and by the last pass up to three times that. So what is near keeps every detail. Nothing is done where even the
    farthest noise is less than WORTH cells.

    Row and column together keep what is thin: a pole finds its like along the column while its row shows the wall
    behind, and a wire the other way round; in later passes what noise is left no longer hides the step. Were the row
    averaged alone first, a pole two sigma before its wall would be gone.

    What it cannot do: a step of less than about two sigma is smoothed over some pixels.
    """
    if not config.depth.denoise:
        return
    noise, farthest = RangeNoise.of(config.noise, camera), config.max_range
    if noise.s0 + (noise.s1 + noise.s2 * farthest) * farthest > WORTH * config.voxel_size:
        _run(depth_m, noise, FINE * config.voxel_size, config)


def _run(depth_m: NDArray[np.float32], noise: RangeNoise, fine: float, config: Config) -> None:
    margin = int(STEPS.max())
    rings = np.empty((len(STEPS) + 1, 2 * margin + 1, depth_m.shape[1] + 2 * margin), np.float32)
    coefficients, least = np.array([noise.s0, noise.s1, noise.s2], np.float32), (fine * FROM).astype(np.float32)
    low, high, limit = (np.float32(x) for x in (config.min_range, config.max_range, LIMIT * config.voxel_size))
    _denoise.denoise(depth_m, coefficients, STEPS, least, WIDTHS, limit, low, high, rings)
