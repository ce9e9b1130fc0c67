# SPDX-License-Identifier: Apache-2.0
"""Report of a stereo calibration: the corners, their errors, and a rectified pair."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.chessboard import read_grey
from stereovox.calibrate.stereo import BoardPair, StereoCalibration
from stereovox.cameras.rigs import StereoPair
from stereovox.depth.stereo.rectify import rectified
from stereovox.frame import StereoFrame
from stereovox.view.calibration import DPI, WIDTH
from stereovox.view.figures import blank, png_of
from stereovox.view.panels import GREY, title
from stereovox.view.report import page
from stereovox.view.report.calibration import write_page

USED, DROPPED, ROW = "#2f9e62", "#d1603d", "#e8a33d"
ACROSS = 3
"""Pairs per row."""
MAX_DRAWN = 24
"""Largest number of pairs drawn; the table lists all."""
ROWS = 15
"""Number of lines through a rectified pair."""
FIGURES = (
    "RMS: distance from each corner to where the calibration puts it, both images. Rows: how far the rows of one "
    "corner are apart after rectification; unseen: the same, by a calibration without this pair. All in pixels."
)
EYES = ("left", "right")


def write_stereo_report(folder: str | Path, found: StereoCalibration, rig_file: str) -> Path:
    """Write `stereo.html` and `stereo.png` into `folder`, created if missing, and return the page's path.

    Raises StereovoxError if they cannot be written.
    """
    png = stereo_png(found)
    return write_page(Path(folder), "stereo", stereo_page(found, png, rig_file), png)


def stereo_page(found: StereoCalibration, png: bytes, rig_file: str) -> str:
    """Return the page of a stereo calibration as text."""
    figures = found.as_dict()
    boxes = [
        (_pixels(figures["rms_px"]), "corners missed by, RMS"),
        (_pixels(figures["epipolar_px"]), "rows apart, RMS"),
        (_pixels(figures["unseen_px"]), "rows apart in unseen pairs"),
        (f"{1000 * figures['baseline_m']:.2f} mm", "baseline"),
        *((f"{a:.1f} x {b:.1f} deg", f"{eye} eye sees") for eye, (a, b) in zip(EYES, _fields(figures), strict=True)),
    ]
    rows = [_row(pair) for pair in figures["pairs"]]
    board = f"{found.board.columns}x{found.board.rows} inner corners of {1000 * found.board.square:g} mm"
    return page.page(
        "Stereo calibration",
        f"{figures['used']} of {len(rows)} pairs of images of a chessboard ({board}); {figures['lens']} lenses. "
        f"The result is in {rig_file}.",
        page.tiles(boxes),
        page.figure(png, "Corners found in each pair, and one pair rectified, with lines along its rows"),
        page.section("Pairs", FIGURES, page.table(["pair", "used", "RMS", "rows", "unseen", "why not"], rows)),
        page.section("Lenses", "Distortion in OpenCV's order.", page.table(*_lenses(found))),
        page.section("The right eye in the frame of the left", "Metres.", page.code(_matrix(found.eyes.T_left_right))),
    )


def stereo_png(found: StereoCalibration) -> bytes:
    """Return a PNG: the corners of each pair, and the pair that fits worst of those used, rectified."""
    shown = found.pairs[:MAX_DRAWN]
    rows = -(-len(shown) // ACROSS)
    example = max(found.used, key=lambda pair: pair.rms_px)
    wide = _rectified(found, example)
    height = 16.0 * wide.shape[0] / wide.shape[1]
    small = rows * (16.0 / ACROSS * wide.shape[0] / wide.shape[1] + 0.45)
    figure = blank(WIDTH, small + height + 0.8)
    above, below = figure.subfigures(2, 1, height_ratios=[small, height + 0.8])
    for axis, pair in zip(above.subplots(rows, ACROSS, squeeze=False).flat, shown, strict=False):
        _corners(axis, pair)
    for axis in above.axes:
        axis.set_axis_off()
    _lines(below.subplots(), wide, example.name)
    return png_of(figure, DPI)


def _corners(axis: Any, pair: BoardPair) -> None:
    images = [read_grey(path) for path in (pair.left_file, pair.right_file)]
    known = [image for image in images if image is not None]
    if len(known) == 2 and known[0].shape == known[1].shape:
        axis.imshow(np.hstack(known), cmap="gray", vmin=0, vmax=255)
        colour = DROPPED if pair.why else USED
        for corners, shift in ((pair.left, 0), (pair.right, known[0].shape[1])):
            if corners is not None:
                axis.plot(corners[:, 0] + shift, corners[:, 1], "-", color=colour, linewidth=0.6, alpha=0.7)
                axis.plot(corners[:, 0] + shift, corners[:, 1], ".", color=colour, markersize=3)
    text = pair.why or f"RMS {pair.rms_px:.2f} px, rows {pair.epipolar_px:.2f} px"
    title(axis, f"{pair.name}: {text if len(text) < 48 else text[:45] + '...'}")


def _rectified(found: StereoCalibration, pair: BoardPair) -> NDArray[np.uint8]:
    """Return both rectified images of a pair side by side."""
    left, right = read_grey(pair.left_file), read_grey(pair.right_file)
    assert left is not None
    assert right is not None
    model = "spherical" if found.eyes.left.model == "fisheye" else "pinhole"
    frame = rectified(StereoFrame(left, right, StereoPair.from_eyes(found.eyes, model), np.eye(4), name=pair.name))
    return np.hstack([frame.left, frame.right])


def _lines(axis: Any, wide: NDArray[np.uint8], name: str) -> None:
    axis.imshow(wide, cmap="gray", vmin=0, vmax=255)
    for row in np.linspace(0, wide.shape[0] - 1, ROWS + 2)[1:-1]:
        axis.axhline(row, color=ROW, linewidth=0.8)
    axis.set(xticks=[], yticks=[])
    axis.set_xlabel("points on a line in one image are on it in the other", color=GREY)
    title(axis, f"{name}, rectified")


def _fields(figures: dict[str, Any]) -> list[tuple[float, float]]:
    return figures["field_of_view_deg"]


def _row(pair: dict[str, Any]) -> list[str]:
    figures = [_pixels(pair[key], "") for key in ("rms_px", "epipolar_px", "unseen_px")]
    return [pair["name"], "yes" if pair["used"] else "no", *figures, pair["why"]]


def _lenses(found: StereoCalibration) -> tuple[list[str], list[list[str]]]:
    rows = []
    for eye, lens in zip(EYES, (found.eyes.left, found.eyes.right), strict=True):
        numbers = (f"{number:.3f}" for number in (lens.fx, lens.fy, lens.cx, lens.cy))
        rows.append([eye, *numbers, "  ".join(f"{number:+.5f}" for number in lens.distortion)])
    return ["eye", "fx [px]", "fy [px]", "cx [px]", "cy [px]", "distortion"], rows


def _matrix(T: NDArray[np.float64]) -> str:
    return "\n".join("  ".join(f"{number:+.6f}" for number in row) for row in T)


def _pixels(number: float | None, unit: str = " px") -> str:
    return "-" if number is None else f"{number:.3f}{unit}"
