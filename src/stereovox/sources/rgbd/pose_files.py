# SPDX-License-Identifier: Apache-2.0
"""Poses from files in any of the usual forms: one for each image, or over time.

| form | lines | who writes it |
|---|---|---|
| TUM | `stamp tx ty tz qx qy qz qw` | TUM RGB-D, ORB-SLAM, evo, most SLAM programs |
| KITTI | 12 numbers, a 3x4 matrix row by row | KITTI, kiss-icp |
| matrices | 16 numbers a line, or 4x4 matrices below each other | Replica, NICE-SLAM |
| without times | `tx ty tz qx qy qz qw` | slambook, TartanAir |
| 3x4 below each other | three lines of four numbers for each | SUN3D |
| log | `i i i`, then a 4x4 matrix | Redwood, Open3D |
| JSON | a PinholeCameraTrajectory (world to camera, which is inverted) | Open3D |
| NumPy | `.npy` of (N, 4, 4), (N, 16), (N, 12) or (N, 7) numbers | scripts |
| named columns | a heading with a time or number, positions, quaternions | EuRoC, AirSim, `rostopic -p`, OpenVINS |
| VINS | `stamp tx ty tz qw qx qy qz vx vy vz`, or without `v` if each line ends with a comma | VINS-Mono, VINS-Fusion |
| numbered | a number or a time in nanoseconds, then 12 or 16 numbers | KITTI-360, MulRan |
| split time | `sec nsec tx ty tz qx qy qz qw` | Newer College |
| ARKit | `.traj` of `stamp rx ry rz tx ty tz`, world to camera (inverted) | ARKitScenes |
| g2o | `VERTEX_SE3:QUAT id tx ty tz qx qy qz qw`, in the order of the ids | pose graphs |
| a folder | a file for each image, with 16 or 12 numbers or `tx ty tz qx qy qz qw` | ScanNet, 7-Scenes |

All are T_world_camera (camera to world) in metres, unless the options of a folder (`axes`, `invert`) differ. Times are
in seconds, or, if they have more digits than a date in seconds, in milliseconds, microseconds or nanoseconds. Numbers
that are no rotations are refused.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError
from stereovox.files.safe_io import MAX_LIST, is_number, read_bounded, read_json, read_text
from stereovox.geometry.se3 import Transform, from_quaternion, inverse
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.tracker import AXES
from stereovox.sources.poses.trajectory import MILLISECOND_DIGITS, Trajectory, ns_from_stamp, transforms

FORMS = "TUM lines 'stamp tx ty tz qx qy qz qw', KITTI's 12 numbers a line, 4x4 matrices, or Open3D's .log"
MIRROR_CAMERA, MIRROR_WORLD = np.diag([1.0, -1, 1, 1]), np.diag([1.0, 1, -1, 1])
"""Turn left-handed poses into right-handed ones, see `in_other_hand`."""
SECOND = 1_000_000_000
POSE_COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")
UNITS_NS = {"ns": 1, "nsec": 1, "us": 1000, "ms": 1_000_000}
NUMBERS = {"frame", "id", "index", "image", "number", "idx"}
NOT_PLACES = ("vel", "lin", "ang", "twist", "acc", "cov", "gyro", "bias", "omega")
"""Begins of names of columns that hold other vectors than positions."""
TURNS = ("q", "roll", "pitch", "yaw", "heading", "orient", "rot")
"""Begins of names of columns that rotate."""
G2O, OTHER_GRAPH, MAX_HEADING = "VERTEX_SE3:QUAT", ("VERTEX", "EDGE"), 20
"""Begins of a pose of a graph, and of other graphs' lines; lines in which a heading is searched for."""
LARGEST_CONFIDENCE, NOT_A_TURN = 100, 0.1
"""Largest confidence of a tracker in any unit; by how much the entries of R^T R may differ from those of the unit
matrix, and lengths of quaternions from their median, in most poses of a file."""
WRITE = "write tx ty tz qx qy qz qw"
MAX_NUMBER = 10_000_000
"""Whole stamps in seconds below this may be image numbers; times since 1970 are larger."""


