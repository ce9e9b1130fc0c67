# SPDX-License-Identifier: Apache-2.0
"""`pair.toml`: the depth images and the tracker of a pair, and the relation of their frames and clocks."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import SourceError, did_you_mean
from stereovox.files.safe_io import is_number, read_table, shown, toml_text
from stereovox.geometry.se3 import Transform, orthonormalise, rigidity_error
from stereovox.sources.poses.tracker import AXES, HIGHEST_CONFIDENCE, WORLDS

FILE = "pair.toml"
TOLERANCE = 0.005
"""Largest entry of abs(R^T R - I) that counts as rounding."""
RATES = (0.9, 1.1)


@dataclass(frozen=True, eq=False)
class PairSettings:
    """The settings in a `pair.toml`; every key has a default except `T_tracker_camera`, which must be measured.

    depth: folder or file of the depth images, relative to the file's own folder.
    poses: text file of the tracker, lines `stamp tx ty tz qx qy qz qw [confidence]`, or a bag with poses.
    axes: axes of the poses in that file, `opengl` (T265), `optical`, `ros` or `ned`; world: axes of the map, `up`
        (z up), `optical` (Chien 2020) or `file`.
    T_tracker_camera: (4, 4) metres; maps the depth camera's optical frame into the tracker's body frame, both in
        optical axes (x right, y down, z forward), whatever `axes` is; None: unknown.
    clock_offset_s, clock_rate: depth stamp = tracker stamp + offset + (rate - 1) * (tracker stamp - the first one).
    min_confidence: poses below it are not used (if the file has a confidence).
    max_speed_mps, max_turn_dps: poses further apart than this speed allows are a jump.
    depth_scale: metres per unit of the images; baseline: metres; without them, the depth source's.
    """

    depth: str = "."
    poses: str = "tracker.txt"
    axes: str = "opengl"
    world: str = "up"
    T_tracker_camera: Transform | None = None
    clock_offset_s: float = 0.0
    clock_rate: float = 1.0
    min_confidence: float = 2.0
    max_speed_mps: float = 10.0
    max_turn_dps: float = 720.0
    depth_scale: float | None = None
    baseline: float | None = None


LIMITS = {
    "clock_offset_s": (-9e9, 9e9),
    "clock_rate": RATES,
    "min_confidence": (0.0, float(HIGHEST_CONFIDENCE)),
    "max_speed_mps": (1e-3, 1e4),
    "max_turn_dps": (1e-1, 1e6),
    "depth_scale": (1e-7, 1e3),
    "baseline": (1e-4, 1e3),
}
"""Smallest and largest value of each number."""
WORDS = {"axes": tuple(AXES), "world": WORLDS}


def read_pair(path: Path) -> PairSettings:
    """Return the settings in `path`; raises SourceError naming file and key for anything wrong in it."""
    table = read_table(path)
    known = [field.name for field in fields(PairSettings)]
    for key in table:
        if key not in known:
            raise SourceError(f"{path}: unknown key '{key}'{did_you_mean(key, known)}")
    try:
        return PairSettings(**{key: _value(key, value) for key, value in table.items()})
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from None


def pair_text(settings: PairSettings, remarks: tuple[str, ...] = ()) -> str:
    """Return `settings` as the text of a `pair.toml` with `remarks` as comments at its top."""
    lines = [f"# {remark}" for remark in remarks]
    for field in fields(settings):
        value = getattr(settings, field.name)
        if value is not None:
            lines.append(f"{field.name} = {_text(value)}")
    return "\n".join(lines) + "\n"


def _value(key: str, value: Any) -> Any:
    if key == "T_tracker_camera":
        return _matrix(key, value)
    if key in LIMITS:
        low, high = LIMITS[key]
        if not (is_number(value) and low <= value <= high):
            raise ValueError(f"{key} = {shown(value)} must be a number from {low:g} to {high:g}")
        return float(value)
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError(f"{key} = {shown(value)} must be a string")
    if value not in WORDS.get(key, (value,)):
        raise ValueError(f"{key} = '{value}' is unknown{did_you_mean(value, WORDS[key])}")
    return value


def _matrix(key: str, value: Any) -> Transform:
    try:
        T = np.array(value, float)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if rigidity_error(T) > TOLERANCE:
        raise ValueError(f"{key} must be four rows of four numbers, a rotation and metres, below them 0 0 0 1")
    return orthonormalise(T)


def _text(value: Any) -> str:
    if isinstance(value, np.ndarray):
        rows = ("    [" + ", ".join(f"{number:.9g}" for number in row) + "]," for row in value + 0.0)
        return "\n".join(["[", *rows, "]"])
    return toml_text(value)
