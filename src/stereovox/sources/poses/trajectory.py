# SPDX-License-Identifier: Apache-2.0
"""Poses over time from text files of the TUM format, and the stamped lines of its other files."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path, PurePath

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_LIST, read_text, replacing
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.poses import seconds_from_ns as seconds_from_ns

LIMIT = 9_223_372_036
"""Seconds whose nanoseconds still fit into int64."""
MILLISECOND_DIGITS = 12
"""Fewest digits of a date in milliseconds."""
TRAJECTORY_ENDINGS = (".tum", ".txt")
FORMAT = "stamp tx ty tz qx qy qz qw"
StampedLine = tuple[int, str, str]
"""Time in nanoseconds, the rest of the line, and `file:line` for messages."""


class Trajectory(Poses):
    """Poses in a file of lines `stamp tx ty tz qx qy qz qw`: seconds, metres, quaternion of any length but zero.

    Lines may be in any order; of several with one stamp the first counts. A line that has a stamp but no usable pose
    is kept as unusable, and frames that need it are refused.
    Raises SourceError with file and line if a stamp is unreadable, or if there is no line at all.
    """

    def __init__(self, path: Path):
        lines = pose_lines(path, FORMAT)
        numbers, faults = pose_numbers(lines, 7, FORMAT)
        super().__init__([line[0] for line in lines], transforms(numbers), where=str(path), faults=faults)


def write_trajectory(path: str | Path, stamps_ns: Sequence[int], poses: NDArray[np.float64], whose: str) -> None:
    """Write poses (N, 4, 4) as lines of the TUM format, all or nothing; whose: the posed body, for the first line.

    Raises MapFileError if the file cannot be written; an older one is then left intact.
    """
    from scipy.spatial.transform import Rotation

    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat(canonical=True)
    with replacing(path) as file:
        file.write(f"# stamp tx ty tz qx qy qz qw: {whose}\n".encode())
        for stamp_ns, place, quaternion in zip(stamps_ns, poses[:, :3, 3], quaternions, strict=True):
            numbers = [*(f"{x:.6f}" for x in place), *(f"{q:.9f}" for q in quaternion)]
            file.write(f"{seconds_from_ns(stamp_ns)} {' '.join(numbers)}\n".encode())


def pose_lines(path: Path, wanted: str) -> list[StampedLine]:
    """Return the lines of a file of poses in order of time; raises SourceError if missing or a stamp is
    missing."""
    lines = sorted(stamped_lines(path), key=lambda line: line[0])
    if not lines:
        raise SourceError(f"{path}: holds no pose; write lines '{wanted}'")
    return lines


def pose_numbers(lines: Sequence[StampedLine], count: int, wanted: str) -> tuple[NDArray[np.float64], dict[int, str]]:
    """Return the (N, count) numbers of the lines, NaN for unusable lines, and the faults by stamp."""
    rows, faults = np.full((len(lines), count), np.nan), {}
    for row, (stamp_ns, rest, where) in zip(rows, lines, strict=True):
        try:
            row[:] = _numbers(rest, count, wanted)
        except ValueError as error:
            faults.setdefault(stamp_ns, f"{where}: {error}; correct or delete the line")
    return rows, faults


def transforms(numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (N, 4, 4) motions of (N, 7) numbers tx ty tz qx qy qz qw; NaN stays NaN."""
    x, y, z, w = (numbers[:, 3:7] / np.linalg.norm(numbers[:, 3:7], axis=1, keepdims=True)).T
    T = np.zeros((len(numbers), 4, 4))
    T[:, 3, 3] = 1
    T[:, :3, 3] = numbers[:, :3]
    T[:, :3, 0] = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], 1)
    T[:, :3, 1] = np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], 1)
    T[:, :3, 2] = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], 1)
    return T


def _numbers(text: str, count: int, wanted: str) -> list[float]:
    numbers = [float(word) for word in text.split()]
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(f"needs '{wanted}'")
    if math.hypot(*numbers[3:7]) < 1e-6:
        raise ValueError("quaternion of length zero")
    return numbers


def stamped_lines(path: Path) -> list[StampedLine]:
    """Return the lines of `path` that start with a time in seconds, in file order, without comments and empty lines.

    Commas and tabs count as spaces. Raises SourceError naming file and line.
    """
    try:
        text = read_text(path, MAX_LIST, "replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; give a readable file") from None
    lines = [(n, line) for n, line in enumerate(map(_plain, text.splitlines()), 1) if line]
    whole = [len(word) for _, line in lines if (word := line.split()[0].lstrip("+-")).isdigit()]
    digits = max(whole, default=0) if len(whole) == len(lines) else 0
    return [_parse(line, f"{path}:{n}", digits) for n, line in lines]


def inside(name: str, where: str) -> str:
    """Return the file name in a line of a list; raises SourceError if it leads out of the folder."""
    if os.path.isabs(name) or ".." in PurePath(name).parts or "\0" in name:
        raise SourceError(f"{where}: '{name}' leads out of the recording's folder; put the file there and name it so")
    return name


def by_time(lines: Iterable[StampedLine]) -> list[StampedLine]:
    """Return the lines sorted by time, with only the first of those with the same stamp."""
    first: dict[int, StampedLine] = {}
    for line in lines:
        first.setdefault(line[0], line)
    return [first[stamp_ns] for stamp_ns in sorted(first)]


def ns_from_seconds(text: str) -> int:
    """Return the exact nanoseconds of a decimal number of seconds; digits beyond the ninth are rounded.

    A float would be off by up to 120 ns for today's dates. Raises ValueError if it is not a number or too large for
    int64.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"'{text}' is not a time in seconds") from None
    if not (seconds.is_finite() and -LIMIT < seconds < LIMIT):  # abs() may overflow
        raise ValueError(f"'{text}' is not a time in seconds")
    return round(seconds * 1_000_000_000)


def ns_from_stamp(text: str, longest: int = 0) -> int:
    """Return the nanoseconds of a time in seconds, or, if the number is too large for a date in seconds, in
    milliseconds, microseconds or nanoseconds: dates from 1973 to 5138 have 12 to 14, 15 to 17, and more digits.

    longest: digits of the longest time of the file, if all are whole numbers: they have one unit. Of 11 digits they are
    nanoseconds since the start. Raises ValueError as `ns_from_seconds`.
    """
    digits = longest or len(text.lstrip("+-").partition(".")[0])
    if longest == MILLISECOND_DIGITS - 1:
        return int(text)
    if digits < MILLISECOND_DIGITS or not text.lstrip("+-").replace(".", "", 1).isdigit():
        return ns_from_seconds(text)
    number = Decimal(text)
    found = round(number * (1_000_000, 1000, 1)[min((digits - MILLISECOND_DIGITS) // 3, 2)])
    if abs(found) >= LIMIT * 1_000_000_000:
        raise ValueError(f"'{text[:40]}' is not a time")
    return found


def _plain(line: str) -> str:
    return line.partition("#")[0].replace(",", " ").strip()


def _parse(line: str, where: str, digits: int = 0) -> StampedLine:
    stamp, *rest = line.split(maxsplit=1)
    try:
        return ns_from_stamp(stamp, digits), "".join(rest), where
    except ValueError as error:
        raise SourceError(f"{where}: {error}; correct or delete the line") from None
