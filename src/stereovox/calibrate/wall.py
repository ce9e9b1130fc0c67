# SPDX-License-Identifier: Apache-2.0
"""Systematic depth errors of a camera, from recordings of flat walls (after Chien 2020, App. A).

The models of `DepthCorrection` are fitted to walls by linear least squares in 1/z. With m = 1/z measured and a plane
1/z = a + b x + c y, the models scale and disparity say a + b x + c y = m (1 + s) + q for each pixel: linear in the
coefficients of the quadratics s and q and in b and c of each wall.

An error that is linear across the image cannot be distinguished from a leaning wall. So s and q have no terms x and y,
and the lean is the wall's; only walls known to be square to the optical axis fix these terms too. A constant term needs
measured distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereovox.calibrate.surface import Array, Wall, WallRecording, find_wall, fit_plane, slopes, terms, tilt_deg
from stereovox.cameras.pinhole import CORRECTIONS, DepthCorrection, PinholeCamera
from stereovox.depth.prepare import quadratics
from stereovox.errors import StereovoxError, did_you_mean

SIMPLEST_FIRST = ("scale", "disparity", "scale+disparity")
MODELS = ("auto", *SIMPLEST_FIRST, "thesis")
SAMPLES = 20_000
"""Pixels of each wall that are fitted; its figures use all."""
MAX_DISTANCE_ERROR = 0.2
"""A measured distance that differs more from the camera's, as a share, belongs to another wall."""
SAME_DISTANCE = 1.1
"""Distances whose ratio is smaller count as one."""
SIMPLER_FACTOR = 1.1
"""A simpler model is chosen unless its error on unseen walls is this many times the best one's."""
ROUGH = 0.01
"""Error after the correction, as a share of the depth, above which the user is warned."""
NARROW = 0.8
"""Share of the image's width and height that the wall should span."""


def calibrate_wall(
    recordings: Sequence[WallRecording],
    model: str = "auto",
    square: bool = False,
    check: Sequence[WallRecording] = (),
) -> WallCalibration:
    """Return the correction that makes the recorded walls flat.

    model: of `DepthCorrection`, or `auto`: the best at distances it was not fitted to; with a single distance `scale`,
    whose error stays the same share of the depth everywhere. square: the walls are known to be perpendicular to the
    optical axis. check: walls used only for checking.
    Raises StereovoxError: no wall, distances of only some walls or impossible ones, another camera,
    an unknown model.
    """
    check_model(model)
    _check(recordings, check)
    found = [find_wall(recording.inverse, recording.camera, recording.name) for recording in recordings]
    for recording, wall in zip(recordings, found, strict=True):
        _check_distance(recording, wall)
    points = [_points(recording, wall, square) for recording, wall in zip(recordings, found, strict=True)]
    groups = distance_groups([wall.distance for wall in found])
    scores = _scores(points, groups)
    chosen, why = _choose(scores, groups) if model == "auto" else (model, "it was asked for")
    if chosen == "scale+disparity" and len(set(groups)) < 2:
        raise StereovoxError(f"too few distances for --model {chosen}: record another, or use scale or disparity")
    correction = fit(chosen, points)
    results = [_result(*pair, correction, square, True) for pair in zip(recordings, found, strict=True)]
    for recording in check:
        wall = find_wall(recording.inverse, recording.camera, recording.name)
        _check_distance(recording, wall)
        results.append(_result(recording, wall, correction, square, False))
    camera = replace(recordings[0].camera, correction=correction)
    return WallCalibration(camera, why, scores, tuple(results), _notes(results))


