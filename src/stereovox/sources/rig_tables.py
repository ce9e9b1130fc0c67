# SPDX-License-Identifier: Apache-2.0
"""The tables of a `rig.toml`: checked and made into a `Rig`, and written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, fields, replace
from typing import Any

import numpy as np

from stereovox.cameras import PinholeCamera
from stereovox.errors import SourceError, StereovoxError, did_you_mean
from stereovox.geometry import Transform, orthonormalise, rigidity_error
from stereovox.lenses import COUNTS, Lens
from stereovox.rigs import Eyes, VirtualCamera
from stereovox.sources.rig_file import Rig, RigPair, Virtual
from stereovox.sources.toml_file import is_number, toml_text
from stereovox.untrusted import shown
from stereovox.wide import CylindricalCamera, SphericalCamera

CAMERAS = {"pinhole": PinholeCamera, "spherical": SphericalCamera, "cylindrical": CylindricalCamera}
LENS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")
EYES = ("left_lens", "right_lens", "T_left_right")
KEYS = ("name", "left", "right", "index", "T_body_left", "mask_rectangles", "mask", "camera", "virtual", *EYES)
WORDS = ("left", "right", "index", "mask")
SIZES = ("width", "height")
LARGEST = 32_767
"""Pixels along a side; OpenCV takes no more."""
TOLERANCE = 5e-3
"""Largest entry of abs(R^T R - I) that passes for rounding."""
UNWRITTEN = ("binning", "correction")


def rig_of(table: dict[str, Any]) -> Rig:
    """Return the rig that a rig file's table says; raises StereovoxError, one line with pair and key."""
    _check_keys(table, ("poses", "pair"), "")
    tables = table.get("pair")
    if not isinstance(tables, list) or not tables or not all(isinstance(one, dict) for one in tables):
        raise SourceError("holds no pair; write a table [[pair]] for each")
    pairs = tuple(_named(number, one) for number, one in enumerate(tables))
    names = [pair.name for pair in pairs]
    if len(set(names)) < len(names):
        raise SourceError(f"two pairs have one name (names: {', '.join(names)}); give each its own")
    return Rig(pairs, _word(table, "poses") if "poses" in table else Rig.poses)


def rig_text(rig: Rig, remarks: Sequence[str] = ()) -> str:
    """Return `rig` as the text of a `rig.toml`, with `remarks` as comments at its top."""
    lines = [f"# {remark}" for remark in remarks]
    lines.append(f"poses = {toml_text(rig.poses)}")
    for pair in rig.pairs:
        lines += ["", *_pair_lines(pair)]
    return "\n".join(lines) + "\n"


def _named(number: int, table: dict[str, Any]) -> RigPair:
    name = _word(table, "name") if "name" in table else RigPair.name
    try:
        return _pair(name, table)
    except StereovoxError as error:
        raise SourceError(f"pair {number + 1} ('{name}'): {error}") from None


def _pair(name: str, table: dict[str, Any]) -> RigPair:
    _check_keys(table, KEYS, "")
    given: dict[str, Any] = {key: _word(table, key) for key in WORDS if key in table}
    if "T_body_left" in table:
        given["T_body_left"] = _matrix(table, "T_body_left")
    if "mask_rectangles" in table:
        given["mask_rectangles"] = _rectangles(table["mask_rectangles"])
    eyes = [key for key in (*EYES, "virtual") if key in table]
    if "camera" in table and eyes:
        raise SourceError(f"has [pair.camera] and {eyes[0]}: the images are either rectified already or not; keep one")
    if "camera" in table:
        return RigPair(name, camera=_camera(_table(table, "camera")), **given)
    for key in EYES:
        if key not in table:
            raise SourceError(f"{key} is missing; give both lenses and T_left_right, or [pair.camera] if rectified")
    left, right = (_lens(_table(table, key), f"{key}.") for key in EYES[:2])
    virtual = _virtual(_table(table, "virtual")) if "virtual" in table else Virtual()
    return RigPair(name, eyes=Eyes(left, right, _matrix(table, "T_left_right")), virtual=virtual, **given)


def _camera(table: dict[str, Any]) -> VirtualCamera:
    model = table.get("model", "pinhole")
    if model not in CAMERAS:
        raise SourceError(f"camera.model = {shown(model)} is unknown{did_you_mean(str(model), CAMERAS)}")
    entries = {entry.name: entry for entry in fields(CAMERAS[model]) if entry.name not in UNWRITTEN}
    _check_keys(table, ("model", *entries), "camera.")
    needed = [name for name, entry in entries.items() if entry.default is MISSING or name == "baseline"]
    given = dict.fromkeys([*needed, *(name for name in entries if name in table)])
    return CAMERAS[model](**{key: _count(table, key) if key in SIZES else _number(table, key) for key in given})


