# SPDX-License-Identifier: Apache-2.0
"""Accuracy of the stitched sphere of a simulated drone with four stereo cameras, direction by direction.

python benchmarks/surround.py [MOMENTS] [SCALE] [STEP_DEG] [KEY=VALUE ...]      for example: 6 2 1 sphere.spread=2
"""

import sys
from time import perf_counter

import numpy as np

from stereovox.config import Config, load_config, parse_value
from stereovox.depth import prepare
from stereovox.depth.sphere import SphereGrid, accumulate, stitch
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.frame import Frame, Reason
from stereovox.geometry.se3 import inverse
from stereovox.sensors.noise import SUBPIXEL
from stereovox.simulate.surround import Surround
from stereovox_lab.checks.surround import nearest_surfaces, range_sigma, seen_cells, sphere_score

STATISTICS = {"minimum": {"sphere.statistic": "minimum"}, "mean - 3 std": {}, "mean - 2 std": {"sphere.spread": 2.0}}


def main(moments: str = "6", scale: str = "1", step_deg: str = "1", *overrides: str) -> None:
    given = {key: parse_value(value) for key, _, value in (text.partition("=") for text in overrides)}
    settings = {"max_range": 20.0, "depth.denoise": False, "sphere.step_deg": float(step_deg), **given}
    config = load_config(**settings)
    drone = Surround(f"sim:surround?scale={scale}")
    last = drone.options.moments - 1
    chosen = sorted({round(m) for m in np.linspace(0, last, int(moments))})
    for kind in ("exact depth", "matched"):
        noise = SUBPIXEL
        looks = [[Look(drone, 4 * m + k, kind, config) for k in range(4)] for m in chosen]
        if kind == "matched":
            noise = report_matching(looks)
        for name, more in STATISTICS.items():
            cell_rules = load_config(**{**settings, **more})
            rows = [score(drone, four, cell_rules, noise) for four in looks]
            means = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
            print(
                f"{kind:>11}, {name:>12}: {means['directions']:6.0f} directions seen, {means['known']:.4f} known; of "
                f"these within 3 % {means['close']:.4f} (of all {means['close_of_seen']:.4f}), "
                f"over by 2 sigma {means['over']:.4f}, median error {means['median']:+.4f}; grids {means['ms']:.1f} ms",
                flush=True,
            )


class Look:
    """One pair's frame: its estimated depth, the true one, and its time."""

    def __init__(self, drone: Surround, i: int, kind: str, config: Config):
        self.i, self.pair = i, drone.pairs[i % len(drone.pairs)]
        self.truth = drone.exact(i)
        self.ms = 0.0
        self.frame: Frame = self.truth
        if kind == "matched":
            stereo = drone.frame(i)
            start = perf_counter()
            self.frame = StereoDepth(config.stereo)(stereo)
            self.ms = 1e3 * (perf_counter() - start)

    def grid(self, config: Config) -> SphereGrid:
        T_body_eye = self.pair.T_body_camera @ inverse(self.truth.T_world_sensor) @ self.frame.T_world_sensor
        return accumulate(prepare(self.frame, config), T_body_eye, config)

    def disparity_error(self) -> tuple[np.ndarray, float]:
        """Errors in pixels where both have a depth, and the share of true pixels that do."""
        there = self.truth.reason == Reason.VALID
        found = there & np.isfinite(self.frame.depth) & (self.frame.depth > 0)
        found &= (self.frame.reason == Reason.VALID) if self.frame.reason is not None else True
        error = disparity_of(self.pair, self.frame.depth) - disparity_of(self.pair, self.truth.depth)
        return error[found], found.sum() / there.sum()


def disparity_of(pair, depth_m):
    """Disparities (height, width) in pixels of left-aligned depths."""
    camera = pair.camera
    with np.errstate(all="ignore"):
        if pair.name in ("left", "right"):
            slope = camera.rays()[0].astype(float)
            return (np.arctan(slope) - np.arctan(slope - camera.baseline / depth_m)) / camera.step_u
        return camera.fx * camera.baseline / depth_m


def report_matching(looks) -> float:
    """Print the quality of the matching; return the standard deviation of good disparities in pixels."""
    good = []
    for k, pair in enumerate(four.pair for four in looks[0]):
        errors, density = zip(*(four[k].disparity_error() for four in looks), strict=True)
        error = np.concatenate(errors)
        good.append(error[np.abs(error) < 1])
        print(
            f"    {pair.name:>5}: density {np.mean(density):.3f}, beyond 1 px {(np.abs(error) > 1).mean():.4f}, std of "
            f"the rest {good[-1].std():.3f} px, {np.median([four[k].ms for four in looks]):.0f} ms"
        )
    return float(np.concatenate(good).std())


def score(drone: Surround, four: list[Look], config: Config, noise: float) -> dict[str, float]:
    start = perf_counter()
    grids = [look.grid(config) for look in four]
    whole = stitch(grids)
    ms = 1e3 * (perf_counter() - start)
    T_world_body = drone.body_pose(four[0].i)
    nearest, _ = nearest_surfaces(drone.scene, T_world_body, whole.layout)
    seen = seen_cells(drone.scene, drone.pairs, T_world_body, whole.layout)
    sigma = np.zeros(whole.layout.shape)
    for look, own in zip(four, grids, strict=True):
        won = own.range_m == whole.range_m
        sigma = np.where(won, range_sigma(look.pair, whole.layout, nearest, noise), sigma)
    return {**sphere_score(whole, nearest, seen, sigma), "ms": ms}


if __name__ == "__main__":
    main(*sys.argv[1:])
