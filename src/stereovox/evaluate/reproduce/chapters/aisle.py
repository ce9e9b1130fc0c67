# SPDX-License-Identifier: Apache-2.0
"""Experiment 3 told: a narrow aisle and what downsampling leaves of its far end (Chien 2020, 4.4.2.2)."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from stereovox.evaluate.reproduce.aisle import FAR_M, AisleFound
from stereovox.evaluate.reproduce.chapter import Chapter, Claim, Sheet, Shown, percent
from stereovox.sources.scene import Scene
from stereovox.view.reproduce.aisle import aisle_png

WANTED = 0.95
"""Share of what full resolution finds that counts as nothing lost."""
SAID = (
    "The resolution downsampling value affected aisle-like scenes a lot: only the closest depth of each block "
    "counts, so the further depth of the aisle may be filtered out. The further cells cannot be updated often with a "
    "higher ratio."
)
OURS = (
    "The layer of cells below the camera's height; the aisle lies on its side, the camera stands at the left. Dark is "
    "occupied, cream free, orange undecided, grey unknown; lines are the true walls. Far is right of the dotted line."
)
HEADS = (
    "variant",
    f"found beyond {FAR_M:g} m",
    "against full resolution",
    "found nearer",
    "far cells occupied, no wall within one cell",
    "ms a frame, median",
)
WHY = (
    "The footprint rule of `projective` needs no smaller image: a near cell is judged by all pixels of its "
    "footprint, so nothing near is lost, and a far cell by its own few pixels. It even finds more than adding up all "
    "rays at full resolution does: there the hits in a far wall's cell are outvoted by rays that graze the cell on "
    "their way further. With a 2x2 minimum before it, the far pixels are already gone."
)


def chapter(found: Sequence[AisleFound], scene: Scene) -> Chapter:
    """Return the chapter."""
    lines = [one for one in found if one.variant.integrator == "line"]
    falling = all(a.found > b.found for a, b in pairwise(lines))
    ours = ", ".join(f"{one.variant.downsample}x{one.variant.downsample}: {percent(one.found)}" for one in lines)
    claims = [Claim("Line drawing: the higher the ratio, the fewer far cells are found", "yes", ours, falling)]
    claims += [_claim(one) for one in found]
    rows = [
        (one.variant.name, percent(one.found), percent(one.against_full), percent(one.near_found), percent(one.stray),
         f"{one.ms:.2f}")
        for one in found
    ]  # fmt: skip
    return Chapter(
        "aisle",
        "Aisle of 12 m",
        "The camera stands at one end of an aisle 1.27 m wide and looks along it. Far cells are those beyond "
        f"{FAR_M:g} m that a side wall or the end wall touches and a pixel sees: {found[0].far_cells} cells of 0.2 m. "
        "All variants get the same images and the sensor model of `chien2020`, with depths up to 13 m and no window. "
        "Voxel traversal at full resolution is the yardstick.",
        claims,
        [Shown("Fig 4.12", SAID, OURS, aisle_png(found, scene.solids))],
        [Sheet("All variants", HEADS, rows)],
        [WHY],
        {"variants": [one.figures() for one in found]},
    )


def _claim(one: AisleFound) -> Claim:
    """Return what is claimed of a variant; stereovox's own must find 95 % of what full resolution does."""
    wanted = one.variant.wanted
    thesis = "the future work it asks for" if wanted else "-"
    ours = f"{percent(one.found)}; {percent(one.against_full)} of full resolution"
    text = f"{one.variant.name}: far walls found" + (
        f", at least {percent(WANTED)} of full resolution" if wanted else ""
    )
    return Claim(text, thesis, ours, one.against_full >= WANTED if wanted else None)
