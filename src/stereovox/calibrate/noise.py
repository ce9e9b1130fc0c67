# SPDX-License-Identifier: Apache-2.0
"""Noise of a depth camera, from recordings of a flat wall at several distances (Chien 2020, 2.2.4 and 3.3).

Recordings in other light, with another emitter power or before another texture may be labelled and are compared as in
Chien 2020, 2.2.4.1, where the share of pixels with a value is the quality measure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.surface import Array, Correlation, WallRecording, find_wall, fit_plane, slopes
from stereovox.calibrate.wall import distance_groups
from stereovox.errors import StereovoxError

REGION = (0.6, 0.4)
"""Width and height in metres of the part of the wall around the optical axis that counts (Chien 2020, 3.3)."""
MIN_PIXELS = 30
MIN_RMSE = 1e-6
"""Error, as a share of the depth, below which there is only rounding."""
TERMS = ("s0", "s1", "s2")
PATCH = 8
"""Pixels across the patches whose independent measurements are counted."""


@dataclass(frozen=True)
class NoiseAt:
    """The error of single measurements at one distance, against the plane through their mean.

    rmse_m: root mean square error in metres, Chien's RMSE; its square is the sum of those of its two parts.
    temporal_m: part that differs from frame to frame. fixed_m: part equal in all frames, 0 if it is lost in the
    noise. Both are None if there is a single frame.
    offset_m: how much too far the wall appears, None if its distance was not measured.
    valid_share: share of the region's pixels that have a value, of all frames; image_share: of the whole image.
    gross_share: share of the image's values that are gross errors; they are in no other figure.
    subpixel: the disparity error in pixels that makes rmse_m (Chien 2020, Eq 3.5), None without a baseline.
    correlation_px, falls_to_1_e_px, looks: correlation of the errors of neighbouring pixels, see `Correlation`; looks
    are for a patch of 8 x 8 pixels. grey: mean grey level of the pixels with a value, None if unknown.
    condition: light, emitter power or texture, in words.
    """

    name: str
    distance_m: float
    rmse_m: float
    temporal_m: float | None
    fixed_m: float | None
    offset_m: float | None
    valid_share: float
    image_share: float
    gross_share: float
    subpixel: float | None
    pixels: int
    frames: int
    correlation_px: float = 0.0
    falls_to_1_e_px: tuple[float, float] = (0.0, 0.0)
    looks: float = PATCH * PATCH
    grey: float | None = None
    condition: str = ""


@dataclass(frozen=True)
class ConditionNoise:
    """Noise of the recordings in one condition (Chien 2020, 2.2.4.1).

    distances_m: of the recordings. rmse_percent: their root mean square error as a share of the depth.
    subpixel: the same for the disparity error in pixels, None without a baseline. valid_share, gross_share: means.
    grey: mean grey level, None if no image is known.
    """

    condition: str
    distances_m: tuple[float, ...]
    rmse_percent: float
    subpixel: float | None
    valid_share: float
    gross_share: float
    grey: float | None


@dataclass(frozen=True)
class NoiseCalibration:
    """sigma(z) = s0 + s1 z + s2 z^2 in metres, and the points it was fitted to, nearest first.

    subpixel: s2 * focal length * baseline in pixels, None without a baseline. worst_percent: largest misfit of a point.
    correlation_px: mean of the recordings'. conditions: in the order of the recordings, empty if none has a label.
    """

    s0: float
    s1: float
    s2: float
    subpixel: float | None
    focal_px: float
    baseline: float | None
    region: tuple[float, float]
    points: tuple[NoiseAt, ...]
    notes: tuple[str, ...]
    correlation_px: float = 0.0
    conditions: tuple[ConditionNoise, ...] = ()

    def sigma(self, z: Array) -> Array:
        """Return the standard deviation in metres at depths `z` in metres."""
        return self.s0 + self.s1 * z + self.s2 * z * z

    @property
    def worst_percent(self) -> float:
        """Largest misfit of the curve at a point, in percent of the point."""
        z, rmse = np.array([(point.distance_m, point.rmse_m) for point in self.points]).T
        return float(100 * np.max(np.abs(self.sigma(z) / rmse - 1)))

    def as_dict(self) -> dict[str, Any]:
        """Return all figures."""
        names = ("s0", "s1", "s2", "subpixel", "correlation_px", "focal_px", "baseline")
        fit = {name: getattr(self, name) for name in names}
        rest = {"worst_percent": self.worst_percent, "region_m": list(self.region), "notes": list(self.notes)}
        each = {"points": [vars(point) for point in self.points], "conditions": [vars(one) for one in self.conditions]}
        return {**fit, **rest, **each}


def calibrate_noise(
    recordings: Sequence[WallRecording], region: tuple[float, float] = REGION, fitted: Sequence[str] = TERMS
) -> NoiseCalibration:
    """Return the noise of the camera that took all recordings, fitted to the whole RMSE of single measurements.

    The fixed part belongs in sigma too: it does not average out while the camera stands, and while it moves the map
    sees it as one more error of each measurement. `fitted` names those of s0, s1, s2 that may differ from 0; each needs
    its own distance.
    Raises StereovoxError: no wall, nothing in the region, different cameras, too few distances.
    """
    if not recordings:
        raise StereovoxError("no recording of a wall; give several, at different distances")
    camera = recordings[0].camera
    for recording in recordings:
        if recording.camera != camera:
            raise StereovoxError(f"{recording.name}: is of another camera than {recordings[0].name}; use one camera")
    points = sorted((noise_at(recording, region) for recording in recordings), key=lambda point: point.distance_m)
    distances = [point.distance_m for point in points]
    _check_noisy(points)
    _check_count(distances, fitted)
    s = fit_noise(np.array(distances), np.array([point.rmse_m for point in points]), fitted)
    focal_px = camera.fx * camera.binning
    subpixel = s[2] * focal_px * camera.baseline if camera.baseline else None
    notes = _notes(points, fitted, camera.baseline)
    alike = float(np.mean([point.correlation_px for point in points]))
    return NoiseCalibration(
        *s, subpixel, focal_px, camera.baseline, region, tuple(points), notes, alike, by_condition(recordings, points)
    )


def by_condition(recordings: Sequence[WallRecording], points: Sequence[NoiseAt]) -> tuple[ConditionNoise, ...]:
    """Return the noise in each labelled condition, in the recordings' order; empty if there is none."""
    named = list(dict.fromkeys(recording.condition for recording in recordings))
    return tuple(_condition(name, [p for p in points if p.condition == name]) for name in named) if any(named) else ()


