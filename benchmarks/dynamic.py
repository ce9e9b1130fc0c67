# SPDX-License-Identifier: Apache-2.0
"""How long do ghosts remain, and does a thin pole that is often missed remain? A comparison of four models.

    python benchmarks/dynamic.py [--voxel-size 0.1] [--width 424] [--pole 0.03] [--missed background|unmatched] [--json]
                                 [--picture dynamic.png]

A person walks across the view of a simulated static D435, 30 frames a second, and leaves. Behind: a wall within range;
nothing, reported as such by the camera; nothing, without a reason for the missing value. A pole next to the path is
measured in one frame of three; in the others it has no value, or shows the background.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from stereovox_lab.checks.ghosts import Ghosts, ghosts
from stereovox_lab.checks.passer_by import BACKGROUNDS, HZ, MISSES, PasserBy

MODELS: dict[str, dict[str, Any]] = {
    "default": {},
    "Chien 2020": {"profile": "chien2020", "up": "z", "window.size": None, "depth.downsample": 1},
    "Valenti 2018": {"profile": "valenti2018", "min_range": 0.2},
    "OctoMap": {
        "integrator": "ray",
        "ray.update": "once",
        "blind_range": 0.0,
        "sensor.model": "constant",
        "depth.denoise": False,
        "map.prior": 0.5,
        "map.log_odds_min": -2.0,
        "map.log_odds_max": 3.5,
        "map.free_below": 0.499,
        "map.occupied_above": 0.5,
    },
}
COLUMNS = ("gone_longest_s", "free_longest_s", "after_leaving_s", "left", "unseen", "pole_lost", "pole_free")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--voxel-size", type=float, default=0.1)
    parser.add_argument("--width", type=int, default=424, help="pixels across")
    parser.add_argument("--pole", type=float, default=0.03, help="thickness of the pole in metres")
    parser.add_argument("--every", type=int, default=3, help="the pole is measured in one frame of so many")
    parser.add_argument("--missed", choices=MISSES, default="background")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--picture", type=Path)
    wanted = parser.parse_args()
    found: dict[str, dict[str, Ghosts]] = {}
    if not wanted.json:
        print(f"{'background':11} {'model':13}", *(f"{name:>15}" for name in COLUMNS))
    for background in BACKGROUNDS:
        source = PasserBy(
            background, pole_m=wanted.pole, pole_every=wanted.every, missed=wanted.missed, image_width=wanted.width
        )
        frames = [source.frame(i) for i in range(len(source))]
        found[background] = {}
        for name, settings in MODELS.items():
            found[background][name] = ghosts(
                source, frames, **{**settings, "voxel_size": wanted.voxel_size, "max_range": 5.0}
            )
            if not wanted.json:
                told = found[background][name].as_dict()
                print(f"{background:11} {name:13}", *(f"{shown(told[column]):>15}" for column in COLUMNS), flush=True)
    if wanted.json:
        print(json.dumps({key: {name: one.as_dict() for name, one in row.items()} for key, row in found.items()}))
    if wanted.picture:
        draw(found, wanted.picture)


def shown(value: float | None) -> str:
    return "never" if value is None else f"{value:.3f}" if isinstance(value, float) else str(value)


def draw(found: dict[str, dict[str, Ghosts]], path: Path) -> None:
    """Draw the number of ghosts against time, one chart for each background."""
    from stereovox.view.figures import blank, labels, png_of

    figure = blank(7, 6)
    charts = figure.subplots(len(found), 1, sharex=True)
    for chart, (background, models) in zip(charts, found.items(), strict=True):
        for name, one in models.items():
            chart.plot(np.arange(len(one.number)) / HZ, one.number, label=name)
        chart.set_title(f"background: {background}", loc="left", fontsize=9)
        labels(chart, "seconds" if chart is charts[-1] else "", "cells that are ghosts")
    charts[0].legend(frameon=False, fontsize=8)
    path.write_bytes(png_of(figure, 120))


if __name__ == "__main__":
    main()
