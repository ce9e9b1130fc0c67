# SPDX-License-Identifier: Apache-2.0
"""`camera.toml`: the numbers of a depth camera, and what a calibration found that it measures wrongly."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from stereovox.cameras import DepthCorrection, PinholeCamera
from stereovox.errors import SourceError, StereovoxError, did_you_mean
from stereovox.sources.toml_file import is_number, read_table, toml_text
from stereovox.untrusted import shown

FILE = "camera.toml"
SIZES = ("width", "height")
INTRINSICS = ("fx", "fy", "cx", "cy")
NEEDED = {
    **dict.fromkeys(SIZES, "its number of pixels"),
    **dict.fromkeys(("fx", "fy"), "its focal length in pixels"),
    **dict.fromkeys(("cx", "cy"), "where the optical axis meets the image, in pixels"),
}
"""What a key is, for those who left it out."""
KEYS = (*SIZES, *INTRINSICS, "baseline", "correction")
CORRECTION = ("model", "coefficients", "provenance")


def read_camera(path: Path) -> PinholeCamera:
    """Return the camera in `path`; raises SourceError, one line with file and key, for anything wrong in it.

    Keys: width, height, fx, fy, cx, cy in pixels, perhaps baseline in metres, perhaps a table [correction] with model
    and coefficients as `DepthCorrection` has them, and a table [correction.provenance] of anything.
    """
    table = read_table(path)
    try:
        return _camera(table)
    except StereovoxError as error:
        raise SourceError(f"{path}: {error}") from None


def camera_text(camera: PinholeCamera, provenance: Mapping[str, Any] | None = None, remarks: Sequence[str] = ()) -> str:
    """Return a camera as the text of a camera file, `remarks` as comments at its top.

    provenance: texts, numbers and lists of them that tell where the correction comes from.
    """
    lines = [f"# {remark}" for remark in remarks]
    lines += [f"{key} = {toml_text(getattr(camera, key))}" for key in (*SIZES, *INTRINSICS)]
    if camera.baseline is not None:
        lines.append(f"baseline = {toml_text(camera.baseline)}")
    if camera.correction:
        lines += ["", "[correction]", f"model = {toml_text(camera.correction.model)}"]
        lines.append(f"coefficients = {toml_text(camera.correction.coefficients)}")
    if camera.correction and provenance:
        lines += ["", "[correction.provenance]", *(f"{key} = {toml_text(value)}" for key, value in provenance.items())]
    return "\n".join(lines) + "\n"


def _camera(table: dict[str, Any]) -> PinholeCamera:
    if "pair" in table:
        raise SourceError("is a rig file, no camera file; put it into the recording's folder as rig.toml")
    _check_keys(table, KEYS, "")
    for key, what in NEEDED.items():
        if key not in table:
            raise SourceError(f"{key} is missing; write {key} = {what}")
    sizes = [_number(table, key) for key in SIZES]
    if not all(size.is_integer() and 0 < size < 100_000 for size in sizes):
        raise SourceError(f"width and height must be whole numbers of pixels, not {sizes[0]:g} and {sizes[1]:g}")
    baseline = _number(table, "baseline") if "baseline" in table else None
    correction = _correction(table["correction"]) if "correction" in table else None
    fx, fy, cx, cy = (_number(table, key) for key in INTRINSICS)
    return pinhole((int(sizes[0]), int(sizes[1])), (fx, fy, cx, cy), baseline, correction)


def pinhole(
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    baseline: float | None,
    correction: DepthCorrection | None = None,
) -> PinholeCamera:
    """Return a camera from numbers in a file: (width, height), and fx, fy, cx, cy; all finite.

    Raises SourceError that names the number which cannot be.
    """
    named = {"fx": intrinsics[0], "fy": intrinsics[1], "baseline": 1.0 if baseline is None else baseline}
    for name, number in named.items():
        if number <= 0:
            raise SourceError(f"{name} = {number:g} must be positive")
    try:
        return PinholeCamera(*size, *intrinsics, baseline, correction=correction)
    except StereovoxError as error:  # which shows the whole camera; its last words tell what is wrong
        numbers = " ".join(f"{number:g}" for number in intrinsics)
        raise SourceError(f"fx fy cx cy = {numbers}: {str(error).rpartition(': ')[2]}") from None


def _correction(table: Any) -> DepthCorrection:
    if not isinstance(table, dict):
        raise SourceError("correction must be a table [correction] with model and coefficients")
    _check_keys(table, CORRECTION, "correction.")
    model, numbers = table.get("model"), table.get("coefficients")
    if not isinstance(model, str) or not isinstance(numbers, list):
        raise SourceError("[correction] needs model, a text, and coefficients, a list of numbers")
    if not all(is_number(number) for number in numbers):
        raise SourceError(f"correction.coefficients {shown(numbers)} must be numbers")
    return DepthCorrection(model, tuple(map(float, numbers)))


def _check_keys(table: dict[str, Any], known: Sequence[str], prefix: str) -> None:
    for key in table:
        if key not in known:
            raise SourceError(f"unknown key '{prefix}{key}'{did_you_mean(key, known)}")


def _number(table: dict[str, Any], key: str) -> float:
    value = table[key]
    if not is_number(value):
        raise SourceError(f"{key} = {shown(value)} must be a number")
    return float(value)
