# SPDX-License-Identifier: Apache-2.0
"""Pictures of loop closure: trajectory before and after, loops, and the map where poses were most off."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.correct.close_loops import LoopClosure
from stereovox.geometry.se3 import inverse
from stereovox.mapping.rebuild import CORRECTED
from stereovox.maps import State, VoxelMap
from stereovox.products.edit import crop
from stereovox.products.floor_axes import floor_axes
from stereovox.products.ground import floor_of
from stereovox.view.above import draw_columns
from stereovox.view.figures import HALO, INK, STATE_COLOURS, figure_of, measured, save, scale_bar, title, title_above

BEFORE, AFTER, CLOSED, REFUSED = "#969dab", "#2458b8", "#1f9d55", "#c2185b"
"""Colours of the trajectories and of loops."""
WINDOW_M = 5.0
"""Size in metres of the map's close-up, plus twice the pose error there."""
LISTED = 6
"""Refused loops whose reasons are listed."""
ABOVE = 20
"""Points of a number above its place, and step by which it moves up to avoid others."""
LINE_IN = 0.26
"""Inches from one line of text to the next."""

Window = tuple[NDArray[np.float64], NDArray[np.float64]]
"""Lowest and highest corner (2,) in metres of the close-up, across the floor."""


def loops_picture(closure: LoopClosure, after: VoxelMap, file: str | Path, before: VoxelMap | None = None) -> None:
    """Draw the result of loop closure.

    From above: the camera's trajectory before (grey) and after (blue), closed loops (green) and refused ones (red,
    dashed) between their places, with reasons. Next to it the map where the poses were most off, before and after.

    Args:
        closure: From `close_loops`.
        after: The map with its loops closed.
        file: The picture to write: .png, .pdf or .svg.
        before: The map as it was; None leaves its panel out.

    Raises:
        StereovoxError: Another suffix, or a file that cannot be written.
    """
    save(loops_figure(closure, after, before), file)


def loops_figure(closure: LoopClosure, after: VoxelMap, before: VoxelMap | None = None) -> Any:
    """Return the matplotlib figure of `loops_picture`."""
    across = floor_axes(after.config.up)[:2]
    window = _window(closure, across) if closure.loops else None
    near = [(name, one) for name, one in (("before", before), ("after", after)) if one is not None and window]
    words = _reasons(closure)
    figure, panels = _panels(closure, across, [name for name, _ in near], len(words))
    marks = _draw_ways(panels["ways"], closure, across)
    for name, voxel_map in near:
        assert window is not None
        poses = closure.T_world_before if name == "before" else closure.T_world_sensor
        _draw_near(panels[name], f"The map in the box, {name}", voxel_map, window)
        _draw_way(panels[name], poses, across, BEFORE if name == "before" else AFTER)
        _draw_lines(panels[name], closure.ends(closure.loops, poses), across, CLOSED)
        panels[name].set(xlim=(window[0][0], window[1][0]), ylim=(window[0][1], window[1][1]))
        scale_bar(panels[name])
    if window is not None:
        _draw_box(panels["ways"], window)
    panels["words"].text(0, 1, "\n".join(words), va="top", fontsize=10.5, color=INK, linespacing=1.5)
    title_above(figure, f"Loop closure: {after.recording.removesuffix(CORRECTED) or 'a map'}", _facts(closure, after))
    _move_apart(marks, panels["ways"])
    return figure


def _panels(closure: LoopClosure, across: Sequence[int], near: Sequence[str], lines: int) -> tuple[Any, dict[str, Any]]:
    """Return a figure and its panels: the trajectories at the left, the map's close-up at the right, text below."""
    width, depth = np.ptp(_all_places(closure)[:, across], axis=0)
    high = float(np.clip(9.5 * depth / max(width, 1e-9), 4.5 * max(len(near), 1), 11.0))
    low = LINE_IN * (lines + 0.5)
    figure = figure_of(high + low + 1.6)
    grid = figure.add_gridspec(2, 2 if near else 1, height_ratios=[high, low], width_ratios=[1.75, 1][: 1 + bool(near)])
    panels = {"ways": figure.add_subplot(grid[0, 0]), "words": figure.add_subplot(grid[1, :])}
    panels["words"].set_axis_off()
    if near:
        for n, spot in enumerate(grid[0, 1].subgridspec(len(near), 1)):
            panels[near[n]] = figure.add_subplot(spot)
    return figure, panels


def _all_places(closure: LoopClosure) -> NDArray[np.float64]:
    """Return all positions (N, 3) of the camera, before and after."""
    return np.concatenate([closure.T_world_before[:, :3, 3], closure.T_world_sensor[:, :3, 3]])


def _draw_ways(axis: Any, closure: LoopClosure, across: Sequence[int]) -> list[Any]:
    """Draw both trajectories from above, and the loops; return the numbers of refused ones."""
    axis.set_aspect("equal", adjustable="datalim")
    axis.grid(alpha=0.25)
    title(axis, "The camera's path from above")
    _draw_way(axis, closure.T_world_before, across, BEFORE, "path before")
    _draw_way(axis, closure.T_world_sensor, across, AFTER, "path after")
    closed = closure.ends(closure.loops, closure.T_world_before)
    _draw_lines(axis, closed, across, CLOSED, label=f"{len(closed):,} loops closed: one place, seen again")
    refused = closure.ends(closure.refused, closure.T_world_sensor)  # like their coordinates below
    if len(refused):
        _draw_lines(axis, refused, across, REFUSED, "--", f"{len(refused):,} refused: look alike")
    marks = [_draw_number(axis, ends[1][list(across)], number) for number, ends in enumerate(refused[:LISTED], 1)]
    measured(axis, ("xyz"[across[0]], "xyz"[across[1]], ""))
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, frameon=False, fontsize=10.5, labelcolor=INK)
    return marks


