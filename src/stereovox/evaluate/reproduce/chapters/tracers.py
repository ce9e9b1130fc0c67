# SPDX-License-Identifier: Apache-2.0
"""Experiment 5 told: line drawing against voxel traversal (Chien 2020, 3.4 and chapter 5)."""

from __future__ import annotations

from collections.abc import Sequence

from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Sheet, Shown, percent
from stereovox.evaluate.reproduce.tracers import Comparison
from stereovox.view.reproduce.tracers import tracers_png

SAID = (
    "Line drawing tries to make the line as thin as possible with less effort; voxel traversal fills every cell the "
    "ray passes. The missed cells can still be updated by other rays, except close to the edge of the field of view."
)
OURS = "One 8x8 frame in the apartment, layer at the camera's height; the camera is where the cone begins."
HEADS = (
    "downsampling",
    "updated by traversal",
    "by line",
    "by both",
    "only by traversal",
    "only by line",
    "ms, traversal",
    "ms, line",
)
THICK = (
    "Line drawing leaves more cells occupied: rays that only graze a cell do not clear it. With one sensor model for "
    "both its walls are therefore a little thicker than those of voxel traversal."
)


def chapter(found: Sequence[Comparison], size: float) -> Chapter:
    """Return the chapter; the first comparison is drawn. size: of a cell in metres."""
    rows = [
        (_name(one), *(f"{n:,}" for n in (one.ray, one.line, one.both, one.only_ray, one.only_line)),
         f"{one.median_ms('ray'):.2f}", f"{one.median_ms('line'):.2f}")
        for one in found
    ]  # fmt: skip
    return Chapter(
        "tracers",
        "The two ray tracers",
        "The same images of the apartment by line drawing (Alg 1) and voxel traversal (Alg 2). Counted are the cells "
        "on which a frame says anything, summed over all frames, and the cells that are occupied in the end. The rim "
        "of the view is everything less than 1.5 cells inside it.",
        [claim for one in found for claim in _claims(one)],
        [Shown("Fig 3.10", SAID, OURS, tracers_png(found[0], size))],
        [Sheet("Cells updated, all frames together; median time of a frame with map update", HEADS, rows)],
        [THICK],
        {"comparisons": [one.figures() for one in found]},
    )


def _claims(one: Comparison) -> list[Claim]:
    name, line_ms, ray_ms = _name(one), one.median_ms("line"), one.median_ms("ray")
    missed, at_rim = percent(one.only_ray / max(one.ray, 1)), percent(one.at_rim / max(one.only_ray, 1))
    differ = 1 - one.occupied_both / max(one.occupied_ray + one.occupied_line - one.occupied_both, 1)
    occupied = f"{one.occupied_line:,} by line, {one.occupied_ray:,} by traversal"
    return [
        Claim(f"{name}: line drawing is faster", "9.77 against 10.49 ms (10x10)",
              f"{line_ms:.2f} against {ray_ms:.2f} ms", line_ms < ray_ms),
        Claim(f"{name}: line drawing misses cells that traversal updates", "yes, a few",
              f"{missed} of them; of the missed {at_rim} lie at the rim of the view", one.only_ray > one.only_line),
        Claim(f"{name}: occupied cells of the finished maps", "the difference is quite small",
              f"{occupied}; {percent(differ)} of all are in one map only", None),
    ]  # fmt: skip


def _name(one: Comparison) -> str:
    return f"{one.downsample}x{one.downsample}" if one.downsample > 1 else "Full resolution"