class UnknownRotationError(SourceError):
    """Poses whose rotation is in a form that is not read."""


class ImagePoses:
    """Poses of a camera, one for each image, in order.

    Args:
            T_world_camera: For each image (4, 4) in metres, or its fault in one line, or None without a pose.
            where: Origin of the poses, for messages.
            numbers: The image number of each pose; None if they only have an order.

        Raises:
            SourceError: No image has a pose.
    """

    def __init__(self, T_world_camera: Sequence[Transform | str | None], where: str, numbers: list[int] | None = None):
        if all(T is None or isinstance(T, str) for T in T_world_camera):
            why = T_world_camera[0] if T_world_camera else "it is empty"
            raise SourceError(f"{where}: holds no usable pose ({why}); write {FORMS}")
        self._poses = list(T_world_camera)
        self.where, self.numbers = where, numbers

    def __len__(self) -> int:
        return len(self._poses)

    def at(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) of image `i`; raises FrameRefused `no_pose` or `bad_pose_file`."""
        found = self._poses[i] if 0 <= i < len(self._poses) else None
        if found is None:
            raise FrameRefused("no_pose", f"{self.where}: has no pose for image {i}; leave it out or add one")
        if isinstance(found, str):
            raise FrameRefused("bad_pose_file", found)
        return found.copy()

    def of(self, numbers: Sequence[int]) -> ImagePoses:
        """Return the poses of images with these numbers, by the poses' own numbers; raises SourceError without any."""
        known = dict(zip(self.numbers or range(len(self)), self._poses, strict=True))
        return ImagePoses([known.get(number) for number in numbers], self.where)


def read_poses(path: Path) -> Poses | ImagePoses:
    """Read a file or folder of poses.

    Args:
        path: File in one of the forms above, or a folder of files, in the order of the numbers in their names.

    Returns:
        `Poses` over time for the TUM form, else `ImagePoses`.

    Raises:
        SourceError: It is unreadable, of an unknown form, or has no usable pose.
    """
    if os.path.isdir(path):
        return read_pose_folder(path)
    if path.suffix.lower() in (".json", ".npy"):
        return _of_json(path) if path.suffix.lower() == ".json" else _of_numpy(path)
    if (found := _by_names(path)) is not None:
        return found
    rows, heading = _rows(path)
    widths = {len(row) for row in rows}
    if heading and not widths <= {3, 4, 12, 13, 16, 17}:  # matrices show what they are
        raise SourceError(f"{path}:1: its heading names no position and quaternion (tx ty tz qx qy qz qw); name them")
    if (
        widths == {9}
        and all(row[1] == int(row[1]) and 0 <= row[1] < SECOND for row in rows)
        and any(row[1] > LARGEST_CONFIDENCE for row in rows)
    ):
        return _over_time(path, [(int(row[0]) * SECOND + int(row[1]), row[2:]) for row in rows])
    if widths == {11} or (widths == {8} and _ends_with_commas(path)):
        return _over_time(
            path, [(ns_from_stamp(words[0]), _numbers(words[1:4] + words[5:8] + words[4:5])) for words in _words(path)]
        )
    if widths == {20}:  # OpenVINS without its heading
        return _over_time(path, [(ns_from_stamp(words[0]), _numbers(words[1:8])) for words in _words(path)])
    if widths and widths <= {8, 9}:  # the ninth: a tracker's confidence
        _check_quaternions(path, np.array([row[4:8] for row in rows]))
        return Trajectory(path)
    if widths in ({13}, {17}):
        return _numbered(path)
    if widths == {7} and path.suffix.lower() == ".traj":
        found = [(ns_from_stamp(words[0]), _numbers(words[1:])) for words in _words(path)]
        return _over_time(path, [(stamp, _of_rotation_vector(numbers)) for stamp, numbers in found])
    if widths == {7}:
        _check_quaternions(path, np.array([row[3:] for row in rows]))
    if widths in ({7}, {12}, {16}):
        return _in_order(path, rows)
    if widths and widths <= {3, 4} and len(rows) % 5 == 0 and all(len(row) == 3 for row in rows[::5]):
        return _stacked(path, [rows[k + 1 : k + 5] for k in range(0, len(rows), 5)])
    if widths == {4} and len(rows) % 4 == 0 and all(row == [0, 0, 0, 1] for row in rows[3::4]):
        return _stacked(path, [rows[k : k + 4] for k in range(0, len(rows), 4)])
    if widths == {4} and len(rows) % 3 == 0:
        return _stacked(path, [rows[k : k + 3] for k in range(0, len(rows), 3)])
    many = ", ".join(map(str, sorted(widths)[:5])) or "no"
    raise SourceError(f"{path}: its lines have {many} numbers, which fits no form of poses; write {FORMS}")


