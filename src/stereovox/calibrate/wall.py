# SPDX-License-Identifier: Apache-2.0
"""What a depth camera measures wrongly, from recordings of flat walls (after Chien 2020, App. A)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from stereovox.calibrate.models import SIMPLEST_FIRST, Points, corrected_inverse, fit, plane_of, residual, rms
from stereovox.calibrate.recording import WallRecording
from stereovox.calibrate.surface import Array, Wall, find_wall, slopes, tilt_deg
from stereovox.cameras import DepthCorrection, PinholeCamera
from stereovox.errors import StereovoxError, did_you_mean

MODELS = ("auto", *SIMPLEST_FIRST, "thesis")
SAMPLES = 20_000
"""Pixels of each wall that are fitted; its figures are of all."""
MISTAKEN = 0.2
"""A measured distance that is off by a larger share of what the camera sees belongs to another wall."""
ALIKE = 1.1
"""Distances whose ratio is smaller count as one."""
SIMPLER = 1.1
"""A simpler model is taken unless its error on walls it has not seen is so many times the best one's."""
ROUGH = 0.01
"""Error after the correction, as a share of the depth, that the user should know about."""
NARROW = 0.8
"""Share of the image's width and height that the wall should span."""


@dataclass(frozen=True, eq=False)
class WallResult:
    """One wall before and after the correction.

    before, after: (height, width) of (z - z_wall) / z_wall, mean over the frames, NaN off the wall. points_before,
    points_after: (height, width, 3) metres in the optical frame. plane: (a, b, c) of the wall, 1/z = a + b x + c y.
    fitted: False for a wall that was only looked at afterwards.
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


@dataclass(frozen=True, eq=False)
class WallCalibration:
    """The camera with its correction, how the model was chosen, and what it does to each wall.

    scores: for each model its error in percent on the walls it was fitted to (`fit`), and, where there are several
    distances, on those left out in turn (`unseen`), infinite where it leaves no depth there.
    """

    camera: PinholeCamera
    why: str
    scores: dict[str, dict[str, float]]
    walls: tuple[WallResult, ...]
    notes: tuple[str, ...]

    @property
    def correction(self) -> DepthCorrection:
        """The correction that was found."""
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


def calibrate_wall(
    recordings: Sequence[WallRecording],
    model: str = "auto",
    square: bool = False,
    check: Sequence[WallRecording] = (),
) -> WallCalibration:
    """Return the correction that makes the recorded walls flat.

    model: of `DepthCorrection`, or `auto`: the one that does best at distances it was not fitted to; with a single
    distance `scale`, whose error stays the same share of the depth wherever it is used. square: the walls are known to
    stand perpendicular to the optical axis. check: walls that are only looked at afterwards.
    Raises StereovoxError, one line: no wall, distances for some of the walls only or that cannot be, another camera,
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


def _finite(error: float) -> float | None:
    return error if np.isfinite(error) else None


def check_model(model: str) -> None:
    """Raise StereovoxError for a model that does not exist."""
    if model not in MODELS:
        raise StereovoxError(f"unknown model '{model}'{did_you_mean(model, MODELS)}")


def distance_groups(distances: Sequence[float]) -> list[int]:
    """Return for each distance the number of its group; distances within a tenth of the group's least are one group."""
    groups, starts = [0] * len(distances), []
    for i in np.argsort(distances):
        if not starts or distances[i] > ALIKE * starts[-1]:
            starts.append(distances[i])
        groups[i] = len(starts) - 1
    return groups


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
    if given is not None and abs(wall.distance / given - 1) > MISTAKEN:
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
    chosen = next(model for model, error in unseen.items() if error <= SIMPLER * best)
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