def _lens(table: dict[str, Any], prefix: str) -> Lens:
    _check_keys(table, LENS, prefix)
    try:
        width, height = (_count(table, key) for key in SIZES)
        fx, fy, cx, cy = (_number(table, key) for key in LENS[3:7])
        distortion = table.get("distortion", [])
        if not isinstance(distortion, list) or not all(map(is_number, distortion)):
            raise SourceError(f"distortion = {shown(distortion)} must be a list of numbers")
        lens = Lens(_word(table, "model"), width, height, fx, fy, cx, cy, tuple(map(float, distortion)))
        *counts, most = COUNTS[lens.model]
        if len(distortion) not in COUNTS[lens.model]:
            wanted = f"{', '.join(map(str, counts))} or {most} numbers for a {lens.model}, not {len(distortion)}"
            raise SourceError(f"distortion must have {wanted}")
        return lens
    except StereovoxError as error:
        raise SourceError(f"{prefix.removesuffix('.')}: {error}") from None


def _virtual(table: dict[str, Any]) -> Virtual:
    _check_keys(table, [entry.name for entry in fields(Virtual)], "virtual.")
    given: dict[str, Any] = {key: _number(table, key) for key in ("hfov_deg", "vfov_deg") if key in table}
    if "model" in table:
        given["model"] = _word(table, "model")
    if "size" in table:
        size = table["size"]
        if not isinstance(size, list) or len(size) != 2:
            raise SourceError(f"virtual.size = {shown(size)} must be [width, height] in pixels")
        given["size"] = tuple(_count({"virtual.size": side}, "virtual.size") for side in size)
    return Virtual(**given)


def _rectangles(value: Any) -> tuple[Any, ...]:
    good = isinstance(value, list) and all(isinstance(one, list) and len(one) == 4 for one in value)
    if not good or not all(type(number) is int and abs(number) <= LARGEST for one in value for number in one):
        raise SourceError(f"mask_rectangles = {shown(value)} must be a list of [u0, v0, u1, v1] in whole pixels")
    return tuple(map(tuple, value))


def _matrix(table: dict[str, Any], key: str) -> Transform:
    try:
        T = np.array(table[key], float)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if rigidity_error(T) > TOLERANCE:
        raise SourceError(f"{key} must be four rows of four numbers, a rotation and metres, below them 0 0 0 1")
    return orthonormalise(T)


def _table(table: dict[str, Any], key: str) -> dict[str, Any]:
    if not isinstance(table[key], dict):
        raise SourceError(f"{key} must be a table [pair.{key}]")
    return table[key]


def _word(table: dict[str, Any], key: str) -> str:
    value = table.get(key)
    if not isinstance(value, str) or not value or "\0" in value:
        said = f"{key} = {shown(value)} must be a text" if key in table else f"{key} is missing; give a text"
        raise SourceError(said)
    return value


def _number(table: dict[str, Any], key: str) -> float:
    if key not in table:
        raise SourceError(f"{key} is missing; write {key} = its number")
    if not is_number(table[key]):
        raise SourceError(f"{key} = {shown(table[key])} must be a number")
    return float(table[key])


def _count(table: dict[str, Any], key: str) -> int:
    number = _number(table, key)
    if not (number.is_integer() and 0 < number < LARGEST):
        raise SourceError(f"{key} = {number:g} must be a whole number of pixels")
    return int(number)


def _check_keys(table: dict[str, Any], known: Sequence[str], prefix: str) -> None:
    for key in table:
        if key not in known:
            raise SourceError(f"unknown key '{prefix}{key}'{did_you_mean(key, known)}")


def _pair_lines(pair: RigPair) -> list[str]:
    lines = ["[[pair]]", f"name = {toml_text(pair.name)}"]
    lines += [f"{key} = {toml_text(getattr(pair, key))}" for key in WORDS if getattr(pair, key)]
    lines += _matrix_lines("T_body_left", pair.T_body_left)
    if pair.mask_rectangles:
        lines.append(f"mask_rectangles = {toml_text(pair.mask_rectangles)}")
    if pair.eyes is None:
        assert pair.camera is not None
        model = next(name for name, kind in CAMERAS.items() if isinstance(pair.camera, kind))
        named = [entry.name for entry in fields(pair.camera) if entry.name not in UNWRITTEN]
        return [*lines, "", "[pair.camera]", f'model = "{model}"', *_lines(pair.camera, named)]
    lines += _matrix_lines("T_left_right", pair.eyes.T_left_right)
    for side in ("left", "right"):
        lines += ["", f"[pair.{side}_lens]", *_lines(_filled(getattr(pair.eyes, side)), LENS)]
    return [*lines, "", "[pair.virtual]", *_lines(pair.virtual, [entry.name for entry in fields(Virtual)])]


def _filled(lens: Lens) -> Lens:
    """Return the same lens with as many coefficients as `_lens` takes."""
    count = next(count for count in COUNTS[lens.model] if count >= len(lens.distortion))
    return replace(lens, distortion=lens.distortion + (0.0,) * (count - len(lens.distortion)))


def _lines(what: Any, names: Sequence[str]) -> list[str]:
    values = {name: getattr(what, name) for name in names}
    return [f"{name} = {toml_text(value)}" for name, value in values.items() if value is not None]


def _matrix_lines(key: str, T: Transform) -> list[str]:
    return [f"{key} = [", *(f"    {toml_text([float(number) for number in row])}," for row in T + 0.0), "]"]
