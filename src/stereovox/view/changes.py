# SPDX-License-Identifier: Apache-2.0
"""A picture of what changed from one map to another, from above."""

from __future__ import annotations

from typing import Any

from stereovox.maps import VoxelMap
from stereovox.maps.cubes import in_cubes
from stereovox.products.difference import Difference, difference
from stereovox.products.ground_surfaces import floor_of
from stereovox.products.merge import merge
from stereovox.view.columns import draw_columns, finish, mark, page_of
from stereovox.view.figures import words_above
from stereovox.view.panels import INK

KINDS = {
    "became_known": ("became known", "#b9d8b0"),
    "became_unknown": ("became unknown", "#d9c7e0"),
    "vanished": ("vanished: occupied before, free now", "#2f7fd1"),
    "appeared": ("appeared: free before, occupied now", "#d8352a"),
}
"""Name and colour; where one column holds several the last of these is shown."""


def draw_changes(a: VoxelMap, b: VoxelMap, heading: str) -> Any:
    """Return the matplotlib figure of what changed from map `a` to map `b`, in one frame and cells of one size."""
    from matplotlib.patches import Patch

    a, b = in_cubes(a), in_cubes(b)
    changes, both = difference(a, b), merge(a, b)
    floor = floor_of(both)
    figure, (axis,) = page_of(floor)
    draw_columns(axis, floor)
    for kind, (_, colour) in KINDS.items():
        mark(axis, floor, both.centers(getattr(changes, kind)), colour)
    finish(axis)
    patches = [Patch(fc=colour, label=name) for name, colour in KINDS.values()]
    figure.legend(handles=patches, loc="outside lower center", ncols=4, frameon=False, fontsize=11, labelcolor=INK)
    words_above(figure, heading, [f"cells of {a.voxel_size:g} m", *facts(changes), "grey: both maps from above"])
    return figure


def facts(changes: Difference) -> list[str]:
    """Return how many cells changed, in words."""
    return [f"{len(getattr(changes, kind)):,} {kind.replace('_', ' ')}" for kind in reversed(KINDS)]
