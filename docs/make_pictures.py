# SPDX-License-Identifier: Apache-2.0
"""Draw the pictures of docs/conventions.md, of loops and of the demo: python docs/make_pictures.py (2 minutes)."""

from __future__ import annotations

from contextlib import chdir
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib as mpl

mpl.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from stereovox import load_config
from stereovox.cli import main as stereovox

HERE = Path(__file__).resolve().parent
ALONG = np.array([[1.0, 0.36], [-0.62, 0.34], [0.0, 1.0]])
"""Where the world's x (forward), y (left) and z (up) point on the paper."""
INK, PAPER = "#22262e", "#fbfaf7"
X, Y, Z = "#c0392b", "#2e8b3d", "#2458b8"
OPTICAL = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]], float)
"""A level camera's x (right), y (down) and z (forward) in a frame of x forward, y left, z up."""


def main() -> None:
    """Draw all six."""
    demo()
    loops()
    plt.rcParams.update({"font.size": 11, "text.color": INK, "svg.fonttype": "path", "svg.hashsalt": "stereovox"})
    save(frames(), "frames.svg")
    save(cells_and_pixels(), "cells.svg")
    save(changed_world(), "changed_world.svg")
    save(decision(), "decision.svg")


def changed_world() -> plt.Figure:
    """Draw, from above, what two glances show of a thing in the world, of a fault in the camera, and of noise."""
    figure, panels = plt.subplots(1, 3, figsize=(10, 3.6), facecolor=PAPER)
    random, across = np.random.default_rng(1), np.linspace(-0.5, 0.5, 9)
    cameras = np.array([[0.0, 0.0], [0.9, 0.5]])
    thing = np.column_stack([across + 0.6, np.full(9, 2.2)])
    stuck = np.column_stack([0.5 * across, np.full(9, 1.0)])
    seen = {
        "in the world: believed": [thing, thing + np.array([0, 0.04])],
        "in the camera: a fault": [stuck + camera for camera in cameras],
        "nowhere twice: a fault": [
            np.column_stack([1.6 * across, random.uniform(0.7, 2.8, 9)]) + camera for camera in cameras
        ],
    }
    for panel, (title, dots) in zip(panels, seen.items(), strict=True):
        panel.plot([-1.4, 2.4], [3.2, 3.2], color=INK, lw=4)
        for camera, points, colour in zip(cameras, dots, (X, Z), strict=True):
            for side in (-0.6, 0.6):
                panel.plot(
                    [camera[0], camera[0] + side * 3], [camera[1], camera[1] + 3], color=colour, lw=0.6, alpha=0.5
                )
            panel.plot(*camera, marker="^", color=colour, ms=11)
            panel.plot(*points.T, ".", color=colour, ms=8)
        panel.set(title=title, xlim=(-1.5, 2.5), ylim=(-0.3, 3.4), aspect="equal")
        panel.axis("off")
    return figure


def decision() -> plt.Figure:
    """Draw what each decision costs by a cell's probability, with the default's costs, and which costs least."""
    figure, axes = plt.subplots(figsize=(8, 3.2), facecolor=PAPER, layout="constrained")
    rules, p = load_config().map, np.linspace(0, 1, 401)
    free, occupied = rules.decision
    costs = {
        f"free: {rules.missed_obstacle:g} p": (rules.missed_obstacle * p, Y),
        "tentative: 1": (np.ones_like(p), INK),
        f"occupied: {rules.false_alarm:g} (1 - p)": (rules.false_alarm * (1 - p), X),
    }
    for label, (cost, colour) in costs.items():
        axes.plot(p, cost, color=colour, label=label)
    for (low, high), (_, colour) in zip(((0, free), (free, occupied), (occupied, 1)), costs.values(), strict=True):
        axes.axvspan(low, high, color=colour, alpha=0.12, lw=0)
    axes.set(xlim=(0, 1), ylim=(0, 1.6), xlabel="p, the probability that the cell is occupied", ylabel="cost")
    axes.set_xticks([0, free, occupied, 0.5, 1], ["0", f"{free:.3f}", f"{occupied:.3f}", "0.5", "1"])
    axes.set_facecolor(PAPER)
    axes.legend(frameon=False, loc="upper right")
    return figure


def demo() -> None:
    """Draw what `stereovox demo` does."""
    with TemporaryDirectory() as folder:
        run("demo", "--out", folder)
        shrink(Path(folder, "room.png"), "demo.png")


def loops() -> None:
    """Draw what `stereovox loops --picture` does, as docs/corrections.md says it is made."""
    with TemporaryDirectory() as folder, chdir(folder):
        run("map", "sim:loop?drift=0.03&seed=1&image_width=96", *["--frames", "::2", "--set", "map.keep_frames=true"],
            *["--voxel-size", "0.1", "--out", "loop.svox"])  # fmt: skip
        run("loops", "loop.svox", "--picture", "loops.png")
        shrink(Path("loops.png"), "loops.png")


