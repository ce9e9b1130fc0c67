# SPDX-License-Identifier: Apache-2.0
"""Reports of calibrations: a self-contained page, and its picture as a file.

Report of a stereo calibration: the corners, their errors, and a rectified pair.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.noise import NoiseCalibration
from stereovox.calibrate.stereo import BoardPair, StereoCalibration, read_grey
from stereovox.calibrate.wall import WallCalibration
from stereovox.cameras.rigs import StereoPair
from stereovox.depth.stereo.pipeline import rectified
from stereovox.frame import StereoFrame
from stereovox.view.calibration import DPI, WIDTH, noise_png, wall_png
from stereovox.view.figures import GREY, blank, png_of, title
from stereovox.view.report import page

FORMULAS = {
    "scale": "true depth = z / (1 + s)",
    "disparity": "true depth = z / (1 + q z)",
    "scale+disparity": "true depth = z / (1 + s + q z)",
    "thesis": "true depth = z - (p1 X^2 + p2 X + p3)",
}
HOLD = "\u00a0"
"""No-break space: a unit stays with its number."""
PERCENT = (
    "Errors are root mean squares over the wall of (depth - wall) / wall, of the mean of all frames. Walls may lean a "
    "little; how much was found together with the correction."
)


ALIKE = (
    "Errors of neighbouring pixels are alike: a mean of n of them is noisier than a single one divided by the root of "
    "n. The Gaussian is the one by which independent noise would have to be smoothed; of such noise the correlation "
    "falls to 1/e at twice its standard deviation. Looks: independent measurements in a patch of 8 x 8 pixels."
)
CONDITIONS = (
    "After Chien 2020, 2.2.4.1: the more pixels have a value the better. Errors are root mean squares over the "
    "recordings in a condition; mean grey is that of the pixels with a value, if the image is known."
)


def write_wall_report(folder: str | Path, found: WallCalibration, camera_file: str) -> Path:
    """Write `wall.html` and `wall.png` into `folder`, created if missing, and return the page's path.

    Raises StereovoxError if they cannot be written.
    """
    png = wall_png(found)
    return write_page(Path(folder), "wall", wall_page(found, png, camera_file), png)


def write_noise_report(folder: str | Path, found: NoiseCalibration, profile: str) -> Path:
    """Write `noise.html` and `noise.png`; else as `write_wall_report`."""
    png = noise_png(found)
    return write_page(Path(folder), "noise", noise_page(found, png, profile), png)


def wall_page(found: WallCalibration, png: bytes, camera_file: str) -> str:
    """Return the page of a wall calibration as text."""
    walls = [wall.as_dict() for wall in found.walls]
    model = found.correction.model
    boxes = [
        (f"{wall['before_percent']:.2f} % to {wall['after_percent']:.2f} %", f"wall at {wall['distance_m']:.2f} m")
        for wall in walls
    ]
    return page.page(
        "Depth calibration on flat walls",
        f"The camera's depth was compared with {len(walls)} flat wall{'s' * (len(walls) != 1)} "
        "(after Chien 2020, App. A) and corrected by the "
        f"model '{model}'. The correction is in {camera_file}; stereovox map applies it.",
        page.tiles(boxes),
        page.figure(png, "Histogram, top view and error over the image for each wall, before and after"),
        page.section("Walls", PERCENT, page.table(*_wall_table(walls))),
        page.section("Models", f"Chosen: {model}; {found.why}.", page.table(*_model_table(found))),
        page.section("Correction", _formula(model), page.code(_coefficients(found))),
        *([page.section("Notes", "", *(page.code(note) for note in found.notes))] if found.notes else []),
    )


def noise_page(found: NoiseCalibration, png: bytes, profile: str) -> str:
    """Return the page of a noise calibration as text."""
    width, height = found.region
    boxes = [(f"{found.s0:.3g}", "s0 [m]"), (f"{found.s1:.3g}", "s1"), (f"{found.s2:.3g}", "s2 [1/m]")]
    if found.subpixel is not None:
        boxes.append((f"{found.subpixel:.3f} px", "s2 as a disparity error"))
    boxes.append((f"{found.correlation_px:.2f} px", "errors alike over a Gaussian of"))
    return page.page(
        "Depth noise on flat walls",
        f"Errors of single measurements against the plane of the wall, within the middle {width:g} x {height:g} m "
        f"(Chien 2020, 2.2.4 and 3.3). sigma(z) = s0 + s1 z + s2 z^2 is in {profile}.",
        page.tiles(boxes),
        page.figure(png, "RMSE against distance with theory, sub-pixel, share of valid pixels"),
        page.section(
            "Distances",
            "RMSE has two parts: what differs from frame to frame, and what stays the same in all frames. The map's "
            "sigma is fitted to both together: a fixed error does not average out where the camera stands, and where "
            "it moves it is one more error of each measurement. "
            f"The curve misses a point by {found.worst_percent:.1f} % at most.",
            page.table(*_noise_table(found)),
        ),
        page.section("Neighbouring pixels", ALIKE, page.table(*_alike_table(found))),
        *([page.section("Conditions", CONDITIONS, page.table(*_condition_table(found)))] if found.conditions else []),
        *([page.section("Notes", "", *(page.code(note) for note in found.notes))] if found.notes else []),
    )


def _wall_table(walls: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    heads = ["recording", "distance", "lean", "before", "after", "99 % of pixels within", "of the image", "frames"]
    heads.append("used for")
    rows = [
        [
            wall["name"],
            f"{wall['distance_m']:.3f}{HOLD}m ({'measured' if wall['distance_given'] else 'as seen'})",
            f"{wall['tilt_deg']:.1f}{HOLD}deg",
            f"{wall['before_percent']:.2f}{HOLD}%",
            f"{wall['after_percent']:.2f}{HOLD}%",
            f"{wall['worst_after_percent']:.2f}{HOLD}%",
            f"{wall['wall_share']:.0%}",
            str(wall["frames"]),
            "the fit" if wall["fitted"] else "a check",
        ]
        for wall in walls
    ]
    return heads, rows


def _model_table(found: WallCalibration) -> tuple[list[str], list[list[str]]]:
    def percent(value: float | None) -> str:
        return "-" if value is None else f"{value:.2f} %"

    rows = [
        [model, FORMULAS[model], percent(score.get("fit")), percent(score.get("unseen"))]
        for model, score in found.scores.items()
    ]
    return ["model", "formula", "error where fitted", "error at distances left out"], rows


def _formula(model: str) -> str:
    if model == "thesis":
        return f"{FORMULAS[model]}, X = x z in metres (Chien 2020, Eq A.3)."
    return (
        f"{FORMULAS[model]}, z the measured depth, s and q quadratics in the slopes x, y of the pixel's ray, "
        "coefficients of 1, x, y, x^2, x y, y^2."
    )


def _coefficients(found: WallCalibration) -> str:
    numbers = [f"{number:+.6g}" for number in found.correction.coefficients]
    names = {"scale": "s", "disparity": "q", "scale+disparity": "sq", "thesis": "p"}[found.correction.model]
    size = len(numbers) // len(names)
    return "\n".join(f"{name} = {'  '.join(numbers[size * i : size * i + size])}" for i, name in enumerate(names))


def _noise_table(found: NoiseCalibration) -> tuple[list[str], list[list[str]]]:
    def number(value: float | None, factor: float = 1000, digits: int = 2) -> str:
        return "-" if value is None else f"{factor * value:.{digits}f}"

    heads = ["recording", "distance [m]", "RMSE [mm]", "frame to frame [mm]", "fixed [mm]", "too far by [mm]"]
    heads += ["sub-pixel [px]", "valid", "valid, whole image", "gross errors", "frames"]
    rows = [
        [
            point.name,
            f"{point.distance_m:.3f}",
            *(number(value) for value in (point.rmse_m, point.temporal_m, point.fixed_m, point.offset_m)),
            number(point.subpixel, 1, 3),
            *(f"{share:.1%}" for share in (point.valid_share, point.image_share)),
            f"{point.gross_share:.2%}",
            str(point.frames),
        ]
        for point in found.points
    ]
    return heads, rows


def _alike_table(found: NoiseCalibration) -> tuple[list[str], list[list[str]]]:
    heads = ["recording", "distance [m]", "Gaussian [px]", "1/e along rows [px]", "1/e along columns [px]", "looks"]
    rows = [
        [point.name, f"{point.distance_m:.3f}", f"{point.correlation_px:.2f}"]
        + [f"{lag:.2f}" for lag in point.falls_to_1_e_px]
        + [f"{point.looks:.1f} of 64"]
        for point in found.points
    ]
    return heads, rows


def _condition_table(found: NoiseCalibration) -> tuple[list[str], list[list[str]]]:
    heads = ["condition", "distances [m]", "RMSE [% of the depth]", "sub-pixel [px]", "valid", "gross errors"]
    rows = [
        [
            one.condition,
            ", ".join(f"{distance:.2f}" for distance in one.distances_m),
            f"{one.rmse_percent:.2f}",
            "-" if one.subpixel is None else f"{one.subpixel:.3f}",
            f"{one.valid_share:.1%}",
            f"{one.gross_share:.2%}",
            "-" if one.grey is None else f"{one.grey:.0f}",
        ]
        for one in found.conditions
    ]
    return [*heads, "mean grey"], rows


def write_page(folder: Path, name: str, text: str, png: bytes) -> Path:
    """Write NAME.html and NAME.png into `folder`, created if missing, and return the page's path."""
    return page.write_files(folder, {f"{name}.html": text.encode(), f"{name}.png": png})


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
