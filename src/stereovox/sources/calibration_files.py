# SPDX-License-Identifier: Apache-2.0
"""Import stereo calibrations of other tools as rigs: KITTI, ROS camera_info, OpenCV and Kalibr."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lenses import MODELS, Lens
from stereovox.cameras.rigs import Eyes
from stereovox.errors import SourceError, StereovoxError
from stereovox.safe_io import MAX_YAML, read_text, yaml_value
from stereovox.se3 import Transform, inverse, orthonormalise, rigidity_error
from stereovox.sources.rig_file import Rig, RigPair

Table = dict[str, Any]
Found = tuple[Eyes, Transform]
"""Both eyes, and T_body_left: the body is the inertial unit if Kalibr's file has one, else the left eye."""
KALIBR = {"radtan": "pinhole", "equidistant": "fisheye", "none": "pinhole"}
ROS = {"plumb_bob": "pinhole", "rational_polynomial": "pinhole", "equidistant": "fisheye", "fisheye": "fisheye"}
OPENCV = {
    "K1": ("M1", "K1", "cameraMatrix1", "camera_matrix_1"),
    "D1": ("D1", "distCoeffs1", "dist_coeffs_1"),
    "K2": ("M2", "K2", "cameraMatrix2", "camera_matrix_2"),
    "D2": ("D2", "distCoeffs2", "dist_coeffs_2"),
    "R": ("R",),
    "T": ("T",),
}
"""Names used by OpenCV's samples and their descendants."""
INFO = {
    "K": ("camera_matrix", "K", "k"),
    "D": ("distortion_coefficients", "D", "d"),
    "R": ("rectification_matrix", "R", "r"),
    "P": ("projection_matrix", "P", "p"),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
}
SIZES = (("width", "height"), ("image_width", "image_height"), ("imageWidth", "imageHeight"))
TOLERANCE = 5e-3
KINDS = "KITTI calib_cam_to_cam.txt or calib.txt, ROS camera_info yaml (two files), OpenCV yml, Kalibr camchain yaml"
Size = tuple[int, int]


def import_rig(files: Sequence[Path], size: Size | None = None, lens: str = "", name: str = "stereo") -> Rig:
    """Return the rig in calibration files of a kind recognised by content; see `KINDS`.

    size: width and height of the images where the files lack them. lens: `fisheye` where an OpenCV file has fisheye
    lenses; the other kinds declare it. name: of the pair; KITTI's are `grey` and `colour`. Raises SourceError for files
    of another kind, and for what cannot be expressed as a rig.
    """
    if not 1 <= len(files) <= 2:
        raise SourceError(f"{len(files)} files: give one, or two of one stereo camera")
    if _is_kitti(files[0]):
        return _kitti(files[0], size)
    try:
        eyes, T_body_left = eyes_of([read_yaml(path) for path in files], size, lens)
    except SourceError as error:
        raise SourceError(f"{error}" if str(files[0]) in str(error) else f"{files[0]}: {error}") from None
    except StereovoxError as error:
        raise SourceError(f"{files[0]}: {error}") from None
    return Rig((RigPair(name, eyes=eyes, T_body_left=T_body_left),))


def read_yaml(path: Path) -> Table:
    """Return the table in a YAML file, also one of OpenCV's; raises SourceError."""
    import yaml

    class Loader(yaml.SafeLoader):
        """Knows OpenCV's matrices, which are tables as well."""

    def matrix(loader: yaml.SafeLoader, node: Any) -> Any:
        return loader.construct_mapping(node, deep=True)

    Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", matrix)
    try:
        lines = read_text(path, MAX_YAML).splitlines()
        text = "\n".join(lines[1:] if lines and lines[0].startswith("%YAML") else lines)
        table = yaml_value(text, Loader)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a file you may read") from None
    except ValueError as error:
        raise SourceError(f"{path}: no YAML that can be read ({error}); correct it") from None
    if not isinstance(table, dict):
        raise SourceError(f"{path}: holds no table of a calibration; give the file that the calibration wrote")
    return table


def eyes_of(tables: Sequence[Table], size: tuple[int, int] | None, lens: str) -> Found:
    """Return both eyes of the calibration in `tables`; raises SourceError for another kind or missing keys."""
    first = tables[0]
    if "cam0" in first:
        return _kalibr(first)
    if any(key in first for key in INFO["P"]) and _first_present(first, INFO["K"]) is not None:
        if len(tables) != 2:
            raise SourceError("is the camera_info of one eye; give both files, first the left")
        return _camera_info(tables[0], tables[1])
    merged: Table = {key: value for table in reversed(tables) for key, value in table.items()}
    if _first_present(merged, OPENCV["K1"]) is not None:
        return _opencv(merged, size, lens)
    raise SourceError("is no stereo calibration of a known kind: KITTI, ROS camera_info, OpenCV or Kalibr")


