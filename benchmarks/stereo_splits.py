# SPDX-License-Identifier: Apache-2.0
"""Loss of stereo settings on scenes they were not chosen on.

    python benchmarks/stereo_splits.py FOLDER [--pairs FOLDER:SCALE ...] [--density 85] [--grid p1=8,16,24 ...]
                                       [--choose 0,2,4,6] [--set method=sgm ...]

FOLDER: scenes of KITTI stereo 2015, as for stereo2015.py. Of every way to take half of them (or those of `--choose`, by
place), the settings of the grid with the fewest errors over 3 px on that half are chosen, each with the confidence that
leaves `--density` per cent of the truth's pixels there; what they do on the other half is reported, next to the
defaults
and what was best there in hindsight. `--pairs`: scenes of Middlebury, never chosen on: folders with im2, im6 and disp2
(2001, 2003) or view1, view5 and disp1 (2005, 2006), disparity = value / SCALE, searched up to 80.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations, product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from stereo2015 import scene, scenes

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.config import load_config, parse_value
from stereovox.depth.stereo.disparity import Disparity
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.frame import StereoFrame

LEVELS = 1000
"""Steps of confidence."""
LIMITS = 1.0, 2.0, 3.0
"""Errors in pixels above which a disparity is wrong; the last one decides the choice."""
DEFAULT = 1 + int(LEVELS * load_config().stereo.min_confidence)
"""The level of the default confidence."""
GRID = "p1=8,16,24", "p2=40,64,96", "uniqueness=5,15,25", "block_size=3,5,7", "speckle_size=100,400,800"
NAMES = ("im2", "im6", "disp2"), ("view1", "view5", "disp1")
Tally = NDArray[np.int64]
"""(1 + len(LIMITS), LEVELS + 1): number of the truth's pixels with a disparity of at least this confidence, and of
wrong ones; the first of column 0 is all pixels of the truth."""
Pair = tuple[StereoFrame, NDArray[np.float64]]
"""Two images, and the true disparity of the left one (NaN: unknown)."""


@dataclass(frozen=True)
class Outcome:
    """Per cent of the truth's pixels with a value, and per cent of these that err by more than each of LIMITS."""

    density: float
    wrong: NDArray[np.float64]


Rows = dict[str, list[Outcome]]
"""One outcome per split, by name."""


def tally(found: Disparity, truth: NDArray[np.float64]) -> Tally:
    """Return the number of pixels present and wrong at each level of confidence or above."""
    has = np.isfinite(truth)
    kept = has & np.isfinite(found.disparity)
    level = np.minimum((LEVELS * found.confidence[kept]).astype(int), LEVELS - 1) + 1
    error = np.abs(found.disparity - truth)[kept]
    rows = [np.ones_like(error), *(error > limit for limit in LIMITS)]
    counts = np.stack([np.bincount(level, row, LEVELS + 1) for row in rows])
    out = counts[:, ::-1].cumsum(axis=1)[:, ::-1].astype(np.int64)
    out[0, 0] = has.sum()
    return out


def level_of(counts: Tally, density: float) -> int:
    """Return the highest level that leaves `density` per cent of the truth's pixels; 1, all, if none does."""
    enough = np.flatnonzero(100 * counts[0, 1:] >= density * counts[0, 0])
    return int(enough[-1]) + 1 if len(enough) else 1


def outcome(counts: Tally, level: int) -> Outcome:
    """Return the outcome of the pixels at this level or above."""
    kept = counts[0, level]
    return Outcome(100 * kept / counts[0, 0], 100 * counts[1:, level] / max(kept, 1))