def run(*words: str) -> None:
    """Run a command."""
    if stereovox([*words]):
        raise SystemExit(f"stereovox {' '.join(words)} failed")


def shrink(file: Path, name: str) -> None:
    """Save a smaller picture next to this file; a palette fitted to it keeps the gradients in a small file."""
    picture = Image.open(file).convert("RGB")
    small = picture.resize((1280, round(1280 * picture.height / picture.width)), Image.Resampling.LANCZOS)
    small.quantize(256, Image.Quantize.MEDIANCUT, kmeans=2).save(HERE / name, optimize=True)


def save(figure: plt.Figure, name: str) -> None:
    """Write one picture next to this file."""
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.set(w_pad=0.2, h_pad=0.2)  # inches of free paper about it
    figure.savefig(HERE / name, facecolor=PAPER, metadata={"Date": None})
    plt.close(figure)


def blank(axes: plt.Axes, title: str) -> None:
    """Leave the paper without ticks."""
    axes.set_aspect("equal")
    axes.set_axis_off()
    axes.set_title(title, loc="left", fontweight="bold", color=INK)


def flat(point: object) -> np.ndarray:
    """Return where (..., 3) metres of the world lie on the paper."""
    return np.asarray(point, float) @ ALONG


def arrow(axes: plt.Axes, start: np.ndarray, end: np.ndarray, colour: str, word: str, off: tuple[float, float]) -> None:
    """Draw an arrow and its word next to the tip."""
    axes.annotate(
        "", end, start, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 2.2, "shrinkA": 0, "shrinkB": 0}
    )
    axes.text(*(end + off), word, color=colour, ha="center", va="center", fontweight="bold")


def axes_of(axes: plt.Axes, place: object, directions: object, words: tuple[str, str, str], size: float) -> None:
    """Draw the axes of a frame, x red, y green, z blue."""
    start = flat(place)
    for direction, word, colour in zip(np.asarray(directions), words, (X, Y, Z), strict=True):
        end = flat(np.asarray(place) + size * direction)
        away = (end - start) / np.linalg.norm(end - start)
        arrow(axes, start, end, colour, word, tuple(0.2 * away + (0.22 * len(word) * 0.16 * np.sign(away[0]), 0)))
    axes.plot(*start, "o", color=INK, ms=5)


def frames() -> plt.Figure:
    """Draw a world, a robot and its camera, and the poses between them."""
    figure, axes = plt.subplots(figsize=(9.6, 5.2), layout="constrained")
    blank(axes, "Frames: T_a_b maps coordinates in frame b to frame a")
    world, body, camera = np.zeros(3), np.array([3.1, -1.2, 0.0]), np.array([3.5, -1.2, 1.75])
    floor = [flat([x, y, 0]) for x, y in ((-0.6, -2.4), (6.6, -2.4), (6.6, 1.4), (-0.6, 1.4))]
    axes.fill(*np.transpose(floor), color="#e9e6dd", zorder=-3)
    robot(axes, body)
    axes.plot(*np.transpose([flat(camera - [0, 0, 1.4]), flat(camera)]), color="#8b97a6", lw=5, zorder=-1)
    frustum(axes, camera)
    axes_of(axes, world, np.eye(3), ("x forward", "y left", "z up"), 1.1)
    axes_of(axes, body, np.eye(3), ("x", "y", "z"), 0.95)
    axes_of(axes, camera, OPTICAL, ("x right", "y down", "z forward"), 0.95)
    for start, end, word, off, bend in (
        (world, camera, "T_world_camera\n(the pose of a frame)", (-1.05, 1.0), -0.25),
        (body, camera, "T_body_camera", (1.45, -0.1), 0.45),
    ):
        a, b = flat(start), flat(end)
        style = {
            "arrowstyle": "->",
            "color": INK,
            "lw": 1.4,
            "ls": "--",
            "connectionstyle": f"arc3,rad={bend}",
            "shrinkB": 6,
        }
        axes.annotate("", b, a, arrowprops=style)
        axes.text(*((a + b) / 2 + off), word, ha="center", va="center", family="monospace", fontsize=10)
    for place, word, off in (
        (world, "world (map)", (-0.1, -0.3)),
        (body, "body (base_link), on the floor", (0.55, -0.5)),
        (camera, "camera (optical frame)", (-0.95, 0.42)),
    ):
        axes.text(*(flat(place) + off), word, ha="center", va="center", fontstyle="italic")
    axes.set_xlim(-1.9, 8.2)
    axes.set_ylim(-1.35, 4.7)
    return figure


