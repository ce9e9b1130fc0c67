# SPDX-License-Identifier: Apache-2.0
"""Pictures of calibrations: walls before and after a correction, noise by distance with theory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.noise import NoiseCalibration
from stereovox.calibrate.wall import WallCalibration, WallResult
from stereovox.view.figures import GREY, blank, labels, png_of, title

DPI = 150
WIDTH = 11.0
"""Inches: the width on a page, so that letters keep their size."""
LETTERS = 10
"""Size of the numbers along an axis, in points."""
BEFORE, AFTER, WALL = "#d1603d", "#23618c", "#1b2333"
THEORY = ((0.08, "--"), (0.04, ":"))
"""Sub-pixels of the curves in Chien 2020, Fig 3.9."""
ERRORS = (
    ("rmse_m", "measured RMSE", "o", BEFORE),
    ("temporal_m", "of it from frame to frame", "^", "#5b8c5a"),
    ("fixed_m", "of it fixed", "s", "#a07cc0"),
)
DOTS = 6000
BAND = 0.1
"""Share of the rows used in a top view, because a tilted wall would blur it."""


def wall_png(calibration: WallCalibration) -> bytes:
    """Return a PNG: histogram, top view, error over the image before and after, for each wall (after Fig A.1-A.3)."""
    walls = calibration.walls
    figure = blank(WIDTH, 7.4 * len(walls))
    grid = figure.subplots(2 * len(walls), 2, squeeze=False, height_ratios=[3.1, 4.3] * len(walls))
    for axes, wall in zip(grid.reshape(-1, 4), walls, strict=True):
        _histogram(axes[0], wall)
        _top_view(axes[1], wall)
        _error_map(figure, axes[2], wall.before, "Before")
        _error_map(figure, axes[3], wall.after, "After")
    return png_of(figure, DPI)


def noise_png(calibration: NoiseCalibration) -> bytes:
    """Return a PNG: RMSE against distance with theory (after Fig 3.7 and 3.9), sub-pixel, and share of valid pixels."""
    figure = blank(WIDTH, 6.2)
    axes = figure.subplot_mosaic([["rmse", "subpixel"], ["rmse", "shares"]], width_ratios=[1.7, 1])
    _rmse(axes["rmse"], calibration)
    _subpixel(axes["subpixel"], calibration)
    _shares(axes["shares"], calibration)
    return png_of(figure, DPI)


def _histogram(axis: Any, wall: WallResult) -> None:
    depths = [_depths(points) for points in (wall.points_before, wall.points_after)]
    low, high = np.percentile(np.concatenate(depths), [0.2, 99.8])
    bins = np.linspace(low, high, 90).tolist()
    for values, colour, name in zip(depths, (BEFORE, AFTER), ("before", "after"), strict=True):
        axis.hist(values, bins, color=colour, alpha=0.65, label=name)
    axis.axvline(wall.distance, color=WALL, linewidth=1.2, linestyle="--", label="wall, on the axis")
    axis.legend(frameon=False, fontsize=10)
    axis.set_yticks([])
    title(axis, f"Wall at {wall.distance:.2f} m" + ("" if wall.fitted else " (only checked)"))
    labels(axis, "depth [m]", "pixels", LETTERS)


def _top_view(axis: Any, wall: WallResult) -> None:
    known = np.isfinite(wall.points_before[..., 2])
    rows = np.arange(len(known))[:, None] - round(wall.recording.camera.cy)
    shown = np.flatnonzero(known & (np.abs(rows) <= len(known) * BAND / 2))
    shown = np.random.default_rng(0).choice(shown, min(DOTS, len(shown)), replace=False)
    for points, colour, name in ((wall.points_before, BEFORE, "before"), (wall.points_after, AFTER, "after")):
        x, _, z = points.reshape(-1, 3)[shown].T
        axis.plot(x, z, ".", color=colour, markersize=1.6, alpha=0.5, label=name)
    a, b, _ = wall.plane
    x = np.array(axis.get_xlim())
    axis.plot(x, (1 - b * x) / a, color=WALL, linewidth=1.2, linestyle="--", label="wall, on the axis")
    axis.legend(frameon=False, fontsize=10, markerscale=6, loc="best")
    title(axis, "Top view, middle rows")
    labels(axis, "x, to the right [m]", "z, depth [m]", LETTERS)


def _error_map(figure: Any, axis: Any, error: NDArray[np.float64], name: str) -> None:
    limit = max(0.1, 100 * float(np.nanpercentile(np.abs(error), 98)))
    rms = 100 * np.sqrt(np.nanmean(error**2))
    drawn = axis.imshow(100 * error, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="antialiased")
    axis.set(xticks=[], yticks=[], facecolor="#d9d9d9")
    title(axis, f"{name}: {rms:.2f} % RMS")
    bar = figure.colorbar(drawn, ax=axis, orientation="horizontal", pad=0.02, fraction=0.06, aspect=30)
    bar.set_label("too far [% of the depth]", color=GREY)
    bar.ax.tick_params(colors=GREY)
    bar.outline.set_visible(False)


def _rmse(axis: Any, calibration: NoiseCalibration) -> None:
    distance = np.array([point.distance_m for point in calibration.points])
    z = np.linspace(0, 1.12 * distance.max(), 200)
    if calibration.baseline:
        for subpixel, style in THEORY:
            s2 = subpixel / (calibration.focal_px * calibration.baseline)
            axis.plot(z, 1000 * s2 * z * z, style, color=GREY, label=f"theory, sub-pixel {subpixel:g}")
    axis.plot(z, 1000 * calibration.sigma(z), color="#9cc3dc", linewidth=5, label="fit, what the map uses", zorder=1)
    for name, label, marker, colour in ERRORS:
        values = [getattr(point, name) for point in calibration.points]
        known = [(d, 1000 * value) for d, value in zip(distance, values, strict=True) if value is not None]
        if known:
            axis.plot(*zip(*known, strict=True), marker, color=colour, label=label)
    axis.legend(frameon=False, fontsize=10)
    axis.set(xlim=(0, z[-1]), ylim=(0, None))
    title(axis, "Error of one measurement against distance")
    labels(axis, "distance [m]", "error [mm]", LETTERS)


def _subpixel(axis: Any, calibration: NoiseCalibration) -> None:
    known = [(point.distance_m, point.subpixel) for point in calibration.points if point.subpixel is not None]
    title(axis, "The same as a disparity error")
    labels(axis, "distance [m]", "sub-pixel [px]", LETTERS)
    if not known:
        axis.text(0.5, 0.5, "baseline not known", ha="center", color=GREY, transform=axis.transAxes)
        return
    axis.plot(*zip(*known, strict=True), "o-", color=BEFORE)
    for subpixel, style in THEORY:
        axis.axhline(subpixel, linestyle=style, color=GREY)
    axis.set(xlim=(0, 1.12 * max(known)[0]), ylim=(0, 1.15 * max(0.08, *(value for _, value in known))))


def _shares(axis: Any, calibration: NoiseCalibration) -> None:
    distance = [point.distance_m for point in calibration.points]
    width, height = calibration.region
    for name, label, colour in (
        ("valid_share", f"middle {width:g} x {height:g} m", AFTER),
        ("image_share", "whole image", BEFORE),
    ):
        shares = [100 * getattr(point, name) for point in calibration.points]
        axis.plot(distance, shares, "o-", color=colour, label=label)
    axis.set(xlim=(0, 1.12 * max(distance)), ylim=(0, 104))
    axis.legend(frameon=False, fontsize=10, loc="lower left")
    title(axis, "Pixels that have a value")
    labels(axis, "distance [m]", "share [%]", LETTERS)


def _depths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    z = points[..., 2]
    return z[np.isfinite(z)]
