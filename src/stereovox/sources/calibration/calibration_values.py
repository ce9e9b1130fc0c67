# SPDX-License-Identifier: Apache-2.0
"""Values of calibration files of other tools: YAML, matrices, numbers and lenses, each checked as it is read."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import MODELS, Lens
from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_YAML, read_text, shown, yaml_value
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rigidity_error

Table = dict[str, Any]
DISTORTIONS = {
    "radtan": "pinhole",
    "radialtangential": "pinhole",
    "plumbbob": "pinhole",
    "rationalpolynomial": "pinhole",
    "none": "pinhole",
    "": "pinhole",
    "equidistant": "fisheye",
    "equi": "fisheye",
    "fisheye": "fisheye",
    "kannalabrandt": "fisheye",
    "kannalabrandt4": "fisheye",
    "kannalabrandt8": "fisheye",
    "kb4": "fisheye",
}
"""Our lens model of each distortion, by its name in lower case without `-`, `_` and blanks."""
TOLERANCE = 5e-3
"""Largest entry of abs(R^T R - I) that counts as rounding."""
UNSPACED = re.compile(r"^([ ]*[\w.]+):(?=[^\s:])", re.MULTILINE)
"""OpenCV reads `data:[1, 2]`, which YAML parses as one word."""


class StereoCalibration(NamedTuple):
    """One pair of a calibration file, the left eye first.

    eyes: the lenses of images that must be rectified, or None. camera: the camera of rectified images, or None.
    T_body_left: (4, 4) maps the left optical frame (rectified if there is a camera) into the body's: the inertial
        unit if the file has one, else the left eye. swapped: the file lists the right eye first.
    """

    eyes: Eyes | None = None
    camera: PinholeCamera | None = None
    T_body_left: Transform = np.eye(4)
    swapped: bool = False


def read_yaml(path: Path) -> Table:
    """Return the table in a YAML or JSON file, also one of OpenCV's; raises SourceError."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Reads OpenCV's matrices, which are tables too."""

    def matrix(loader: yaml.SafeLoader, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix)
    try:
        lines = read_text(path, MAX_YAML).splitlines()
        lines = lines[1:] if lines and lines[0].startswith("%YAML") else lines
        ends = [n for n, line in enumerate(lines) if n and line.rstrip() == "---"]  # `ros2 topic echo` repeats itself
        text = "\n".join(lines[: ends[0]] if ends else lines)
        table = yaml_value(UNSPACED.sub(r"\1: ", text.expandtabs(2)), Loader)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a file you may read") from None
    except ValueError as error:
        raise SourceError(f"{path}: not valid YAML ({str(error)[:120]}); correct it") from None
    if not isinstance(table, dict):
        raise SourceError(f"{path}: holds no table of a calibration; give the file that the calibration wrote")
    return table


def of_eyes(a: Lens, b: Lens, T_a_b: Transform, bodies: Sequence[Transform | None] = (None, None)) -> StereoCalibration:
    """Return two eyes with the left one first, whatever their order in the file.

    T_a_b: (4, 4) maps the optical frame of `b` into that of `a`. bodies: T_body_a and T_body_b, None: unknown.
    """
    swapped = bool(T_a_b[0, 3] < 0)
    if swapped:
        a, b, T_a_b, bodies = b, a, inverse(T_a_b), bodies[::-1]
    T_body_left, T_body_right = bodies
    if T_body_left is None:
        T_body_left = np.eye(4) if T_body_right is None else T_body_right @ inverse(T_a_b)
    return StereoCalibration(Eyes(a, b, T_a_b), None, T_body_left, swapped)


def from_rectification(
    lenses: Sequence[Lens], turns: Sequence[NDArray[np.float64]], places: Sequence[NDArray[np.float64]]
) -> StereoCalibration:
    """Return the eyes of a rectification; the rectified frames differ by the baseline in the second's projection.

    lenses: of the left and the right eye. turns: (3, 3) each, raw into rectified coordinates. places: (3, 4) each, the
    projections of rectified coordinates. Raises SourceError if these give no baseline.
    """
    shifts = []
    for P, eye in zip(places, ("left", "right"), strict=True):
        if not P[0, 0] > 0:
            raise SourceError(f"the {eye} projection_matrix has no focal length; calibrate the stereo pair first")
        shifts.append(-P[0, 3] / P[0, 0])
    if shifts[0] == shifts[1]:
        raise SourceError("both projection_matrix are equal, so there is no baseline; give left and right")
    T_left_right = np.eye(4)
    T_left_right[:3, :3] = turns[0].T @ turns[1]
    T_left_right[:3, 3] = turns[0].T @ [shifts[1] - shifts[0], 0, 0]
    return of_eyes(lenses[0], lenses[1], rigid(T_left_right, "rectification_matrix"))


def of_mounts(lenses: Sequence[Lens], mounts: Sequence[Transform]) -> StereoCalibration:
    """Return two eyes with known mounts T_body_camera (4, 4), the left one first."""
    (a, b), (T_body_a, T_body_b) = lenses, mounts
    return of_eyes(a, b, inverse(T_body_a) @ T_body_b, (T_body_a, T_body_b))


def lens_model(distortion: Any, what: str) -> str:
    """Return our model of a named distortion; raises SourceError if it is not supported."""
    name = re.sub(r"[-_ ]", "", distortion.lower()) if isinstance(distortion, str) else None
    if distortion is None or name in DISTORTIONS:
        return DISTORTIONS[name or ""]
    known = "radtan (plumb_bob), equidistant (fisheye), none"
    raise SourceError(f"{what} = {shown(distortion)} is not supported ({known}); calibrate with one of them")


def lens_of(model: str, intrinsics: Sequence[float], distortion: Any, size: Sequence[float], eye: str) -> Lens:
    """Return a lens from fx fy cx cy and its coefficients; raises SourceError if it has too many of them."""
    k = numbers(distortion, f"{eye} distortion")
    most = MODELS[model]
    if any(k[most:]):
        raise SourceError(f"{eye}: a {model} lens has {most} coefficients, not {len(k)}; calibrate without the others")
    fx, fy, cx, cy = intrinsics
    return Lens(model, int(size[0]), int(size[1]), fx, fy, cx, cy, tuple(k[:most]))


def intrinsics_of(K: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a (3, 3) camera matrix."""
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def rigid(value: Any, what: str) -> Transform:
    """Return the (4, 4) rigid motion in 16 or 12 numbers; raises SourceError for anything else."""
    given = np.asarray(numbers(data_of(value), what))
    if len(given) == 12:
        given = np.append(given, (0.0, 0.0, 0.0, 1.0))
    T = matrix(given, what, 4, 4)
    if rigidity_error(T) > TOLERANCE:
        raise SourceError(f"{what} is not a rigid motion; give the file as the calibration wrote it")
    return orthonormalise(T)