def splits(count: int, chosen: list[int]) -> Iterator[tuple[list[int], list[int]]]:
    """Yield the scenes to choose on and the others: every half, or `chosen`."""
    halves = [tuple(chosen)] if chosen else combinations(range(count), count // 2)
    for half in halves:
        yield list(half), [i for i in range(count) if i not in half]


def middlebury(folder: Path, scale: float) -> Iterator[Pair]:
    """Yield the pairs of a folder, or of its folders, with their truth (NaN: unknown)."""
    for place in sorted({path.parent for path in folder.rglob("*") if path.stem in ("disp2", "disp1")}):
        for names in NAMES:
            files = [sorted(place.glob(f"{name}.*")) for name in names]
            if all(files):
                left, right, raw = (cv2.imread(str(found[0]), 0) for found in files)
                camera = PinholeCamera(left.shape[1], left.shape[0], 500.0, 500.0, 200.0, 200.0, 0.1)
                pair = StereoFrame(left, right, StereoPair(camera), np.eye(4), name=place.name)
                yield pair, np.where(raw > 0, raw / scale, np.nan)


def seen_by_both(truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a dense truth without pixels hidden from the right image: outside it, or behind a nearer surface."""
    out = truth.copy()
    for row, kept in zip(truth, out, strict=True):
        columns = np.flatnonzero(np.isfinite(row))
        partner = np.rint(columns - row[columns]).astype(int)
        nearest = np.full(len(row) + 2, -np.inf)
        inside = partner >= 0
        np.maximum.at(nearest, partner[inside] + 1, row[columns[inside]])
        around = np.max([nearest[:-2], nearest[1:-1], nearest[2:]], axis=0)
        kept[columns[~inside | (around[partner] > row[columns] + 1)]] = np.nan
    return out


def tallies(settings: dict[str, Any], pairs: list[Pair]) -> NDArray[np.int64]:
    """Return the tally of each pair with these settings."""
    depth = StereoDepth(load_config(**{"stereo.threads": 1, **settings, "stereo.min_confidence": 0}).stereo)
    return np.array([tally(depth.disparity(frame), truth) for frame, truth in pairs])


def line(name: str, rows: list[Outcome]) -> str:
    """Return mean and standard deviation over splits of density and of each of LIMITS."""
    wrong = np.array([row.wrong for row in rows])
    shares = "   ".join(f"{m:5.2f} ± {s:4.2f}" for m, s in zip(wrong.mean(0), wrong.std(0), strict=True))
    density = np.array([row.density for row in rows])
    return f"{name:43} {density.mean():5.1f} ± {density.std():3.1f}   {shares}   ({wrong[:, -1].max():.2f})"


def settings_of(grid: list[str]) -> list[dict[str, Any]]:
    """Return all settings of a grid like ["p1=8,16", "p2=40,64"]; preceded by the defaults."""
    axes = [(name, values.split(",")) for name, _, values in (axis.partition("=") for axis in grid)]
    rows = product(*([(f"stereo.{name}", parse_value(value)) for value in values] for name, values in axes))
    return [{}, *(dict(row) for row in rows)]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--pairs", action="append", default=[], metavar="FOLDER:SCALE")
    parser.add_argument("--density", type=float, default=85.0)
    parser.add_argument("--grid", nargs="*", default=GRID, metavar="NAME=VALUE,VALUE")
    parser.add_argument("--choose", default="", metavar="0,2,4,6")
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    given = parser.parse_args()
    fixed = {f"stereo.{name}": parse_value(value) for name, _, value in (one.partition("=") for one in given.set)}
    made = [{**fixed, **settings} for settings in settings_of(given.grid)]
    streets = [scene(path) for path in scenes(given.folder)]
    places = [one.rpartition(":") for one in given.pairs]
    others = [pair for folder, _, scale in places for pair in middlebury(Path(folder), float(scale))]
    print(
        f"{len(made) - 1} settings, {len(streets)} scenes, {len(others)} other pairs; density, over {LIMITS} px, in %"
    )
    print("(mean ± deviation over splits; in brackets the worst split's last)\n")
    counts = np.array([tallies(settings, streets) for settings in made])
    rows, picked = compared(counts, given.density, [int(i) for i in given.choose.split(",") if i])
    if others:
        rows |= elsewhere(made, picked, others, "the pairs")
        rows |= elsewhere(made, picked, [(frame, seen_by_both(true)) for frame, true in others], "what both eyes see")
    for name, values in rows.items():
        print(line(name, values))
    for best, times in Counter(best for best, _ in picked).most_common(5):
        print(f"chosen {times:3} times of {len(picked)}: {made[best]}")


def compared(counts: NDArray[np.int64], density: float, chosen: list[int]) -> tuple[Rows, list[tuple[int, int]]]:
    """Return the outcomes of choosing, and the settings and level of confidence that each split chose.

    counts: (settings, scenes) of `Tally`, the defaults first.
    """
    rows: Rows = {}
    picked: list[tuple[int, int]] = []
    for half, rest in splits(counts.shape[1], chosen):
        seen, unseen = counts[:, half].sum(1), counts[:, rest].sum(1)
        levels = [level_of(one, density) for one in seen]
        there = [outcome(one, level) for one, level in zip(seen, levels, strict=True)]
        best = 1 + int(np.argmin([one.wrong[-1] for one in there[1:]]))
        picked.append((best, levels[best]))
        for name, value in {
            "chosen, where chosen": there[best],
            "chosen, on the other half": outcome(unseen[best], levels[best]),
            "defaults, confidence chosen": outcome(unseen[0], levels[0]),
            "defaults as they are": outcome(unseen[0], DEFAULT),
            "best there in hindsight": min(
                (outcome(one, level_of(one, density)) for one in unseen), key=lambda one: one.wrong[-1]
            ),
        }.items():
            rows.setdefault(name, []).append(value)
    return rows, picked


def elsewhere(made: list[dict[str, Any]], picked: list[tuple[int, int]], pairs: list[Pair], name: str) -> Rows:
    """Return the outcomes of the splits' choices and of the defaults on `pairs`, labelled `name`."""
    counts = {k: tallies({**made[k], "stereo.disparities": 80}, pairs).sum(0) for k in {0, *(k for k, _ in picked)}}
    return {
        f"chosen, on {name}": [outcome(counts[best], level) for best, level in picked],
        f"defaults as they are, on {name}": [outcome(counts[0], DEFAULT)],
    }


if __name__ == "__main__":
    main()