def _kalibr(table: Table) -> Found:
    if "cam1" not in table:
        raise SourceError("has cam0 but no cam1; give the camchain of a stereo camera")
    lenses = [_kalibr_lens(table, name) for name in ("cam0", "cam1")]
    T_left_right = inverse(_rigid(_needed(table["cam1"], "cam1", "T_cn_cnm1"), "cam1.T_cn_cnm1"))
    bodies: list[Transform | None] = [
        inverse(_rigid(table[name]["T_cam_imu"], f"{name}.T_cam_imu")) if "T_cam_imu" in table[name] else None
        for name in ("cam0", "cam1")
    ]
    return _in_order(lenses[0], lenses[1], T_left_right, bodies)


def _kalibr_lens(table: Table, name: str) -> Lens:
    camera = table[name]
    if not isinstance(camera, dict):
        raise SourceError(f"{name} is no table; give the camchain as Kalibr wrote it")
    model, distortion = camera.get("camera_model"), camera.get("distortion_model", "none")
    if model != "pinhole" or not isinstance(distortion, str) or distortion not in KALIBR:
        known = ", ".join(f"pinhole-{word}" for word in KALIBR)
        raise SourceError(f"{name}: {model}-{distortion} is no lens we have ({known}); calibrate with one of them")
    fx, fy, cx, cy = _numbers(_needed(camera, name, "intrinsics"), f"{name}.intrinsics", 4)
    width, height = _numbers(_needed(camera, name, "resolution"), f"{name}.resolution", 2)
    k = _numbers(camera.get("distortion_coeffs", []), f"{name}.distortion_coeffs")
    return Lens(KALIBR[distortion], int(width), int(height), fx, fy, cx, cy, tuple(k))


def _camera_info(left: Table, right: Table) -> Found:
    """Return the eyes of two camera_info: the rectified frames differ by the baseline in the second's P."""
    lenses = [_info_lens(table, eye) for table, eye in ((left, "left"), (right, "right"))]
    turns, shifts = [], []
    for table, eye in ((left, "left"), (right, "right")):
        turns.append(_matrix(_named(table, INFO["R"], eye), f"{eye} rectification_matrix", 3, 3))
        P = _matrix(_named(table, INFO["P"], eye), f"{eye} projection_matrix", 3, 4)
        if not P[0, 0] > 0:
            raise SourceError(f"the {eye} projection_matrix has no focal length; calibrate the stereo pair first")
        shifts.append(-P[0, 3] / P[0, 0])
    if shifts[0] == shifts[1]:
        raise SourceError("both projection_matrix have one place, so there is no baseline; give left and right")
    T_left_right = np.eye(4)
    T_left_right[:3, :3] = turns[0].T @ turns[1]
    T_left_right[:3, 3] = turns[0].T @ [shifts[1] - shifts[0], 0, 0]
    return _in_order(lenses[0], lenses[1], _rigid(T_left_right, "rectification_matrix"), [None, None])


def _info_lens(table: Table, eye: str) -> Lens:
    model = table.get("distortion_model", "plumb_bob")
    if not isinstance(model, str) or model not in ROS:
        raise SourceError(
            f"the {eye} distortion_model '{model}' is none of {', '.join(ROS)}; calibrate with one of them"
        )
    K = _matrix(_named(table, INFO["K"], eye), f"{eye} camera_matrix", 3, 3)
    size = (int(_numbers([_named(table, INFO[key], eye)], f"{eye} {key}", 1)[0]) for key in ("width", "height"))
    return _lens(ROS[model], K, _data(_named(table, INFO["D"], eye)), tuple(size), eye)


def _opencv(table: Table, size: tuple[int, int] | None, lens: str) -> Found:
    model = lens or "pinhole"
    if model not in MODELS:
        raise SourceError(f"--lens {lens}: must be one of {', '.join(MODELS)}")
    size = size or _opencv_size(table)
    lenses = []
    for eye in ("1", "2"):
        K = _matrix(_named(table, OPENCV[f"K{eye}"], "file's"), f"M{eye}", 3, 3)
        lenses.append(_lens(model, K, _data(_named(table, OPENCV[f"D{eye}"], "file's")), size, f"camera {eye}"))
    T_right_left = np.eye(4)
    T_right_left[:3, :3] = _matrix(_named(table, OPENCV["R"], "file's"), "R", 3, 3)
    T_right_left[:3, 3] = _numbers(_data(_named(table, OPENCV["T"], "file's")), "T", 3)
    return _in_order(lenses[0], lenses[1], inverse(_rigid(T_right_left, "R")), [None, None])