def first_present(table: Mapping[str, Any], names: Sequence[str]) -> Any:
    """Return the value of the first of `names` that the table has, None if it has none."""
    return next((table[name] for name in names if name in table), None)


def named(table: Mapping[str, Any], names: Sequence[str], whose: str) -> Any:
    """Return the value of the first of `names` that the table has; raises SourceError if it has none."""
    found = first_present(table, names)
    if found is None:
        raise SourceError(f"the {whose} {names[0]} is missing; give the file as the calibration wrote it")
    return found


def data_of(value: Any) -> Any:
    """Return the numbers of a matrix, which ROS and OpenCV write as a table with rows, cols and data."""
    return value.get("data", []) if isinstance(value, dict) else value


def matrix(value: Any, what: str, rows: int, columns: int) -> NDArray[np.float64]:
    """Return a (rows, columns) matrix; raises SourceError if it has another number of finite numbers."""
    return np.array(numbers(data_of(value), what, rows * columns)).reshape(rows, columns)


def numbers(value: Any, what: str, count: int | None = None) -> list[float]:
    """Return finite numbers, `count` of them if given; raises SourceError for anything else.

    OpenCV accepts a blank or line end instead of a comma between two numbers; so does this.
    """
    if isinstance(value, list):
        value = [word for item in value for word in (item.split() if isinstance(item, str) else [item])]
    try:
        found = np.array(value, float).ravel()
    except (TypeError, ValueError, OverflowError):
        found = np.array([np.nan])
    if not np.isfinite(found).all() or (count is not None and len(found) != count):
        many = "numbers" if count is None else f"{count} numbers"
        raise SourceError(f"{what} must be {many}; give the file as the calibration wrote it")
    return [float(number) for number in found]
