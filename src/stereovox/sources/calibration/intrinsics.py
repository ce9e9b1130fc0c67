# SPDX-License-Identifier: Apache-2.0
"""Focal lengths and centres of a camera in the small files of other programs: text, JSON, YAML."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_LIST, is_number, read_json, read_text

Intrinsics = tuple[float, float, float, float]
"""fx, fy, cx, cy in pixels."""
FORMS = "the matrix 'fx 0 cx / 0 fy cy / 0 0 1' or the four numbers fx fy cx cy"
JSON_NAMES = (
    "camera_intrinsics.json", "camera_intrinsic.json", "camera.json", "intrinsics.json", "intrinsic.json",
    "camera_primesense.json", "cam_params.json", "transforms.json",
)  # fmt: skip
TEXT_NAMES = (
    "camera-intrinsics.txt", "calibration.txt", "intrinsics.txt", "intrinsic.txt", "intrinsics_depth.txt", "K.txt",
    "intrinsics.K.txt", "intrinsic_depth.txt",
    "camera.txt", "cam_intrinsics.txt", "depth_intrinsics.txt", "intrinsic/intrinsic_depth.txt",
)  # fmt: skip
YAML_NAMES = ("camera.yaml", "camera.yml", "calibration.yaml", "calibration.yml", "camera_info.yaml", "intrinsics.yaml")
NAMES = (*TEXT_NAMES, *JSON_NAMES, *YAML_NAMES)
"""Names of camera files that are searched for next to the images, in this order."""
KEYS = {
    "fx": ("fx", "fl_x", "focal_x", "focal_length_x"),
    "fy": ("fy", "fl_y", "focal_y", "focal_length_y"),
    "cx": ("cx", "ppx", "principal_x", "principal_point_x"),
    "cy": ("cy", "ppy", "principal_y", "principal_point_y"),
    "width": ("width", "w", "image_width", "imagewidth", "img_width", "m_depthwidth"),
    "height": ("height", "h", "image_height", "imageheight", "img_height", "m_depthheight"),
    "scale": ("depth_scale", "scale", "png_depth_scale", "depthmapfactor", "depth_factor", "depth_map_factor",
              "m_depthshift"),
    "matrix": ("intrinsic_matrix", "camera_matrix", "k", "depth_intrinsics", "intrinsics", "intrinsic",
               "m_calibrationdepthintrinsic"),
}  # fmt: skip
"""Names of each number in tables, in lower case and without the part before a dot (`Camera.fx`)."""


CURES = {
    "[LEFT_CAM": "a ZED's calibration, one for each size; write fx fy cx cy of your images into K.txt, and name it",
    'Intrinsic of "': "of rs-enumerate-devices, for all streams; write Fx Fy PPX PPY of yours into K.txt, and name it",
    '"cameraData"': "an OAK's calibration, one for each camera; write fx fy cx cy of yours into K.txt, and name it",
}
"""What text marks files with several cameras, and what to do."""


class SeveralCamerasError(SourceError):
    """A file of cameras, of which only the user knows which."""


class CameraNumbers(NamedTuple):
    """Numbers of a camera in a file of another program.

    intrinsics: fx, fy, cx, cy in pixels; fy is negative if the image's second axis points up (ICL-NUIM).
    size: (width, height) in pixels, None if the file lacks it. depth_scale: metres per unit of its depth images,
    None if the file lacks it.
    """

    intrinsics: Intrinsics
    size: tuple[int, int] | None = None
    depth_scale: float | None = None


def read_intrinsics(path: Path) -> Intrinsics:
    """Return fx, fy, cx, cy in pixels from a 3x3 or 4x4 matrix or from these four numbers; `#` starts a comment.

    Raises SourceError naming the file for anything else, including skew: such a camera is not a plain pinhole.
    """
    return _of_numbers(path, _numbers(path)).intrinsics


def read_camera_numbers(path: Path) -> CameraNumbers:
    """Read the numbers of a pinhole camera.

    Args:
        path: Text (see `read_intrinsics`; also `width height fx fy cx cy`, `key = value` lines or COLMAP's
            cameras.txt), JSON (Open3D, Replica, nerfstudio) or YAML (ROS camera_info, OpenCV, ORB-SLAM).

    Returns:
        The camera's numbers, and size and depth unit if the file has them.

        Raises:
            SourceError: One line with the file and the problem.
    """
    text = _text(path)
    cure = next((cure for mark, cure in CURES.items() if mark in text), "")
    if cure:
        raise SeveralCamerasError(f"{path}: {cure}: ?camera=K.txt")
    if path.suffix.lower() == ".json":
        return _of_table(path, read_json(path))
    if path.suffix.lower() in (".yaml", ".yml") or text.startswith("header:"):
        from stereovox.sources.calibration.calibration_files import read_yaml

        return _of_table(path, read_yaml(path))
    if "=" in text:
        return _of_table(path, dict(_assignments(text)))
    words = next((line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")), [])
    if len(words) > 4 and words[1].isupper():  # COLMAP: CAMERA_ID MODEL WIDTH HEIGHT PARAMS
        return _of_colmap(path, words)
    return _of_numbers(path, _numbers(path))


def scaled(intrinsics: Sequence[float], x: float, y: float | None = None) -> Intrinsics:
    """Return fx, fy, cx, cy in pixels of images `x` times as wide and `y` times as high (None: as `x`).

    Pixel centres are at whole numbers, so the edge of the first pixel is at -0.5.
    """
    fx, fy, cx, cy = intrinsics
    y = x if y is None else y
    return x * fx, y * fy, x * (cx + 0.5) - 0.5, y * (cy + 0.5) - 0.5


def metres_per_unit(scale: float) -> float:
    """Return metres per unit of a depth scale in either notation: 1000 and 0.001 both mean millimetres."""
    return 1 / scale if scale > 1 else scale


def _of_numbers(path: Path, numbers: Sequence[float]) -> CameraNumbers:
    if len(numbers) == 6:
        width, height, *numbers = numbers
        if not (1 <= width < 1e5 and 1 <= height < 1e5):
            raise SourceError(f"{path}: width {width:g} and height {height:g} are not numbers of pixels; correct them")
        return CameraNumbers(_four(path, numbers), (int(width), int(height)))
    return CameraNumbers(_four(path, numbers))


def _four(path: Path, numbers: Sequence[float]) -> Intrinsics:
    if len(numbers) == 16 and list(numbers[12:]) == [0, 0, 0, 1]:
        numbers = [numbers[k] for k in (0, 1, 2, 4, 5, 6, 8, 9, 10)]
    if len(numbers) == 12 and list(numbers[9:]) == [0, 0, 1]:  # its last line is doubled
        numbers = numbers[:9]
    if len(numbers) == 12 and numbers[3] == numbers[7] == numbers[11] == 0:
        numbers = [numbers[k] for k in (0, 1, 2, 4, 5, 6, 8, 9, 10)]
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return fx, fy, cx, cy
    if len(numbers) == 9 and list(numbers[2:]) != [0, 0, 1] and list(numbers[2:4]) == [0, 0]:  # column by column
        numbers = [numbers[k] for k in (0, 3, 6, 1, 4, 7, 2, 5, 8)]
    if len(numbers) == 9 and list(numbers[6:]) == [0, 0, 1] and numbers[1] == numbers[3] == 0:
        fx, _, cx, _, fy, cy, *_ = numbers
        return fx, fy, cx, cy
    raise SourceError(f"{path}: needs {FORMS}")


def _of_table(path: Path, table: Any) -> CameraNumbers:
    found = dict(reversed(list(_leaves(table))))  # the first of several cameras

    def value(name: str) -> Any:
        return next((found[key] for key in KEYS[name] if key in found), None)

    roi, binned = table.get("roi") if isinstance(table, dict) else None, found.get("binning_x")
    if (isinstance(binned, int) and binned > 1) or (isinstance(roi, dict) and roi.get("width")):
        raise SeveralCamerasError(
            f"{path}: of binned or cut images; write fx fy cx cy of your images into K.txt instead"
        )
    four = [value(name) for name in ("fx", "fy", "cx", "cy")]
    size = value("width"), value("height")
    if not all(map(is_number, four)):
        matrix = value("matrix")
        if not isinstance(matrix, list):
            raise SourceError(f"{path}: has no fx, fy, cx, cy; give the camera's own file, or {FORMS}")
        four = list(_four(path, matrix))
    if not all(map(math.isfinite, four)):
        raise SourceError(f"{path}: holds NaN or infinity; write plain numbers")
    fx, fy, cx, cy = map(float, four)
    scale = value("scale")
    whole = all(is_number(n) and 0 < n < 1e5 for n in size)
    return CameraNumbers(
        (fx, fy, cx, cy),
        (int(size[0]), int(size[1])) if whole else None,
        metres_per_unit(float(scale)) if is_number(scale) and scale > 0 else None,
    )


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """Yield names and values of a nested table; a list of numbers, or of lists of them, is one value."""
    if isinstance(value, dict):
        if is_number(value.get("rows")) and isinstance(value.get("data"), list):  # a matrix of ROS or OpenCV
            yield key, value["data"]
        for name, inner in value.items():
            yield from _leaves(inner, str(name).lower().rpartition(".")[2])
    elif isinstance(value, list):
        flat = [number for row in value for number in (row if isinstance(row, list) else [row])]
        if flat and all(map(is_number, flat)):
            yield key, flat
        elif value and isinstance(value[0], dict):
            yield from _leaves(value[0], key)
    else:
        yield key, value


def _of_colmap(path: Path, words: Sequence[str]) -> CameraNumbers:
    try:
        model, size = words[1], (int(words[2]), int(words[3]))
        numbers = [float(word) for word in words[4:]]
    except ValueError as error:
        raise SourceError(f"{path}: {error}; write plain numbers") from None
    if not all(0 < pixels < 100_000 for pixels in size):
        raise SourceError(f"{path}: {size[0]}x{size[1]} pixels; write the size of its images")
    if model == "SIMPLE_PINHOLE" and len(numbers) == 3:
        numbers.insert(0, numbers[0])
    if model not in ("PINHOLE", "SIMPLE_PINHOLE"):
        raise SourceError(f"{path}: a {model} camera; undistort its images first, as with COLMAP's image_undistorter")
    return CameraNumbers(_four(path, numbers), size)


def _assignments(text: str) -> Iterator[tuple[str, Any]]:
    """Yield the names and numbers of lines `key = 1 2 3`; lines with other words are skipped."""
    for line in text.splitlines():
        key, equals, rest = line.partition("=")
        try:
            numbers = [float(word) for word in rest.replace(",", " ").split()]
        except ValueError:
            continue
        if equals and numbers:
            yield key.strip(), numbers if len(numbers) > 1 else numbers[0]


def _text(path: Path) -> str:
    try:
        return read_text(path, MAX_LIST)
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    except ValueError as error:
        raise SourceError(f"{path}: {error}; write plain numbers") from None


def _numbers(path: Path) -> list[float]:
    try:
        lines = _text(path).splitlines()
        numbers = [float(word) for line in lines for word in line.partition("#")[0].replace(",", " ").split()]
    except SourceError:
        raise
    except ValueError as error:
        raise SourceError(f"{path}: {error}; write plain numbers") from None
    if not all(map(math.isfinite, numbers)):
        raise SourceError(f"{path}: holds NaN or infinity; write plain numbers")
    return numbers