def robot(axes: plt.Axes, body: np.ndarray) -> None:
    """Draw the box that carries the camera."""
    low, high = body - np.array([0.55, 0.35, -0.05]), body + np.array([0.6, 0.35, 0.35])
    corner = [[low[0], high[0]], [low[1], high[1]], [low[2], high[2]]]
    sides = [((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)), ((0, 0, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1)),
             ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))]  # fmt: skip
    for side, shade in zip(sides, ("#c9d3df", "#b4c0cf", "#dbe3ec"), strict=True):
        points = [flat([corner[axis][k] for axis, k in enumerate(at)]) for at in side]
        axes.fill(*np.transpose(points), color=shade, ec="#8b97a6", lw=0.8, zorder=-1)


def frustum(axes: plt.Axes, camera: np.ndarray) -> None:
    """Draw what the camera sees."""
    ends = [flat(camera + 2.0 * np.array([1, 0.5 * y, 0.36 * z])) for y, z in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    axes.fill(*np.transpose(ends), color="#f3d9a4", alpha=0.55, ec="#b98a2c", lw=1, zorder=-2)
    for end in ends:
        axes.plot(*np.transpose([flat(camera), end]), color="#b98a2c", lw=0.9, zorder=-2)


def cells_and_pixels() -> plt.Figure:
    """Draw which cell a point is in, and what a depth is."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(10.4, 4.6), layout="constrained", width_ratios=(1, 1.05))
    blank(left, "Cells: index = floor(point / voxel_size)")
    for i in range(-2, 4):
        left.plot([i, i], [-2, 3], color="#b9b5aa", lw=0.8)
    for k in range(-2, 4):
        left.plot([-2, 3], [k, k], color="#b9b5aa", lw=0.8)
    left.fill([1, 2, 2, 1], [0, 0, 1, 1], color="#f1b9ad")
    for i in range(-2, 3):
        for k in range(-2, 3):
            left.text(i + 0.5, k + 0.16, f"({i}, j, {k})", ha="center", fontsize=7.5, color="#6b6f78")
    zero = np.zeros(2)
    arrow(left, zero, np.array([3.35, 0]), X, "x", (0.16, 0))
    arrow(left, zero, np.array([0, 3.35]), Z, "z", (0, 0.18))
    left.plot(0, 0, "o", color=INK, ms=5)
    left.text(-0.12, -0.3, "origin", ha="right", fontstyle="italic", fontsize=9.5)
    left.plot(1.2, 0.75, "o", color=INK, ms=5)
    left.annotate(
        "point (0.060, y, 0.037) m,\nvoxel_size 0.05 m: cell (1, j, 0)", (1.2, 0.75), (1.15, -2.75), ha="center",
        fontsize=9.5, arrowprops={"arrowstyle": "->", "color": INK},
    )  # fmt: skip
    left.plot(1.5, 0.5, "+", color=INK, ms=9, mew=1.6)
    left.text(3.12, 0.5, "centre:\n(index + 0.5)\n* voxel_size", fontsize=9.5, va="center")
    left.annotate("", (1.58, 0.5), (3.08, 0.5), arrowprops={"arrowstyle": "->", "color": INK})
    left.set_xlim(-2.2, 4.9)
    left.set_ylim(-3.3, 3.7)
    blank(right, "Depth: along the axis, not along the ray")
    arrow(right, zero, np.array([6.2, 0]), Z, "z", (0.22, 0))
    arrow(right, zero, np.array([0, -1.1]), X, "x", (0, -0.22))
    right.plot([1.3, 1.3], [-1.15, 1.15], color=INK, lw=2)
    right.text(1.3, 1.32, "image,\npixel (u, v)", ha="center", fontsize=9.5)
    point = np.array([5.0, -2.2])
    right.plot([0, 5.0], [0, -2.2], color="#b98a2c", lw=1.4)
    right.plot(1.3, -2.2 * 1.3 / 5, "s", color="#b98a2c", ms=7)
    right.plot(*point, "o", color=INK, ms=6)
    right.plot([5, 5], [0, -2.2], color="#6b6f78", lw=1, ls=":")
    right.annotate("", (0, 0.42), (5, 0.42), arrowprops={"arrowstyle": "<->", "color": INK})
    right.text(3.3, 0.6, "depth d", ha="center", family="monospace", fontsize=10)
    right.text(2.9, -1.85, "ray", color="#8a641a", ha="center", fontsize=9.5)
    right.text(5.1, -1.15, "x = d (u - cx) / fx", fontsize=9.5, family="monospace")
    right.text(4.9, -2.62, "the point that the pixel measures", ha="center", fontsize=9.5)
    right.plot(0, 0, "o", color=INK, ms=5)
    right.text(-0.15, 0.1, "camera", ha="right", fontstyle="italic")
    right.set_xlim(-1.1, 8.2)
    right.set_ylim(-3.3, 2.4)
    return figure


if __name__ == "__main__":
    main()