def _condition(name: str, points: Sequence[NoiseAt]) -> ConditionNoise:
    def rms(values: Sequence[float]) -> float:
        return float(np.sqrt(np.mean(np.square(values))))

    subpixels = [point.subpixel for point in points if point.subpixel is not None]
    greys = [point.grey for point in points if point.grey is not None]
    return ConditionNoise(
        name or "not named",
        tuple(point.distance_m for point in points),
        100 * rms([point.rmse_m / point.distance_m for point in points]),
        rms(subpixels) if subpixels else None,
        float(np.mean([point.valid_share for point in points])),
        float(np.mean([point.gross_share for point in points])),
        float(np.mean(greys)) if greys else None,
    )


def noise_at(recording: WallRecording, region: tuple[float, float] = REGION) -> NoiseAt:
    """Return the noise within `region` (width, height in metres on the wall) around the optical axis.

    Raises StereovoxError if there is no wall or too few pixels of the region have depth.
    """
    camera = recording.camera
    wall = find_wall(recording.inverse, camera, recording.name)
    x, y = slopes(camera)
    inside = (np.abs(x) <= region[0] / 2 / wall.distance) & (np.abs(y) <= region[1] / 2 / wall.distance)
    used = inside & wall.on_wall
    if used.sum() < MIN_PIXELS:
        raise StereovoxError(
            f"{recording.name}: only {used.sum()} pixels of the middle {region[0]:g} x {region[1]:g} m show the wall; "
            "clear the view of it, give it more texture, or use a larger --region"
        )
    plane = fit_plane(x[used], y[used], recording.inverse[used])
    rmse, temporal, fixed = _errors(recording.sums[:, used], 1 / (plane[0] + plane[1] * x[used] + plane[2] * y[used]))
    distance = float(1 / plane[0])
    values, alike = recording.count.sum(), Correlation.of(recording.products)
    return NoiseAt(
        recording.name,
        distance,
        rmse,
        temporal,
        fixed,
        None if recording.distance is None else distance - recording.distance,
        float(recording.count[inside].sum() / (inside.sum() * recording.frames)),
        recording.valid_share,
        float(recording.gross / (values + recording.gross)),
        rmse * camera.fx * camera.binning * camera.baseline / distance**2 if camera.baseline else None,
        int(used.sum()),
        recording.frames,
        alike.length_px,
        alike.falls_to_1_e_px,
        alike.looks(PATCH),
        grey=float(np.mean(recording.greys)) if recording.greys else None,
        condition=recording.condition,
    )


