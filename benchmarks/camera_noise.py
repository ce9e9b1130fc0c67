# SPDX-License-Identifier: Apache-2.0
"""Errors of a depth camera, measured on flat patches of any recording or simulation.

    python benchmarks/camera_noise.py RECORDING [--frames ::10] [--baseline 0.075] [--colour] [--json]

No truth is needed. Images are cut into squares of 24 pixels; if nearly all depths of a square are on a plane (which is
linear in disparity), their deviations are noise: its size, its correlation between neighbouring pixels and frames, and
its quantisation. Missing values in such squares show holes, by range, angle and brightness. Stereo pairs are matched
here first. `--baseline` is for recordings without one (a Kinect: 0.075). `--colour` takes the brightness from the
colour images of `sevenscenes_30hz`.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import e
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stereovox as sv
from stereovox.config import load_config
from stereovox.depth.prepare import DepthPipeline
from stereovox.frame import Frame, Reason, StereoFrame
from stereovox.geometry.se3 import inverse, transform_points

SIDE = 24
"""Pixels across a square."""
LAGS = 12
BLOCK = 8
"""Pixels across the blocks whose means give the number of independent looks."""
MIN_KNOWN, MIN_FLAT, MAX_SIGMA, CURVED = 0.3, 0.9, 1.0, 0.85
"""A square counts with this share of values, this share of them on a plane, less noise than this in pixels, and a
quadratic fit that leaves at least this share of the plane's residual; otherwise it is curved."""
GROSS_PX = 1.0
"""A value this far off its plane, and five sigma, is a gross error."""
GAP_PX, SUPPORT, BETWEEN = 2.0, (3, 5), 2
"""An edge: both sides, SUPPORT pixels away, differ by more than GAP_PX; the pixels BETWEEN them are judged."""
MOVED_PX = (3.0, 40.0)
"""Frames are compared if the image moved this far: then the same place is another pixel."""
RANGES = (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 10.0, 20.0, 50.0)
ANGLES = (0.0, 20.0, 40.0, 60.0, 70.0, 80.0, 90.0)
GREYS = (0.0, 16.0, 32.0, 64.0, 128.0, 192.0, 256.0)

_v, _u = (np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2).reshape(2, -1)
PLANE = np.stack([np.ones(SIDE * SIDE), _u, _v], axis=1)
CURVE = np.column_stack([PLANE, _u * _u, _u * _v, _v * _v])


@dataclass(frozen=True, eq=False)
class Square:
    """A flat square of an image.

    row, column: its first pixel. z: depth of its middle in metres; angle_deg: between its normal and the ray there.
    sigma_px: noise of its disparity. residual (SIDE, SIDE) in pixels, NaN: no value or a gross error. known, gross:
    shares of pixels with a value, and of these of gross errors. grey: mean brightness, NaN if unknown.
    """

    row: int
    column: int
    z: float
    angle_deg: float
    sigma_px: float
    residual: NDArray[np.float64]
    known: float
    gross: float
    grey: float


@dataclass(eq=False)
class Seen:
    """All squares of the frames, and sums over them."""

    squares: list[Square] = field(default_factory=list)
    along: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, LAGS + 1, 2)))
    holes: NDArray[np.float64] = field(default_factory=lambda: np.zeros((LAGS + 1, 2)))
    again: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 3)))
    edges: NDArray[np.float64] = field(default_factory=lambda: np.zeros(4))
    steps: list[NDArray[np.float64]] = field(default_factory=list)
    valid: list[float] = field(default_factory=list)


def measure(frames: Iterator[tuple[Frame, NDArray | None]], baseline: float) -> dict[str, Any]:
    """Return all figures of frames, each with its grey image (None: unknown); baseline: for cameras without one."""
    seen, last = Seen(), None
    for frame, grey in frames:
        px_m = frame.camera.focal_px * (frame.camera.baseline or baseline)
        disparity = disparity_of(frame, px_m)
        squares = flat_squares(disparity, frame.camera, px_m, grey)
        for square in squares:
            add_correlation(seen, square)
        seen.squares += squares
        seen.edges += edge_counts(disparity)
        seen.valid.append(float(np.isfinite(disparity).mean()))
        step = np.abs(np.diff(disparity, axis=1)).ravel()
        seen.steps.append(step[(step > 0.004) & (step < 1)])
        residual = spread(squares, disparity.shape)
        if last is not None:
            seen.again += agreement(*last, frame, residual)
        last = frame, squares
    return figures(seen)