def _by_names(path: Path) -> Poses | ImagePoses | None:
    """Return the poses of a file whose columns have names, or of a g2o graph; None for any other."""
    try:
        lines = read_text(path, MAX_LIST, "replace").splitlines()
    except OSError:
        return None  # reported by `_rows`
    if any(line.startswith(OTHER_GRAPH) for line in lines):
        return _of_graph(path, [line.split() for line in lines if line.startswith(G2O)])
    for heading in lines[:MAX_HEADING]:
        names = [_name(word) for word in _split(heading.lstrip("#% "))]
        columns = {key: k for k, name in reversed(list(enumerate(names))) if (key := _meaning(name))}
        timed = bool(columns.keys() & {"time", "sec"})
        if (timed or "number" in columns) and columns.keys() >= set(POSE_COLUMNS[:3]):
            break
    else:
        return None
    if not columns.keys() >= set(POSE_COLUMNS):
        kind = UnknownRotationError if any(part.startswith(TURNS) for name in names for part in name) else SourceError
        raise kind(f"{path}: its heading names positions but no quaternion; {WRITE} and name the columns so")
    if heading.startswith("#") and [columns.get(key) for key in ("time", *POSE_COLUMNS)] == list(range(len(names))):
        return None  # TUM's own
    found, numbers = list[tuple[int, list[float]]](), list[int]()
    for n, line in enumerate(lines, 1):
        words = _split(line)
        if line == heading or not words or line.lstrip().startswith(("#", "%")):
            continue
        try:
            row = [float(words[columns[key]]) for key in POSE_COLUMNS]
            found.append((_stamp_of(words, columns, names) if timed else n, row))
            numbers.append(0 if timed else int(words[columns["number"]]))
        except (ValueError, IndexError):
            raise SourceError(f"{path}:{n}: a column of the heading is missing or no number; correct it") from None
    return _over_time(path, found) if timed else _in_order(path, [row for _, row in found], numbers)


def _of_graph(path: Path, vertices: Sequence[list[str]]) -> ImagePoses:
    """Return the poses of a g2o graph in the order of their ids; programs write them in any order."""
    if not vertices:
        raise SourceError(f"{path}: is a graph without '{G2O} id tx ty tz qx qy qz qw'; write these, or TUM lines")
    short = next((words for words in vertices if len(words) != 9), None)
    if short is not None:  # left out, it would shift the poses of all images after it
        raise SourceError(f"{path}: '{' '.join(short[:3])} ...' is not '{G2O} id' and seven numbers; correct it")
    try:
        rows = dict(sorted((int(words[1]), _numbers(words[2:])) for words in vertices))
    except ValueError as error:
        raise SourceError(f"{path}: {error}; correct the vertex") from None
    if len(rows) < len(vertices):
        raise SourceError(f"{path}: two vertices have one id; write each once")
    return _in_order(path, list(rows.values()))


def _split(line: str) -> list[str]:
    if re.search(r"[,;\t]", line):
        return [word.strip() for word in re.split(r"[,;\t]", line)]
    return line.split()


def _name(word: str) -> tuple[str, ...]:
    """Return the parts of a column's name: `p_RS_R_x [m]` has p, rs, r, x, m in brackets last."""
    return tuple(re.findall(r"[a-z]+|\[.*?\]|\(.*?\)", word.lower()))


