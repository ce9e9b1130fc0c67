# SPDX-License-Identifier: Apache-2.0
"""Stereo calibrations that other tools wrote, as rigs: KITTI, ROS camera_info, OpenCV and Kalibr."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from stereovox.errors import SourceError, StereovoxError
from stereovox.geometry import inverse
from stereovox.sources.rig_file import Rig, RigPair
from stereovox.untrusted import read_text

KINDS = "KITTI calib_cam_to_cam.txt or calib.txt, ROS camera_info yaml (two files), OpenCV yml, Kalibr camchain yaml"
Size = tuple[int, int]


def import_rig(files: Sequence[Path], size: Size | None = None, lens: str = "", name: str = "stereo") -> Rig:
    """Return the rig in calibration files of a kind that is recognised by content; see `KINDS`.

    size: width and height of the images where the files do not tell. lens: `fisheye` where an OpenCV file is of one;
    the others say it. name: of the pair; KITTI's are `grey` and `colour`.
    Raises SourceError, one line, for files of another kind, and for what cannot be brought into a rig.
    """
    if not 1 <= len(files) <= 2:
        raise SourceError(f"{len(files)} files: give one, or two of one stereo camera")
    if _is_kitti(files[0]):
        return _kitti(files[0], size)
    from stereovox.sources.calibration_yaml import eyes_of, read_yaml

    try:
        eyes, T_body_left = eyes_of([read_yaml(path) for path in files], size, lens)
    except SourceError as error:
        raise SourceError(f"{error}" if str(files[0]) in str(error) else f"{files[0]}: {error}") from None
    except StereovoxError as error:
        raise SourceError(f"{files[0]}: {error}") from None
    return Rig((RigPair(name, eyes=eyes, T_body_left=T_body_left),))


def _is_kitti(path: Path) -> bool:
    try:
        text = read_text(path, errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a calibration: {KINDS}") from None
    return any(line.startswith(("P_rect_0", "P0:", "P2:")) for line in text.splitlines())


def _kitti(path: Path, size: Size | None) -> Rig:
    """Return the grey and the colour pair of rectified images; poses are those of rectified camera 0."""
    from stereovox.sources.kitti_calibration import from_raw_files, read_calibration, read_values

    values = read_values(path)
    raw = "P_rect_00" in values or "P_rect_02" in values
    nowhere = path.with_name(path.name + ".none")
    calibration = from_raw_files(path, nowhere, nowhere) if raw else read_calibration(path)
    pairs = []
    for name, left in (("grey", 0), ("colour", 2)):
        if {left, left + 1} <= set(calibration.projections):
            told = [number for number in values.get(f"S_rect_0{left}", ()) if math.isfinite(number)]
            pixels = size or ((int(told[0]), int(told[1])) if len(told) == 2 else None)
            if pixels is None:
                raise SourceError(f"{path}: does not tell the size of the images; give it with --size WIDTHxHEIGHT")
            T_cam0_left = inverse(calibration.offset_of(left))
            folders = f"image_0{left}/data", f"image_0{left + 1}/data"
            camera = calibration.camera(left, left + 1, pixels)
            pairs.append(RigPair(name, *folders, camera=camera, T_body_left=T_cam0_left))
    if not pairs:
        raise SourceError(f"{path}: holds no pair of cameras 0 and 1 or 2 and 3; give the data set's own file")
    return Rig(tuple(pairs))
