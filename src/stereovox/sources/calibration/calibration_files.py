# SPDX-License-Identifier: Apache-2.0
"""Import stereo calibrations of other tools as rigs; the kind of a file is recognised by its contents."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from stereovox.cameras.wide import MODELS, Lens
from stereovox.errors import SourceError, StereovoxError
from stereovox.files.safe_io import read_text
from stereovox.geometry.se3 import inverse
from stereovox.sources.calibration.calibration_chains import CHAINS
from stereovox.sources.calibration.calibration_values import (
    StereoCalibration,
    Table,
    data_of,
    first_present,
    from_rectification,
    intrinsics_of,
    lens_model,
    lens_of,
    matrix,
    named,
    numbers,
    of_eyes,
    read_yaml,
    rigid,
)
from stereovox.sources.rigs.rig_file import Rig, RigPair

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
KINDS = "KITTI, ROS camera_info, OpenCV, Kalibr, EuRoC sensor.yaml, ORB-SLAM3, VINS-Fusion, OKVIS, Basalt"
Size = tuple[int, int]


def import_rig(files: Sequence[Path], size: Size | None = None, lens: str = "", name: str = "stereo") -> Rig:
    """Return the rig in calibration files of a kind recognised by content; see `KINDS`.

    size: width and height of the images if the files lack them. lens: `fisheye` if an OpenCV file has fisheye
    lenses; the other kinds declare it. name: of the pair; KITTI's are `grey` and `colour`. Raises SourceError for files
    of another kind, and for calibrations that a rig cannot express.
    """
    if not 1 <= len(files) <= 2:
        raise SourceError(f"{len(files)} files: give one, or two of one stereo camera")
    if _is_kitti(files[0]):
        return _kitti(files[0], size)
    found = read_calibration(files, size, lens)
    return Rig((RigPair(name, camera=found.camera, eyes=found.eyes, T_body_left=found.T_body_left),))


def read_calibration(files: Sequence[Path], size: Size | None = None, lens: str = "") -> StereoCalibration:
    """Return the pair in one or two YAML or JSON files, as `import_rig`; raises SourceError naming the first file."""
    try:
        return _calibration([read_yaml(path) for path in files], size, lens, files[0].parent)
    except SourceError as error:
        raise SourceError(f"{error}" if str(files[0]) in str(error) else f"{files[0]}: {error}") from None
    except StereovoxError as error:
        raise SourceError(f"{files[0]}: {error}") from None


def _calibration(tables: Sequence[Table], size: Size | None, lens: str, folder: Path) -> StereoCalibration:
    first = tables[0]
    for is_kind, read in CHAINS:
        if is_kind(first):
            return read(tables, folder)
    if any(key in first for key in INFO["P"]) and first_present(first, INFO["K"]) is not None:
        if len(tables) != 2:
            raise SourceError("is the camera_info of one eye; give both files, the left one first")
        return camera_info(tables[0], tables[1])
    merged: Table = {key: value for table in reversed(tables) for key, value in table.items()}
    if first_present(merged, OPENCV["K1"]) is not None:
        return _opencv(merged, size, lens)
    raise SourceError(f"is not a stereo calibration of a known kind: {KINDS}")


def camera_info(left: Table, right: Table) -> StereoCalibration:
    """Return the eyes of two camera_info: the rectified frames differ by the baseline in the second's P."""
    eyes = ((left, "left"), (right, "right"))
    lenses = [_info_lens(table, eye) for table, eye in eyes]
    turns = [matrix(named(table, INFO["R"], eye), f"{eye} rectification_matrix", 3, 3) for table, eye in eyes]
    places = [matrix(named(table, INFO["P"], eye), f"{eye} projection_matrix", 3, 4) for table, eye in eyes]
    return from_rectification(lenses, turns, places)


def _info_lens(table: Table, eye: str) -> Lens:
    model = lens_model(table.get("distortion_model"), f"the {eye} distortion_model")
    K = matrix(named(table, INFO["K"], eye), f"{eye} camera_matrix", 3, 3)
    size = [numbers([named(table, INFO[key], eye)], f"{eye} {key}", 1)[0] for key in ("width", "height")]
    return lens_of(model, intrinsics_of(K), data_of(named(table, INFO["D"], eye)), size, eye)


def _opencv(table: Table, size: tuple[int, int] | None, lens: str) -> StereoCalibration:
    model = lens or "pinhole"
    if model not in MODELS:
        raise SourceError(f"--lens {lens}: must be one of {', '.join(MODELS)}")
    size = size or _opencv_size(table)
    lenses = []
    for eye in ("1", "2"):
        K = matrix(named(table, OPENCV[f"K{eye}"], "file's"), f"M{eye}", 3, 3)
        D = data_of(named(table, OPENCV[f"D{eye}"], "file's"))
        lenses.append(lens_of(model, intrinsics_of(K), D, size, f"camera {eye}"))
    T_right_left = np.eye(4)
    T_right_left[:3, :3] = matrix(named(table, OPENCV["R"], "file's"), "R", 3, 3)
    T_right_left[:3, 3] = numbers(data_of(named(table, OPENCV["T"], "file's")), "T", 3)
    return of_eyes(lenses[0], lenses[1], inverse(rigid(T_right_left, "R")))


def _opencv_size(table: Table) -> tuple[int, int]:
    for keys in SIZES:
        if all(key in table for key in keys):
            width, height = numbers([table[key] for key in keys], "size", 2)
            return int(width), int(height)
    for key in ("imageSize", "image_size", "size"):
        if key in table:
            width, height = numbers(data_of(table[key]), key, 2)
            return int(width), int(height)
    raise SourceError("does not contain the size of the images; give it with --size WIDTHxHEIGHT")


def _is_kitti(path: Path) -> bool:
    try:
        text = read_text(path, errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a calibration: {KINDS}") from None
    return any(line.startswith(("P_rect_0", "P0:", "P2:")) for line in text.splitlines())


def _kitti(path: Path, size: Size | None) -> Rig:
    """Return the grey and the colour pair of rectified images; poses are rectified camera 0's."""
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
                raise SourceError(f"{path}: does not contain the size of the images; give it with --size WIDTHxHEIGHT")
            T_cam0_left = inverse(calibration.offset_of(left))
            folders = f"image_0{left}/data", f"image_0{left + 1}/data"
            camera = calibration.camera(left, left + 1, pixels)
            pairs.append(RigPair(name, *folders, camera=camera, T_body_left=T_cam0_left))
    if not pairs:
        raise SourceError(f"{path}: holds no pair of cameras 0 and 1 or 2 and 3; give the data set's own file")
    return Rig(tuple(pairs))