def _meaning(name: tuple[str, ...]) -> str:
    """Return what a column is: `time`, `sec`, `nsec`, `number`, or one of `POSE_COLUMNS`; "" for others."""
    parts = [part for part in name if part[0] not in "[("]
    *context, last = parts or [""]
    if context[-2:] == ["field", "header"] and last == "stamp":
        return "time of header"
    if last in ("timestamp", "time", "stamp", "t") or "timestamp" in context or context[:1] == ["time"]:
        return "time"
    if last in ("sec", "secs", "nsec", "nsecs"):
        return last.rstrip("s")
    if not context and last in NUMBERS:
        return "number"
    if parts[0:1] != [last] and parts[0:1] and parts[0] in POSE_COLUMNS:  # Aria: tx_world_device
        return parts[0]
    turns = last[0:1] == "q" or any(part.startswith(("q", "orient", "rot")) for part in context)
    if turns and last.lstrip("q") in ("x", "y", "z", "w"):
        return f"q{last.lstrip('q')}"
    others = context[:1] in (["v"], ["b"], ["a"], ["w"]) or any(part.startswith(NOT_PLACES) for part in context)
    place = last[1:] if last[:1] in ("t", "p") else last
    return f"t{place}" if place in ("x", "y", "z") and not others else ""


def _stamp_of(words: list[str], columns: dict[str, int], names: list[tuple[str, ...]]) -> int:
    """Return the time of a row in nanoseconds: its unit is in the heading, else by its digits.

    A header's stamp precedes the time at which the message arrived.
    """
    if "sec" in columns and "nsec" in columns:
        return int(words[columns["sec"]]) * SECOND + int(words[columns["nsec"]])
    column = columns.get("time of header", columns.get("time", columns.get("sec", 0)))
    unit = next((part.strip("[]()") for part in names[column] if part[0] in "[("), names[column][-1])
    text = words[column]
    if unit in UNITS_NS and text.lstrip("-").isdigit():
        return int(text) * UNITS_NS[unit]
    return ns_from_stamp(text)


def _words(path: Path) -> list[list[str]]:
    """Return the words of all lines that begin with a number."""
    lines = (_plain(line) for line in read_text(path, MAX_LIST, "replace").splitlines())
    return [words for words in lines if words and not re.match("[a-zA-Z]", words[0])]


def _ends_with_commas(path: Path) -> bool:
    """Return whether all lines with numbers end with a comma, as VINS writes them; nobody writes the TUM form so."""
    lines = [line.partition("#")[0].strip() for line in read_text(path, MAX_LIST, "replace").splitlines()]
    return all(line.endswith(",") for line in lines if line)


def _numbers(words: Sequence[str]) -> list[float]:
    return [float(word) for word in words]


def _over_time(path: Path, found: Sequence[tuple[int, Sequence[float]]]) -> Poses:
    """Return poses over time of stamps and `tx ty tz qx qy qz qw`."""
    if not found:
        raise SourceError(f"{path}: holds no pose; write {FORMS}")
    rows = np.array([row for _, row in found], float)
    _check_quaternions(path, rows[:, 3:])
    bad = ~np.isfinite(rows).all(axis=1) | (np.linalg.norm(rows[:, 3:], axis=1) < 1e-6)
    rows[bad] = np.nan
    with np.errstate(invalid="ignore"):
        return Poses([stamp_ns for stamp_ns, _ in found], transforms(rows), where=str(path))


def _check_quaternions(path: Path, found: NDArray[np.float64]) -> None:
    """Raise SourceError if most of (N, 4) numbers differ so much in length that they are no quaternions."""
    length = np.linalg.norm(found, axis=1)
    length = length[np.isfinite(length) & (length > 0)]
    if len(length) and np.mean(np.abs(length / np.median(length) - 1) < NOT_A_TURN) <= 1 / 2:
        raise SourceError(f"{path}: its columns hold no quaternions; {WRITE}, or name the columns in a heading")