def _opencv_size(table: Table) -> tuple[int, int]:
    for keys in SIZES:
        if all(key in table for key in keys):
            width, height = _numbers([table[key] for key in keys], "size", 2)
            return int(width), int(height)
    for key in ("imageSize", "image_size", "size"):
        if key in table:
            width, height = _numbers(_data(table[key]), key, 2)
            return int(width), int(height)
    raise SourceError("does not tell the size of the images; give it with --size WIDTHxHEIGHT")


def _lens(model: str, K: NDArray[np.float64], distortion: Any, size: tuple[int, ...], eye: str) -> Lens:
    k = _numbers(distortion, f"{eye} distortion")
    most = MODELS[model]
    if any(k[most:]):
        raise SourceError(f"{eye}: a {model} lens has {most} coefficients, not {len(k)}; calibrate without the others")
    return Lens(model, size[0], size[1], K[0, 0], K[1, 1], K[0, 2], K[1, 2], tuple(k[:most]))


def _in_order(a: Lens, b: Lens, T_a_b: Transform, bodies: Sequence[Transform | None]) -> Found:
    """Return the eyes with the left one first, whatever their order in the file."""
    if T_a_b[0, 3] < 0:
        a, b, T_a_b, bodies = b, a, inverse(T_a_b), bodies[::-1]
    return Eyes(a, b, T_a_b), np.eye(4) if bodies[0] is None else bodies[0]


def _rigid(value: Any, what: str) -> Transform:
    T = _matrix(value, what, 4, 4)
    if rigidity_error(T) > TOLERANCE:
        raise SourceError(f"{what} is no rigid motion; give the file as the calibration wrote it")
    return orthonormalise(T)


def _first_present(table: Mapping[str, Any], names: Sequence[str]) -> Any:
    return next((table[name] for name in names if name in table), None)


def _named(table: Mapping[str, Any], names: Sequence[str], whose: str) -> Any:
    found = _first_present(table, names)
    if found is None:
        raise SourceError(f"the {whose} {names[0]} is missing; give the file as the calibration wrote it")
    return found


def _needed(table: Any, name: str, key: str) -> Any:
    if not isinstance(table, dict) or key not in table:
        raise SourceError(f"{name}.{key} is missing; give the camchain as Kalibr wrote it")
    return table[key]


def _data(value: Any) -> Any:
    """Return the numbers of a matrix, which ROS and OpenCV write as a table with rows, cols and data."""
    return value.get("data", []) if isinstance(value, dict) else value


def _matrix(value: Any, what: str, rows: int, columns: int) -> NDArray[np.float64]:
    return np.array(_numbers(_data(value), what, rows * columns)).reshape(rows, columns)


def _numbers(value: Any, what: str, count: int | None = None) -> list[float]:
    try:
        numbers = np.array(value, float).ravel()
    except (TypeError, ValueError, OverflowError):
        numbers = np.array([np.nan])
    if not np.isfinite(numbers).all() or (count is not None and len(numbers) != count):
        many = "numbers" if count is None else f"{count} numbers"
        raise SourceError(f"{what} must be {many}; give the file as the calibration wrote it")
    return [float(number) for number in numbers]


def _is_kitti(path: Path) -> bool:
    try:
        text = read_text(path, errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a calibration: {KINDS}") from None
    return any(line.startswith(("P_rect_0", "P0:", "P2:")) for line in text.splitlines())


def _kitti(path: Path, size: Size | None) -> Rig:
    """Return the grey and the colour pair of rectified images; poses are those of rectified camera 0."""
    from stereovox.sources.kitti.calibration import from_raw_files, read_calibration, read_values

    values = read_values(path)
    raw = "P_rect_00" in values or "P_rect_02" in values
    nowhere = path.with_name(path.name + ".none")
    calibration = from_raw_files(path, nowhere, nowhere) if raw else read_calibration(path)
    pairs = []
    for name, left in (("grey", 0), ("colour", 2)):
        if {left, left + 1} <= set(calibration.projections):
            size_entry = [number for number in values.get(f"S_rect_0{left}", ()) if math.isfinite(number)]
            pixels = size or ((int(size_entry[0]), int(size_entry[1])) if len(size_entry) == 2 else None)
            if pixels is None:
                raise SourceError(f"{path}: does not tell the size of the images; give it with --size WIDTHxHEIGHT")
            T_cam0_left = inverse(calibration.offset_of(left))
            folders = f"image_0{left}/data", f"image_0{left + 1}/data"
            camera = calibration.camera(left, left + 1, pixels)
            pairs.append(RigPair(name, *folders, camera=camera, T_body_left=T_cam0_left))
    if not pairs:
        raise SourceError(f"{path}: holds no pair of cameras 0 and 1 or 2 and 3; give the data set's own file")
    return Rig(tuple(pairs))
