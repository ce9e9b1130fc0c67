# SPDX-License-Identifier: Apache-2.0
"""A board of equal stripes in front of a textured wall, by stereo: share of wrong disparities, and their confidence.

    python benchmarks/stripes.py [--periods 5,8,12,20,33] [--grain 0,4] [--seeds 2] [--set stereo.uniqueness=30 ...]

Every stripe looks like the next but one, so only the board's edges, and its grain (a standard deviation in grey values;
0: none), distinguish them. Pairs of 480x200, boards of 240x120, disparities 24.3 and 15.6 px, stripes 12 and
40 grey values brighter or darker than the board, image noise of 2.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
from numpy.typing import NDArray
from poles import CAMERA, FINE, HEIGHT, NOISE, WIDTH, grain

from stereovox.cameras.rigs import StereoPair
from stereovox.config import load_config
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.frame import StereoFrame

MARGIN = 64
ROWS, COLUMNS = slice(40, 160), (120, 360)
INNER = slice(50, 150), slice(130, 350)
"""The judged part: the board without its edges."""
DISPARITIES = (24.3, 5.0), (15.6, 4.0)
CONTRASTS = 12, 40
WRONG_PX = 3.0


def rendered(random: np.random.Generator, where: tuple[float, float], period: float, contrast: float, rough: float):
    """Return the left and the right image."""
    wall = 120 + grain(random, WIDTH + 2 * MARGIN, 12)
    start, stop, off = MARGIN * FINE, (MARGIN + WIDTH) * FINE, round(where[1] * FINE)
    sides = [wall[:, start:stop].copy(), wall[:, start + off : stop + off].copy()]
    first, last = (FINE * column for column in COLUMNS)
    bright = np.arange(last - first) // max(1, round(period * FINE / 2)) % 2 == 0
    texture = grain(random, (last - first) // FINE, rough)[ROWS] if rough else 0.0
    board = 120 + np.where(bright, contrast, -contrast) + texture
    for image, shift in zip(sides, (0, round(where[0] * FINE)), strict=True):
        image[ROWS, first - shift : last - shift] = board
    images = [side.reshape(HEIGHT, WIDTH, FINE).mean(2) for side in sides]
    return [np.clip(np.rint(i + NOISE * random.standard_normal(i.shape)), 0, 255).astype(np.uint8) for i in images]


def shares(depth: StereoDepth, images: list[NDArray[np.uint8]], true: float) -> list[float]:
    """Return the shares of the board's pixels with a value, with a wrong one, and with one that clears the board."""
    found = depth.disparity(StereoFrame(*images, StereoPair(CAMERA), np.eye(4)))
    error = found.disparity[INNER] - true
    return [np.isfinite(error).mean(), (np.abs(error) > WRONG_PX).mean(), (error < -WRONG_PX).mean()]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--periods", default="5,8,12,20,33", help="pixels (%(default)s)")
    parser.add_argument("--grain", default="0,4", help="standard deviations (%(default)s)")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="further settings")
    given = parser.parse_args()
    settings = {"stereo.disparities": 64, "stereo.threads": 1, **dict(one.split("=", 1) for one in given.set)}
    depth = StereoDepth(load_config(**settings).stereo)
    print("grain  period   with a value   wrong by > 3 px   too far by > 3 px   (% of the board's pixels)")
    for rough, period in product(given.grain.split(","), given.periods.split(",")):
        rows = [
            shares(depth, rendered(np.random.default_rng([s, 99]), d, float(period), c, float(rough)), d[0])
            for s, d, c in product(range(given.seeds), DISPARITIES, CONTRASTS)
        ]
        value, wrong, far = (100 * np.mean(rows, axis=0)).tolist()
        print(f"{float(rough):5g} {float(period):7g} {value:14.1f} {wrong:17.1f} {far:19.1f}", flush=True)


if __name__ == "__main__":
    main()