def _in_order(path: Path, rows: Sequence[Sequence[float]], numbers: list[int] | None = None) -> ImagePoses:
    """Return the poses of rows of numbers; raises SourceError if most matrices are no rotations."""
    poses = [_matrix(row, f"{path}:{n}") for n, row in enumerate(rows, 1)]
    R = np.array([T[:3, :3] for T in poses if not isinstance(T, str) and np.isfinite(T).all()]).reshape(-1, 3, 3)
    with np.errstate(all="ignore"):
        off = np.abs(R.transpose(0, 2, 1) @ R - np.eye(3)).max(axis=(1, 2))
    if len(off) and np.mean(off < NOT_A_TURN) <= 1 / 2:
        raise SourceError(f"{path}: its numbers are no poses: their 3x3 parts do not rotate; write {FORMS}")
    return ImagePoses(poses, str(path), numbers)


def _numbered(path: Path) -> Poses | ImagePoses:
    """Return the poses of lines of a number, or a time of many digits, and a matrix."""
    words = _words(path)
    poses = _in_order(path, [_numbers(row[1:]) for row in words], [int(float(row[0])) for row in words])
    if all(row[0].isdigit() and len(row[0]) >= MILLISECOND_DIGITS for row in words):
        return Poses([ns_from_stamp(row[0]) for row in words], np.array([poses.at(k) for k in range(len(words))]),
                     where=str(path))  # fmt: skip
    return poses


def _of_rotation_vector(numbers: Sequence[float]) -> list[float]:
    """Return tx ty tz qx qy qz qw of a camera from its rotation vector and translation, world to camera."""
    from scipy.spatial.transform import Rotation

    R = Rotation.from_rotvec(numbers[:3]).inv()
    return [*(-R.apply(numbers[3:])), *R.as_quat()]


def read_pose(path: Path) -> Transform:
    """Return the one pose (4, 4) in a file of 16 or 12 numbers, or `tx ty tz qx qy qz qw`; raises FrameRefused."""
    try:
        numbers = [float(word) for word in _plain(read_text(path))]
    except FileNotFoundError:
        raise FrameRefused("no_pose", f"{path}: no such file; put it back or remove the image") from None
    except OSError as error:
        raise FrameRefused("bad_pose_file", f"{path}: {error.strerror}; make it readable") from None
    except ValueError as error:
        raise FrameRefused("bad_pose_file", f"{path}: {error}; write a 4x4 matrix of plain numbers") from None
    found = _matrix(numbers, str(path))
    if isinstance(found, str):
        raise FrameRefused("bad_pose_file", found)
    return found


def in_optical_axes(T: Transform, axes: str, inverted: bool) -> Transform:
    """Return T_world_camera (4, 4) in optical axes from the pose of a camera in `axes`; the world stays the same.

    inverted: `T` is T_camera_world. axes: a key of `AXES`.
    """
    C = np.eye(4)
    C[:3, :3] = AXES[axes].T
    return (inverse(T) if inverted else T) @ C


def in_other_hand(T: Transform) -> Transform:
    """Return the pose (4, 4) of a camera whose second axis points up, a left-handed frame, as a rigid one in optical
    axes. The image itself is right, so the world is mirrored along its third axis.
    """
    return MIRROR_WORLD @ T @ MIRROR_CAMERA


def number_in(name: str) -> tuple[int, str]:
    """Return the last number in a file name, by which files are ordered, and the name; -1 if missing."""
    found = re.findall(r"\d+", name.rpartition(".")[0] or name)
    return (int(found[-1]) if found else -1), name


