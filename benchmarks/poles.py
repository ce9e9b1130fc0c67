# SPDX-License-Identifier: Apache-2.0
"""Thin poles in front of a textured wall, by stereo: the fate of their pixels.

    python benchmarks/poles.py [METHODS] [--widths 1,2,4] [--seeds 8] [--first-seed 300] [--set stereo.halve=true ...]

Pairs of 480x200 are rendered in eighths of a pixel, with grain of all sizes on the wall, and poles of 1, 2 and 4 px
that are alternately brighter and darker. A pole's pixel that gets the wall's disparity is the dangerous error: it
clears the pole. Settings were chosen on seeds 100 to 102.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.config import load_config
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.frame import Reason, StereoFrame

HEIGHT, WIDTH, FINE = 200, 480, 8
MARGIN = 32
"""Columns of wall beyond the image, for the other eye."""
WIDTHS = 1.0, 2.0, 4.0
NOISE = 2.0
GRAIN = (32, 1.0), (16, 1.0), (8, 1.0), (4, 1.0), (2, 1.0), (1, 0.5)
"""Sizes of the wall's grain in pixels, and their weights."""
CAMERA = PinholeCamera(WIDTH, HEIGHT, 400.0, 400.0, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, baseline=0.1)


@dataclass(frozen=True)
class Case:
    """Disparities in pixels, contrast of a pole in grey values, and standard deviations of the grain."""

    pole: float
    wall: float
    contrast: float
    wall_grain: float
    pole_grain: float


DISPARITIES = (10.3, 4.0), (20.6, 5.0), (39.4, 8.0)
CASES = [
    Case(*where, contrast, *grain) for where, contrast, grain in product(DISPARITIES, (10, 30, 70), ((25, 8), (12, 2)))
]


def grain(random: np.random.Generator, width: int, spread: float) -> NDArray[np.float64]:
    """Return a texture (HEIGHT, width * FINE) of mean 0."""
    total = np.zeros((HEIGHT, width * FINE))
    for size, weight in GRAIN:
        rows, columns = HEIGHT // size + 3, width // size + 3
        coarse = random.standard_normal((rows, columns)).astype(np.float32)
        smooth = cv2.resize(coarse, (columns * size * FINE, rows * size), interpolation=cv2.INTER_CUBIC)
        v, u = random.integers(0, size), random.integers(0, size * FINE)
        total += weight * smooth[v : v + HEIGHT, u : u + width * FINE]
    return spread * total / total.std()


def rendered(
    random: np.random.Generator, case: Case, widths: Sequence[float] = WIDTHS
) -> tuple[list[NDArray[np.uint8]], list[tuple[slice, float]]]:
    """Return the left and right image, and for each pole its columns in the left one and its width."""
    wall = 120 + grain(random, WIDTH + 2 * MARGIN, case.wall_grain)
    start, stop, off = MARGIN * FINE, (MARGIN + WIDTH) * FINE, round(case.wall * FINE)
    sides, poles = [wall[:, start:stop].copy(), wall[:, start + off : stop + off].copy()], []
    for k, column in enumerate(range(60, WIDTH - 20, 40)):
        width = widths[k % len(widths)]
        first, size = round((column + random.random()) * FINE), round(width * FINE)
        grey = 120 + (case.contrast if k % 2 == 0 else -case.contrast)
        pole = grey + grain(random, int(width) + 2, case.pole_grain)[:, :size]
        for image, shift in zip(sides, (0, round(case.pole * FINE)), strict=True):
            image[:, first - shift : first - shift + size] = pole
        middle = (first + size / 2) / FINE
        poles.append((slice(round(middle - width / 2), round(middle + width / 2)), width))
    images = [
        side.reshape(HEIGHT, WIDTH, FINE).mean(2) + NOISE * random.standard_normal((HEIGHT, WIDTH)) for side in sides
    ]
    return [np.clip(np.rint(image), 0, 255).astype(np.uint8) for image in images], poles


def shares(depth: StereoDepth, case: Case, seed: int, widths: Sequence[float] = WIDTHS) -> dict[float, list[float]]:
    """Return, for each width, the shares of the poles' pixels with the wall's disparity, their own, and none."""
    (left, right), poles = rendered(np.random.default_rng([seed, 4242]), case, widths)
    found = depth.disparity(StereoFrame(left, right, StereoPair(CAMERA), np.eye(4)))
    far = found.reason == Reason.TOO_FAR
    valid, disparity = far | (found.reason == Reason.VALID), np.where(far, 0.0, found.disparity)
    of_width: dict[float, list[list[float]]] = {}
    for columns, width in poles:
        has, value = valid[:, columns], disparity[:, columns]
        behind = has & (value < (case.pole + case.wall) / 2)
        right_here = has & (abs(value - case.pole) <= 1.5)
        of_width.setdefault(width, []).append([behind.mean(), right_here.mean(), 1 - has.mean()])
    return {width: np.mean(rows, axis=0).tolist() for width, rows in of_width.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("methods", nargs="?", default="census,sgm", help="names of matchers (%(default)s)")
    parser.add_argument("--widths", default=",".join(f"{width:g}" for width in WIDTHS), help="pixels (%(default)s)")
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--first-seed", type=int, default=300)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE", help="further settings")
    arguments = parser.parse_args()
    widths = [float(width) for width in arguments.widths.split(",")]
    given = dict(one.split("=", 1) for one in arguments.set)
    print(f"{'':10} width   taken for the wall   right   no value   (% of the poles' pixels)")
    for method in arguments.methods.split(","):
        settings = {"stereo.method": method, "stereo.disparities": 64, "stereo.threads": 1, **given}
        depth = StereoDepth(load_config(**settings).stereo)
        seeds = range(arguments.first_seed, arguments.first_seed + arguments.seeds)
        runs = [shares(depth, case, seed, widths) for case in CASES for seed in seeds]
        for width in widths:
            wall, right, none = (100 * np.mean([run[width] for run in runs], axis=0)).tolist()
            print(f"{method:10} {width:2.0f} px   {wall:18.1f} {right:7.1f} {none:10.1f}", flush=True)


if __name__ == "__main__":
    main()