@dataclass(frozen=True, eq=False)
class WallCalibration:
    """The camera with its correction, the reason for the model, and its effect on each wall.

    scores: for each model its error in percent on the walls it was fitted to (`fit`), and, with several
    distances, on those left out in turn (`unseen`), infinite if it leaves no depth there.
    """

    camera: PinholeCamera
    why: str
    scores: dict[str, dict[str, float]]
    walls: tuple[WallResult, ...]
    notes: tuple[str, ...]

    @property
    def correction(self) -> DepthCorrection:
        """The correction found."""
        assert self.camera.correction
        return self.camera.correction

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the images."""
        return {
            "model": self.correction.model,
            "coefficients": list(self.correction.coefficients),
            "why": self.why,
            "models": {model: {key: _finite(error) for key, error in of.items()} for model, of in self.scores.items()},
            "walls": [wall.as_dict() for wall in self.walls],
            "notes": list(self.notes),
        }


@dataclass(frozen=True, eq=False)
class WallResult:
    """One wall before and after the correction.

    before, after: (height, width) of (z - z_wall) / z_wall, mean over the frames, NaN off the wall. points_before,
    points_after: (height, width, 3) metres in the optical frame. plane: (a, b, c) of the wall, 1/z = a + b x + c y.
    fitted: False for a wall used only for checking.
    """

    recording: WallRecording
    plane: Array
    before: Array
    after: Array
    points_before: Array
    points_after: Array
    fitted: bool

    @property
    def distance(self) -> float:
        """Metres from the camera to the wall along the optical axis."""
        return float(1 / self.plane[0])

    def as_dict(self) -> dict[str, Any]:
        """Return the figures: percent of the depth, degrees, metres, shares."""
        return {
            "name": self.recording.name,
            "distance_m": self.distance,
            "distance_given": self.recording.distance is not None,
            "fitted": self.fitted,
            "tilt_deg": tilt_deg(self.plane),
            "before_percent": 100 * rms(self.before),
            "after_percent": 100 * rms(self.after),
            "worst_after_percent": 100 * float(np.nanpercentile(np.abs(self.after), 99)),
            "wall_share": float(np.isfinite(self.before).mean()),
            "frames": self.recording.frames,
            "frames_skipped": self.recording.skipped,
        }


def check_model(model: str) -> None:
    """Raise StereovoxError for an unknown model."""
    if model not in MODELS:
        raise StereovoxError(f"unknown model '{model}'{did_you_mean(model, MODELS)}")


def distance_groups(distances: Sequence[float]) -> list[int]:
    """Return the group of each distance; distances within a tenth of the group's least belong together."""
    groups, starts = [0] * len(distances), []
    for i in np.argsort(distances):
        if not starts or distances[i] > SAME_DISTANCE * starts[-1]:
            starts.append(distances[i])
        groups[i] = len(starts) - 1
    return groups