def image_numbers(poses: Poses | ImagePoses) -> list[int] | None:
    """Return the image numbers of poses, None if they have none.

    Stamps of whole seconds that are too small for a date are numbers (ICL-NUIM).
    """
    if isinstance(poses, ImagePoses):
        return poses.numbers
    stamps = poses.stamps_ns
    if np.any(stamps % SECOND) or stamps[0] < 0 or stamps[-1] >= MAX_NUMBER * SECOND:
        return None
    return (stamps // SECOND).tolist()


def in_order(poses: Poses) -> ImagePoses:
    """Return poses over time as poses of images, in order of their times."""
    faults = [None if np.isfinite(T).all() else f"{poses.where}: a pose is unusable" for T in poses.T_world_body]
    found = [T if fault is None else fault for T, fault in zip(poses.T_world_body, faults, strict=True)]
    return ImagePoses(found, poses.where, image_numbers(poses))


def read_pose_folder(path: Path, pattern: str = r".*\.(txt|pose)") -> ImagePoses:
    """Read a folder with one file per pose, named by a regular expression; raises SourceError."""
    try:
        names = [name for name in os.listdir(path) if re.fullmatch(pattern, name, re.IGNORECASE)]
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a readable folder") from None
    if not names:
        raise SourceError(f"{path}: holds no .txt with a pose; write one file with a 4x4 matrix for each image")
    found: list[Transform | str | None] = []
    names.sort(key=number_in)
    for name in names:
        try:
            found.append(read_pose(path / name))
        except FrameRefused as refused:
            found.append(str(refused))
    numbers = [number_in(name)[0] for name in names]
    unique = len(set(numbers)) == len(numbers) and numbers[0] >= 0
    return ImagePoses(found, str(path), numbers if unique else None)


def _of_json(path: Path) -> ImagePoses:
    """Return the poses of Open3D's PinholeCameraTrajectory; matrices are column by column, world to camera."""
    table = read_json(path)
    cameras = table.get("parameters") if isinstance(table, dict) else None
    matrices = [_extrinsic(camera) for camera in cameras] if isinstance(cameras, list) else []
    if not matrices or not all(matrices):
        raise SourceError(f"{path}: not a PinholeCameraTrajectory with an extrinsic for each image; write {FORMS}")
    return ImagePoses([_inverted(np.reshape(matrix, (4, 4)).T, str(path)) for matrix in matrices], str(path))


def _extrinsic(camera: object) -> list[float]:
    """Return the 16 numbers of a camera's extrinsic; empty if it has none."""
    found = camera.get("extrinsic") if isinstance(camera, dict) else None
    if not isinstance(found, list) or len(found) != 16 or not all(map(is_number, found)):
        return []
    return [float(number) for number in found]


def _inverted(T: Transform, where: str) -> Transform | str:
    return inverse(T) if np.isfinite(T).all() else f"{where}: a pose holds NaN or infinity; remove its image"


def _of_numpy(path: Path) -> ImagePoses:
    try:
        with np.errstate(all="ignore"):  # a damaged shape
            numbers = np.load(io.BytesIO(read_bounded(path, MAX_LIST)), allow_pickle=False)
        rows = np.asarray(numbers, float).reshape(len(numbers), -1)
    except Exception as error:  # a damaged file can raise anything in NumPy
        why = " ".join(str(error).split())[:100]
        raise SourceError(f"{path}: not an array of poses ({why}); save one of (N, 4, 4) numbers") from None
    return ImagePoses([_matrix(row, f"{path}, pose {n}") for n, row in enumerate(rows.tolist())], str(path))


def _rows(path: Path) -> tuple[list[list[float]], bool]:
    """Return the numbers of all lines, and whether the first is a heading; raises SourceError with the line for
    anything else.
    """
    try:
        lines = read_text(path, MAX_LIST, "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a file of poses: {FORMS}") from None
    rows, heading = [], False
    for n, line in enumerate(lines, 1):
        try:
            rows.append([float(word) for word in _plain(line)])
        except ValueError as error:
            if n > 1:
                raise SourceError(f"{path}:{n}: {error}; correct or delete the line") from None
            heading = True
    return [row for row in rows if row], heading


def _plain(text: str) -> list[str]:
    return " ".join(line.partition("#")[0] for line in text.splitlines()).replace(",", " ").split()


def _stacked(path: Path, blocks: list[list[list[float]]]) -> ImagePoses:
    flat = [[number for row in block for number in row] for block in blocks]
    return _in_order(path, flat)


def _matrix(numbers: Sequence[float], where: str) -> Transform | str:
    """Return the pose in 16, 12 or 7 numbers, or the fault of their form; the gate checks the rest."""
    if len(numbers) == 7:
        if not any(numbers[3:]):
            return f"{where}: a quaternion of length zero; correct it"
        return from_quaternion(numbers[:3], numbers[3:])
    if len(numbers) not in (12, 16):
        return f"{where}: holds {len(numbers)} numbers; write a 4x4 matrix"
    T = np.eye(4)
    T[: len(numbers) // 4] = np.reshape(numbers, (-1, 4))
    return T