def disparity_of(frame: Frame, px_m: float) -> NDArray[np.float64]:
    """Return the disparity (height, width) in pixels, NaN: no value; px_m: disparity at one metre."""
    depth = np.asarray(frame.depth, float) * frame.depth_scale
    known = np.isfinite(depth) & (depth > 0) & (np.asarray(frame.depth) != np.iinfo(np.uint16).max)
    if frame.reason is not None:
        known &= frame.reason == Reason.VALID
    return np.where(known, px_m / np.where(known, depth, 1), np.nan)


def flat_squares(disparity: NDArray, camera: Any, px_m: float, grey: NDArray | None) -> list[Square]:
    """Return the flat squares of a disparity image."""
    x, y = (np.asarray(slope, float) for slope in camera.ray_slopes())
    found = []
    for row in range(0, disparity.shape[0] - SIDE + 1, SIDE):
        for column in range(0, disparity.shape[1] - SIDE + 1, SIDE):
            part = np.s_[row : row + SIDE, column : column + SIDE]
            values = disparity[part].ravel()
            fit = on_plane(values)
            if fit is None:
                continue
            (a, b, c), used = fit
            residual = np.where(used, values - PLANE @ (a, b, c), np.nan)
            sigma = float(np.sqrt(np.nanmean(residual**2)))
            known = np.isfinite(values)
            ray = np.array([x[column + SIDE // 2], y[row + SIDE // 2], 1.0])
            slope = np.array([b * camera.fx, c * camera.fy, a])
            slope[2] -= slope[:2] @ ray[:2]  # disparity / px_m = 1/z = slope . ray
            cosine = a / (np.linalg.norm(slope) * np.linalg.norm(ray))
            off = known & (np.abs(values - PLANE @ (a, b, c)) > max(GROSS_PX, 5 * sigma))
            angle_deg = float(np.degrees(np.arccos(np.clip(cosine, 0, 1))))
            gross = float(off.sum() / known.sum())
            square = residual.reshape(SIDE, SIDE)
            brightness = np.nan if grey is None else mean_of(grey[part])
            found.append(
                Square(row, column, px_m / a, angle_deg, sigma, square, float(known.mean()), gross, brightness)
            )
    return found


def mean_of(values: NDArray) -> float:
    """Return the mean of known values, NaN if there are none."""
    known = np.isfinite(values)
    return float(values[known].mean()) if known.any() else np.nan


def on_plane(values: NDArray) -> tuple[NDArray, NDArray[np.bool_]] | None:
    """Return the plane (3,) of a square's disparities and its inliers; None if they are on no plane."""
    known = np.isfinite(values)
    if known.mean() < MIN_KNOWN:
        return None
    used, plane = known, np.zeros(3)
    for _ in range(4):
        plane = np.linalg.lstsq(PLANE[used], values[used], rcond=None)[0]
        off = np.abs(values - PLANE @ plane)
        used = known & (off < 4 * 1.4826 * np.median(off[used]) + 0.02)
        if used.sum() < 100:
            return None
    if used.sum() < MIN_FLAT * known.sum() or plane[0] <= 0:
        return None
    left = (values - PLANE @ plane)[used]
    bent = values[used] - CURVE[used] @ np.linalg.lstsq(CURVE[used], values[used], rcond=None)[0]
    if left.std() > MAX_SIGMA or bent.std() < CURVED * left.std():
        return None
    return plane, used


def add_correlation(seen: Seen, square: Square) -> None:
    """Add products of residuals, in sigmas, `lag` pixels apart along rows and columns, and their number."""
    if square.sigma_px <= 1e-4:
        return
    values = np.nan_to_num(square.residual / square.sigma_px)
    there = np.isfinite(square.residual).astype(float)
    hole = 1 - there
    for lag in range(LAGS + 1):
        cut = SIDE - lag
        for axis, (a, b) in enumerate(((np.s_[:, :cut], np.s_[:, lag:]), (np.s_[:cut], np.s_[lag:]))):
            seen.along[axis, lag] += (values[a] * values[b]).sum(), (there[a] * there[b]).sum()
            seen.holes[lag] += (hole[a] * hole[b]).sum(), hole[a].sum()


def edge_counts(disparity: NDArray) -> NDArray[np.float64]:
    """Count the pixels in the middle of edges, along rows, with no value, the near one, the far one, another."""
    first, last = SUPPORT
    width = disparity.shape[1]
    middle = np.s_[last : width - last]
    shifted = [disparity[:, last + step : width - last + step] for step in range(first, last + 1)]
    right = np.stack(shifted)
    left = np.stack([disparity[:, last - step : width - last - step] for step in range(first, last + 1)])
    a, b = np.median(left, axis=0), np.median(right, axis=0)
    with np.errstate(invalid="ignore"):
        flat = (np.ptp(left, axis=0) < GAP_PX / 4) & (np.ptp(right, axis=0) < GAP_PX / 4)
        edge = flat & (np.abs(a - b) > GAP_PX)
    near, far = np.maximum(a, b)[edge], np.minimum(a, b)[edge]
    tolerance = np.maximum(0.5, 0.1 * (near - far))
    counts = np.zeros(4)
    for step in range(-BETWEEN, BETWEEN + 1):
        value = np.roll(disparity, -step, axis=1)[:, middle][edge]
        none = ~np.isfinite(value)
        is_near, is_far = value > near - tolerance, value < far + tolerance
        counts += none.sum(), is_near.sum(), is_far.sum(), (~none & ~is_near & ~is_far).sum()
    return counts


def spread(squares: list[Square], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the residuals of all squares as an image, NaN elsewhere."""
    image = np.full(shape, np.nan)
    for square in squares:
        image[square.row : square.row + SIDE, square.column : square.column + SIDE] = square.residual
    return image


def agreement(before: Frame, squares: list[Square], after: Frame, residual: NDArray) -> NDArray[np.float64]:
    """Return sums (2, 3) of products and squares of residuals: at the same place on the surface, at the same pixel."""
    sums = np.zeros((2, 3))
    T = inverse(np.asarray(after.T_world_sensor, float)) @ np.asarray(before.T_world_sensor, float)
    camera, height, width = before.camera, *residual.shape
    for square in squares:
        u, v = square.column + SIDE / 2 - 0.5, square.row + SIDE / 2 - 0.5
        point = square.z * np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
        moved = transform_points(T, point[None])[0]
        du = round(float(moved[0] / moved[2] * camera.fx + camera.cx - u))
        dv = round(float(moved[1] / moved[2] * camera.fy + camera.cy - v))
        row, column = square.row + dv, square.column + du
        if not MOVED_PX[0] <= np.hypot(du, dv) <= MOVED_PX[1]:
            continue
        if not (0 <= row <= height - SIDE and 0 <= column <= width - SIDE):
            continue
        for i, (r, c) in enumerate(((row, column), (square.row, square.column))):
            other = residual[r : r + SIDE, c : c + SIDE]
            both = np.isfinite(other) & np.isfinite(square.residual)
            if both.sum() >= SIDE * SIDE / 4:
                a, b = square.residual[both] / square.sigma_px, other[both] / square.sigma_px
                sums[i] += (a * b).sum(), (a * a).sum(), (b * b).sum()
    return sums


def figures(seen: Seen) -> dict[str, Any]:
    """Return all figures as plain numbers."""
    rows, columns = (line[:, 0] / np.maximum(line[:, 1], 1) for line in seen.along)
    squares = [square for square in seen.squares if square.sigma_px > 1e-4]
    size, share = common_step(np.concatenate(seen.steps))
    holes = seen.holes[:, 0] / np.maximum(seen.holes[:, 1], 1)
    products, a, b = seen.again.T
    again = products / np.sqrt(np.maximum(a * b, 1e-30))
    total = max(seen.edges.sum(), 1)
    return {
        "frames": len(seen.valid),
        "squares": len(squares),
        "valid": float(np.mean(seen.valid)),
        "sigma_px": float(np.median([square.sigma_px for square in squares])),
        "sigma_rms_px": float(np.sqrt(np.mean([square.sigma_px**2 for square in squares]))),
        "step_px": size,
        "step_share": share,
        "correlation_rows": (rows / rows[0]).round(3).tolist(),
        "correlation_columns": (columns / columns[0]).round(3).tolist(),
        "falls_to_1_e_px": [falls_to(line / line[0], 1 / e) for line in (rows, columns)],
        "looks_in_8x8": looks(squares),
        "same_place_next_frame": float(again[0]) if a[0] else None,
        "same_pixel_next_frame": float(again[1]) if a[1] else None,
        "holes_alike": holes.round(3).tolist(),
        "holes_reach_px": falls_to((holes - holes[-1]) / max(1 - holes[-1], 1e-9), 1 / e),
        "gross": float(np.mean([square.gross for square in squares])),
        "edges": {
            name: float(number / total)
            for name, number in zip(("none", "near", "far", "flying"), seen.edges, strict=True)
        },
        "by_range_m": by(squares, [square.z for square in squares], RANGES),
        "by_angle_deg": by(squares, [square.angle_deg for square in squares], ANGLES),
        "by_grey": by(squares, [square.grey for square in squares], GREYS),
    }


def looks(squares: list[Square]) -> float | None:
    """Return the number of independent pixels that would make the means of 8x8 blocks equally noisy.

    The plane fitted to the square also removes a little of the blocks' noise.
    """
    means = []
    for square in squares:
        blocks = square.residual.reshape(SIDE // BLOCK, BLOCK, SIDE // BLOCK, BLOCK).swapaxes(1, 2)
        whole = np.isfinite(blocks).all((2, 3))
        means += (blocks[whole].mean((1, 2)) / square.sigma_px).tolist()
    return 1 / float(np.mean(np.square(means))) if means else None


def common_step(steps: NDArray) -> tuple[float, float]:
    """Return the most common difference between differing neighbours, in pixels, and its share (within a tenth)."""
    if not steps.size:
        return 0.0, 0.0
    counts, borders = np.histogram(steps, bins=250, range=(0, 1))
    best = float(borders[counts.argmax()] + 0.002)
    return round(best, 3), float((np.abs(steps - best) < 0.1 * best).mean())


def falls_to(line: NDArray, level: float) -> float:
    """Return the lag at which a correlation falls to `level`, inf if it does not."""
    below = np.flatnonzero(line < level)
    if not below.size or below[0] == 0:
        return float("inf") if not below.size else 0.0
    i = below[0]
    return round(float(i - 1 + (line[i - 1] - level) / (line[i - 1] - line[i])), 2)


def by(squares: list[Square], values: list[float], borders: tuple[float, ...]) -> list[dict[str, float]]:
    """Return, for each class of `values`, the squares' number, noise, and share of pixels without value."""
    table, place = [], np.digitize(values, borders)
    for i in range(1, len(borders)):
        some = [square for square, at in zip(squares, place, strict=True) if at == i]
        if len(some) >= 20:
            sigma, holes = np.median([s.sigma_px for s in some]), 1 - np.mean([s.known for s in some])
            numbers = {"from": borders[i - 1], "to": borders[i], "squares": len(some)}
            table.append({**numbers, "sigma_px": round(float(sigma), 4), "holes": round(float(holes), 4)})
    return table


def depth_frames(recording: str, frames: str | None, colour: bool) -> Iterator[tuple[Frame, NDArray | None]]:
    """Yield the depth frames of a recording, stereo pairs matched, with their grey images."""
    pipeline = DepthPipeline(load_config())
    for frame in sv.open_source(recording, frames=frames):
        if isinstance(frame, StereoFrame):
            yield pipeline.matched(frame), np.asarray(frame.left, float).reshape(*frame.left.shape[:2], -1).mean(2)
        elif not frame.fault:
            yield frame, registered_grey(frame, Path(recording)) if colour else None


def registered_grey(frame: Frame, folder: Path) -> NDArray[np.float64]:
    """Return the colour image of `sevenscenes_30hz` as grey (height, width) if the depth image has depth, else NaN.

    By the model in the recording's README.
    """
    import cv2

    number = "".join(character for character in Path(frame.name.split()[-1]).name if character.isdigit())[-6:]
    image = cv2.imread(str(folder / f"frame-{number}.color.jpg"), cv2.IMREAD_GRAYSCALE)
    depth = np.asarray(frame.depth, float) * frame.depth_scale
    near = cv2.medianBlur(np.where(depth > 60, 0, depth).astype(np.float32), 5)
    z = np.where(near > 0, near, np.median(near[near > 0]))
    x, y = (np.asarray(slope, float) for slope in frame.camera.ray_slopes())
    u = np.rint(527.1 * (x[None] * z - 0.0247) / z + 320.1).astype(int)
    v = np.rint(np.broadcast_to(527.1 * y[:, None] + 239.0, z.shape)).astype(int)
    inside = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
    return np.where(inside, image[np.where(inside, v, 0), np.where(inside, u, 0)].astype(float), np.nan)


def show(found: dict[str, Any]) -> None:
    for key, value in found.items():
        if key.startswith("by_"):
            for row in value:
                print(f"  {key[3:]} {row['from']:g} to {row['to']:g}: {row['squares']} squares, ", end="")
                print(f"{row['sigma_px']:.3f} px, without value {row['holes']:.1%}")
        else:
            print(f"{key}: {value}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--frames", default=None, metavar="START:STOP:STEP")
    parser.add_argument("--baseline", type=float, default=0.05, help="metres, where the recording does not say it")
    parser.add_argument("--colour", action="store_true")
    parser.add_argument("--json", action="store_true")
    wanted = parser.parse_args()
    found = measure(depth_frames(wanted.recording, wanted.frames, wanted.colour), wanted.baseline)
    if wanted.json:
        print(json.dumps(found))
    else:
        show(found)


if __name__ == "__main__":
    main()