def fit(model: str, walls: Sequence[Points]) -> DepthCorrection:
    """Return the correction of this model that makes the walls as flat as possible, in shares of their depth.

    Either all walls have a distance, or none has.
    """
    if model == "thesis":
        return _fit_thesis(walls)
    active = _active_terms(walls)
    count = int(active.sum()) * (2 if model == "scale+disparity" else 1)
    A, b = _equations(model, walls, active, count)
    solution = np.linalg.lstsq(A, b, rcond=None)[0][:count]
    coefficients = np.zeros((count // int(active.sum()), active.size))
    coefficients[:, active] = solution.reshape(len(coefficients), -1)
    return DepthCorrection(model, tuple(coefficients.ravel()))


@dataclass(frozen=True, eq=False)
class Points:
    """Pixels of one wall: slopes x, y and measured 1/z in 1/m, each (N,).

    distance: where the optical axis meets the wall in metres, None: unknown. square: the wall is known to be
    perpendicular to the axis.
    """

    x: Array
    y: Array
    inverse: Array
    distance: float | None = None
    square: bool = False


def corrected_inverse(correction: DepthCorrection | None, x: Array, y: Array, inverse: Array) -> Array:
    """Return the corrected 1/z (N,) in 1/m; NaN if the correction gives no depth."""
    if correction is None:
        return inverse
    if correction.model == "thesis":
        p1, p2, p3 = correction.coefficients
        X = x / inverse
        result = 1 / (1 / inverse - (p1 * X * X + p2 * X + p3))
    else:
        s, q = quadratics(correction)
        columns = terms(x, y)
        result = inverse * (1 + columns @ s) + columns @ q
    return np.where(result > 0, result, np.nan)


def plane_of(wall: Points, correction: DepthCorrection | None = None) -> Array:
    """Return (a, b, c) of the plane 1/z = a + b x + c y nearest to the corrected wall, through its known distance."""
    inverse = corrected_inverse(correction, wall.x, wall.y, wall.inverse)
    known = np.isfinite(inverse)
    return fit_plane(wall.x[known], wall.y[known], inverse[known], wall.distance, wall.square)


def residual(wall: Points, correction: DepthCorrection | None, plane: Array | None = None) -> Array:
    """Return (z - z_plane) / z_plane of the corrected points (N,); without `plane`, the plane of `plane_of`."""
    a, b, c = plane_of(wall, correction) if plane is None else plane
    return (a + b * wall.x + c * wall.y) / corrected_inverse(correction, wall.x, wall.y, wall.inverse) - 1


def rms(values: Array) -> float:
    """Return the root mean square of non-NaN values; infinite if there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("inf")


def _active_terms(walls: Sequence[Points]) -> np.ndarray:
    square = all(wall.square for wall in walls)
    measured = all(wall.distance is not None for wall in walls)
    return np.array([measured, square, square, True, True, True])


def _equations(model: str, walls: Sequence[Points], active: np.ndarray, count: int) -> tuple[Array, Array]:
    """Return A and b of the least squares problem: first the shared coefficients, then (a, b, c) of each wall."""
    rows, right = [], []
    for k, wall in enumerate(walls):
        columns = terms(wall.x, wall.y)
        m = wall.inverse[:, None]
        quadratic = columns[:, active]
        parts = {"scale": [quadratic * m], "disparity": [quadratic], "scale+disparity": [quadratic * m, quadratic]}
        planes = np.zeros((len(m), 3 * len(walls)))
        free = [wall.distance is None, not wall.square, not wall.square]
        planes[:, 3 * k : 3 * k + 3] = columns[:, :3] * free
        weight = 1 / (m * np.sqrt(len(m)))
        rows.append(np.hstack([*(-part for part in parts[model]), planes]) * weight)
        known = 0.0 if wall.distance is None else 1 / wall.distance
        right.append((m[:, 0] - known) * weight[:, 0])
    assert rows[0].shape[1] == count + 3 * len(walls)
    return np.vstack(rows), np.concatenate(right)


def _fit_thesis(walls: Sequence[Points]) -> DepthCorrection:
    """Return the quadratic in X of Chien 2020, Eq A.1 and A.2: dZ = p1 X^2 + p2 X + p3, X in metres.

    Chien's wall is square and at a measured distance; else p2 or p3 stays zero, see the top of this file.
    """
    straight = fit("scale", walls)
    columns, errors = [], []
    for wall in walls:
        z = 1 / wall.inverse
        X = wall.x * z
        a, b, c = plane_of(wall, straight)
        weight = wall.inverse / np.sqrt(len(z))
        columns.append(np.stack([X * X, X, np.ones_like(X)], axis=1) * weight[:, None])
        errors.append((z - 1 / (a + b * wall.x + c * wall.y)) * weight)
    active = _active_terms(walls)[[3, 1, 0]]
    p = np.zeros(CORRECTIONS["thesis"])
    p[active] = np.linalg.lstsq(np.vstack(columns)[:, active], np.concatenate(errors), rcond=None)[0]
    return DepthCorrection("thesis", tuple(p))


def _finite(error: float) -> float | None:
    return error if np.isfinite(error) else None


def _check(recordings: Sequence[WallRecording], check: Sequence[WallRecording]) -> None:
    if not recordings:
        raise StereovoxError("no recording of a wall; give one or several")
    measured = [recording.distance is not None for recording in recordings]
    if any(measured) != all(measured):
        raise StereovoxError("give the distance of every wall, or of none")
    first = recordings[0]
    for recording in (*recordings, *check):
        if recording.camera != first.camera:
            raise StereovoxError(f"{recording.name}: is of another camera than {first.name}; calibrate each by itself")


def _check_distance(recording: WallRecording, wall: Wall) -> None:
    given = recording.distance
    if given is not None and abs(wall.distance / given - 1) > MAX_DISTANCE_ERROR:
        raise StereovoxError(
            f"{recording.name}: the camera sees the wall at {wall.distance:.2f} m, not near {given:g} m; "
            "check the distances and their order"
        )


def _points(recording: WallRecording, wall: Wall, square: bool) -> Points:
    """Return some of the wall's pixels, spread at random but always the same."""
    x, y = slopes(recording.camera)
    picked = np.flatnonzero(wall.on_wall)
    if len(picked) > SAMPLES:
        picked = np.random.default_rng(0).choice(picked, SAMPLES, replace=False)
    inverse = recording.inverse.ravel()[picked]
    return Points(x.ravel()[picked], y.ravel()[picked], inverse, recording.distance, square)


def _scores(points: Sequence[Points], groups: Sequence[int]) -> dict[str, dict[str, float]]:
    """Return the errors of every model that can be told from these walls, in percent."""
    count = len(set(groups))
    models = [*SIMPLEST_FIRST[: 3 if count > 1 else 2], "thesis"]
    scores = {model: {"fit": 100 * _error(points, fit(model, points))} for model in models}
    for model in models:
        needed = 2 if model == "scale+disparity" else 1
        if count > needed:
            scores[model]["unseen"] = 100 * float(np.sqrt(np.mean(_unseen(model, points, groups))))
    return scores


def _unseen(model: str, points: Sequence[Points], groups: Sequence[int]) -> list[float]:
    """Return the squared error at each distance of what was fitted to the others."""
    squares = []
    for group in sorted(set(groups)):
        inside = [wall for wall, of in zip(points, groups, strict=True) if of == group]
        outside = [wall for wall, of in zip(points, groups, strict=True) if of != group]
        squares.append(_error(inside, fit(model, outside)) ** 2)
    return squares


def _error(points: Sequence[Points], correction: DepthCorrection) -> float:
    return float(np.sqrt(np.mean([rms(residual(wall, correction)) ** 2 for wall in points])))


def _choose(scores: dict[str, dict[str, float]], groups: Sequence[int]) -> tuple[str, str]:
    unseen = {model: scores[model]["unseen"] for model in SIMPLEST_FIRST if "unseen" in scores.get(model, {})}
    if not unseen:
        return "scale", (
            "one distance cannot tell an error that is a share of the depth from one that grows with it; 'scale' never "
            "changes a depth by a larger share than here. Record a second distance to find out"
        )
    best = min(unseen.values())
    chosen = next(model for model, error in unseen.items() if error <= SIMPLER_FACTOR * best)
    distances = len(set(groups))
    return chosen, f"of {distances} distances, each left out in turn, it predicts the left out one best or as well"


def _result(
    recording: WallRecording, wall: Wall, correction: DepthCorrection, square: bool, fitted: bool
) -> WallResult:
    camera, on_wall = recording.camera, wall.on_wall
    x, y = slopes(camera)
    points = Points(x[on_wall], y[on_wall], recording.inverse[on_wall], recording.distance, square)
    plane = plane_of(points, correction)

    def image(values: Array) -> Array:
        result = np.full(on_wall.shape, np.nan)
        result[on_wall] = values
        return result

    if not np.isfinite(corrected_inverse(correction, points.x, points.y, points.inverse)).any():
        raise StereovoxError(
            f"{recording.name}: the model {correction.model} leaves no depth at {wall.distance:.2f} m; check the "
            "distances, or use another --model"
        )
    before, after = (image(residual(points, used, plane)) for used in (None, correction))
    seen, right = (
        camera.back_project(image(1 / corrected_inverse(used, points.x, points.y, points.inverse)))
        for used in (None, correction)
    )
    return WallResult(recording, plane, before, after, seen, right, fitted)


def _notes(results: Sequence[WallResult]) -> tuple[str, ...]:
    notes = []
    for wall in results:
        on_wall = np.isfinite(wall.before)
        seen = [np.flatnonzero(on_wall.any(axis=axis)) for axis in (0, 1)]
        shares = [(span[-1] - span[0] + 1) / size for span, size in zip(seen, on_wall.shape[::-1], strict=True)]
        if wall.fitted and min(shares) < NARROW:
            spans = f"{shares[0]:.0%} of the width and {shares[1]:.0%} of the height"
            notes.append(f"{wall.recording.name}: the wall spans {spans}; beyond it the correction is a guess")
    for name, error in ((wall.recording.name, rms(wall.after)) for wall in results):
        if error > ROUGH:
            notes.append(f"{name}: still off by {100 * error:.1f} %; is the wall flat, and are there enough frames?")
    if any(wall.recording.frames < 10 for wall in results):
        notes.append("some recordings have less than 10 frames; noise then counts as error")
    return tuple(notes)