def _draw_way(axis: Any, poses: NDArray[np.float64], across: Sequence[int], colour: str, label: str = "") -> None:
    """Draw positions from above as a line, from a dot to a square."""
    points = poses[:, :3, 3][:, across]
    axis.plot(*points.T, color=colour, linewidth=1.8, label=label or None)
    for end, marker in ((points[0], "o"), (points[-1], "s")):
        axis.plot(*end, marker, color=colour, markeredgecolor=HALO, markersize=8, zorder=4)


def _draw_lines(
    axis: Any, ends: NDArray[np.float64], across: Sequence[int], colour: str, style: str = "-", label: str = ""
) -> None:
    """Draw lines with ends (N, 2, 3) from above."""
    from matplotlib.collections import LineCollection

    lines = LineCollection(
        list(ends[..., list(across)]),
        colors=colour,
        linestyles=style,
        linewidths=1.0 if style == "-" else 2.0,
        label=label or None,
        zorder=3,
    )
    axis.add_collection(lines)


def _draw_number(axis: Any, place: NDArray[np.float64], number: int) -> Any:
    """Write a number on a disc above a place, on top of the lines; return it."""
    return axis.annotate(
        str(number), place, (0, ABOVE), textcoords="offset points", ha="center", va="center",
        fontsize=9.5, weight="bold", color="white", zorder=6 - number / (LISTED + 1),
        arrowprops={"arrowstyle": "-", "color": REFUSED, "linewidth": 0.8},
        bbox={"boxstyle": "circle,pad=0.2", "facecolor": REFUSED, "edgecolor": "white"},
    )  # fmt: skip


def _move_apart(marks: Sequence[Any], axis: Any) -> None:
    """Move overlapping numbers up: refused loops are often close together.

    Call it once all panels exist: only the finished layout determines positions on the page.
    """
    axis.figure.draw_without_rendering()
    up, taken = np.array([0.0, ABOVE]), list[NDArray[np.float64]]()
    for mark in marks:
        at = axis.transData.transform(mark.xy) * 72 / axis.figure.dpi + up
        while any(np.linalg.norm(at - other) < ABOVE - 1e-6 for other in taken):
            at = at + up
            mark.xyann = tuple(mark.xyann + up)
        taken.append(at)


def _draw_box(axis: Any, window: Window) -> None:
    from matplotlib.patches import Rectangle

    low, high = window
    axis.add_patch(Rectangle(tuple(low), *(high - low), fill=False, edgecolor=INK, linewidth=1.2))


def _draw_near(axis: Any, heading: str, voxel_map: VoxelMap, window: Window) -> None:
    """Draw the columns of a part of a map: dark if they are full."""
    x, y, *_ = floor_axes(voxel_map.config.up)
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    low[[x, y]], high[[x, y]] = window
    part = crop(voxel_map, low, high)
    axis.set_facecolor(STATE_COLOURS[State.UNKNOWN])
    if part.bounds() is not None:
        draw_columns(axis, floor_of(part))
    axis.set_aspect("equal")
    title(axis, heading)


def _window(closure: LoopClosure, across: Sequence[int]) -> Window:
    """Return the window of the close-up: at the loop whose places were most off relative to each other."""
    pairs = np.array([(loop.first, loop.second) for loop in closure.loops])
    numbers = closure.anchors[pairs]
    between = [
        np.array([(inverse(poses[one]) @ poses[other])[:3, 3] for one, other in numbers])
        for poses in (closure.T_world_before, closure.T_world_sensor)
    ]
    off = np.linalg.norm(between[0] - between[1], axis=1)
    worst = int(np.argmax(off))
    places = [poses[numbers[worst], :3, 3] for poses in (closure.T_world_before, closure.T_world_sensor)]
    middle = np.concatenate(places).mean(axis=0)[list(across)]
    half = WINDOW_M / 2 + float(off[worst])
    return middle - half, middle + half


def _facts(closure: LoopClosure, after: VoxelMap) -> list[str]:
    """Return the numbers below the headline."""
    if not closure.loops:
        return ["no loops were found: the poses stay", f"{len(closure.refused):,} refused"]
    summary = closure.summary()
    off, moved = summary["off_m"]["max"], summary["moved_m"]
    return [
        f"{len(closure.loops):,} loops closed, {len(closure.refused):,} refused",
        f"there the poses were off by up to {off:.2f} m",
        f"{len(closure.stamps_ns):,} frames moved by {moved['median']:.2f} m (median), at most {moved['max']:.2f} m",
        f"cells of {after.voxel_size:g} m",
    ]


def _reasons(closure: LoopClosure) -> list[str]:
    """Return how to read the picture, and a line for each refused loop that is numbered."""
    lines = [
        "Map from above: dark where columns are full (walls), white where free, grey where not seen. "
        "Dots mark where the path begins, squares where it ends."
    ]
    for number, loop in enumerate(closure.summary()["loops_refused"][:LISTED], 1):
        lines.append(f"{number}   refused: {_place(loop['at'])} like {_place(loop['like'])}: {loop['why']}")
    if len(closure.refused) > LISTED:
        lines.append(f"and {len(closure.refused) - LISTED:,} more refused")
    return lines


def _place(place: Sequence[float]) -> str:
    return f"({', '.join(f'{number:.1f}' for number in place)})"