def fit_noise(z: Array, rmse: Array, fitted: Sequence[str] = TERMS) -> tuple[float, float, float]:
    """Return s0, s1, s2 >= 0 of the curve nearest to `rmse` (N,) at depths `z` (N,); terms not in `fitted` are 0.

    Errors count as shares of the RMSE, because that is how precisely a standard deviation is known.
    """
    from scipy.optimize import nnls

    powers = [TERMS.index(name) for name in fitted]
    columns = np.stack([z**power / rmse for power in powers], axis=1)
    s = np.zeros(len(TERMS))
    s[powers] = nnls(columns, np.ones(len(z)))[0]
    return float(s[0]), float(s[1]), float(s[2])


def _errors(sums: NDArray[np.float64], wall_z: Array) -> tuple[float, float | None, float | None]:
    """Return RMSE, its temporal and its fixed part in metres, of pixels with `sums` (4, N) on a wall at `wall_z` (N,).

    A pixel's temporal variance is subtracted from the error of its mean, or noise would count as fixed error.
    """
    count, _, first, second = sums
    mean = first / count
    total = float(np.sum(second - 2 * wall_z * first + count * wall_z**2) / np.sum(count))
    rmse = float(np.sqrt(max(total, 0.0)))
    degrees = np.sum(count - 1)
    if degrees <= 0:
        return rmse, None, None
    temporal = float(np.sum(second - count * mean**2) / degrees)
    fixed, of_noise = total - temporal, temporal / count.mean() * np.sqrt(2 / count.size)
    seen = fixed > 3 * of_noise + 1e-12
    return rmse, float(np.sqrt(max(temporal, 0.0))), float(np.sqrt(fixed)) if seen else 0.0


def _check_noisy(points: Sequence[NoiseAt]) -> None:
    for point in points:
        if point.rmse_m <= MIN_RMSE * point.distance_m:
            raise StereovoxError(f"{point.name}: shows no noise at all; record a real camera, with its noise")


def _check_count(distances: Sequence[float], fitted: Sequence[str]) -> None:
    count = len(set(distance_groups(distances)))
    if count >= len(fitted):
        return
    seen = ", ".join(f"{distance:.2f}" for distance in distances)
    less = {1: "s2", 2: "s0,s2 or --terms s2"}[count]
    raise StereovoxError(
        f"too few distances ({seen} m) to tell {', '.join(fitted)} apart: record {len(fitted) - count} more, "
        f"or fit less with --terms {less}"
    )


def _notes(points: Sequence[NoiseAt], fitted: Sequence[str], baseline: float | None) -> tuple[str, ...]:
    notes = []
    if points[-1].distance_m < 2 * points[0].distance_m and len(fitted) > 1:
        notes.append(
            f"the farthest wall is not twice as far as the nearest: {', '.join(fitted)} are hard to tell apart"
        )
    if baseline is None:
        notes.append("the camera's baseline is not known: no equivalent sub-pixel; put it into camera.toml")
    for point in points:
        if point.valid_share < 0.5:
            notes.append(f"{point.name}: only {point.valid_share:.0%} of the region has depth; the rest may be noisier")
        if point.temporal_m is None:
            notes.append(f"{point.name}: a single frame, noise and fixed error cannot be told apart")
    return tuple(notes)
