# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: a robot's lidar and odometry as lines of text (`.clf`, `.log`, each also as `.bz2`)."""

from __future__ import annotations

import bz2
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError
from stereovox.frame import Frame, Scan
from stereovox.geometry import se2
from stereovox.geometry.se2 import lifted
from stereovox.sources import parameters
from stereovox.sources.bags.scans import spike_of
from stereovox.sources.poses.poses import Poses

LASERS = {b"FLASER": 100.0, b"ROBOTLASER1": 100.0}
"""Line types with a scan of the front laser, and the largest distance in metres of its mount from the robot."""
NO_ECHO = (50.0, 81.9)
MAX_DISTANCE = 1e6
"""Limit in metres for the robot's distance from the world's origin."""
MAX_BEAMS = 100_000
ENDINGS = (".clf", ".log", ".clf.bz2", ".log.bz2")
MAX_LINE_BYTES = 1 << 20
"""Bytes of the longest accepted line."""
ALWAYS_ALLOWED, MAX_RATIO = 1 << 18, 100
"""Decompressed bytes that are always accepted, and most per compressed byte; text compresses to a tenth."""
NO_ECHO_VALUES = {"unknown": np.nan, "free": np.inf}
OFFSETS = {"robot_frontlaser_offset", "robot_front_laser_offset", "frontlaser_offset"}


class CarmenLog:
    """Scans (FLASER, ROBOTLASER1) of a CARMEN log, with the robot's raw odometry as poses.

    The mount is PARAM robot_frontlaser_offset (metres forward), in ROBOTLASER1 the difference of its two poses. Stamps
    are `ipc_timestamp`, as used in `.relations` files. Invalid lines are left out, counted and
    named in `notes`. `frames` is empty, `truth` unknown.
    Raises SourceError if the file cannot be read or holds no scan.
    """

    def __init__(self, where: str):
        location, given = parameters.split(where)
        options = Options(**parameters.typed(given, parameters.defaults(Options)))
        path = Path(location)
        self.name = path.name.partition(".")[0]
        self.damaged: list[str] = []
        found = _readings(path, self.damaged)
        self._readings = sorted(found, key=lambda reading: reading.stamp_ns)
        if not self._readings:
            raise SourceError(f"{path}: holds no scan (FLASER or ROBOTLASER1 line)")
        self._max_range = options.max_range or _no_echo(self._readings, self._readings[0].max_range)
        self.notes = tuple(_notes(path, self.damaged, self._max_range, options.no_echo))
        self.scans: Sequence[Scan] = _Scans(self._readings, self._max_range, NO_ECHO_VALUES[options.no_echo])
        self.frames: Sequence[Frame] = ()
        self.truth: Poses | None = None

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether the name has an ending of a CARMEN log."""
        return str(where).partition("?")[0].lower().endswith(ENDINGS)


@dataclass(frozen=True)
class Options:
    """Options after the file's name, as in `aces.clf.bz2?max_range=40`.

    max_range: metres from which a range means "no echo"; 0: the file's, else found from its ranges: the smaller
        of 50 m and 81.9 m (a SICK's "no echo") that the log uses.
    no_echo: meaning of that: `unknown`, since black and dazzling objects give no echo either, or `free` up to there.
    """

    max_range: float = 0.0
    no_echo: str = "unknown"

    def __post_init__(self) -> None:
        if self.max_range < 0:
            raise SourceError(f"max_range={self.max_range:g} must be a positive number")
        if self.no_echo not in NO_ECHO_VALUES:
            raise SourceError(f"no_echo={self.no_echo} must be {' or '.join(NO_ECHO_VALUES)}")


class DamagedLine(ValueError):  # noqa: N818 - reads as what happened
    """An invalid line; the message is the reason."""


@dataclass(frozen=True, eq=False)
class Reading:
    """One scan as logged.

    ranges: (N,) float32 metres. pose_odom_base, pose_base_sensor: (3,) x, y, yaw. line: its number in the file.
    max_range: metres from which nothing was detected, 0 if the line lacks it.
    """

    ranges: NDArray[np.float32]
    angle_min: float
    angle_step: float
    pose_odom_base: se2.Pose
    pose_base_sensor: se2.Pose
    stamp_ns: int
    line: int
    max_range: float = 0.0


def read_laser(line: bytes, number: int, offset: float) -> Reading:
    """Return the scan of a FLASER or ROBOTLASER1 line; `offset`: metres from the robot forward to the FLASER laser.

    Raises DamagedLine.
    """
    words = line.split()
    try:
        return _flaser(words, number, offset) if words[0] == b"FLASER" else _robotlaser(words, number)
    except (IndexError, ValueError, ArithmeticError) as error:  # ArithmeticError: raised by Decimal
        if isinstance(error, DamagedLine):
            raise
        raise DamagedLine(f"{words[0].decode()} with words that are missing or not numbers") from None


def _flaser(words: list[bytes], number: int, offset: float) -> Reading:
    ranges, tail = _numbers(words, 1)
    _, odometry = _poses(tail[:6])
    start, step = _angles(len(ranges))
    mount = np.array([offset, 0.0, 0.0])
    return Reading(ranges, start, step, odometry, mount, _stamp(tail[6]), number)


def _robotlaser(words: list[bytes], number: int) -> Reading:
    start, _, step, most = (float(word) for word in words[2:6])
    ranges, tail = _numbers(words, 8)
    _, tail = _numbers([b"", *tail], 1)
    laser, robot = _poses(tail[:6])
    if not (math.isfinite(start) and math.isfinite(step) and 0 < abs(step) < 1 and 0 <= most <= MAX_DISTANCE):
        raise DamagedLine(f"ROBOTLASER1 with beams {step:g} apart, from {start:g}, of {most:g} m")
    mount = se2.relative(robot, laser)
    if np.hypot(*mount[:2]) > LASERS[b"ROBOTLASER1"]:
        raise DamagedLine("ROBOTLASER1 with a laser that is not on the robot")
    return Reading(ranges, start, step, robot, mount, _stamp(tail[11]), number, most)


def _numbers(words: list[bytes], at: int) -> tuple[NDArray[np.float32], list[bytes]]:
    """Return the ranges whose count is at `at`, and the words behind them."""
    count = int(words[at])
    values, tail = words[at + 1 : at + 1 + count], words[at + 1 + count :]
    if not 0 <= count <= MAX_BEAMS or len(values) < count:
        raise DamagedLine(f"{words[0].decode()} that declares {count} ranges and has {len(words) - at - 1} words")
    return np.array(values, dtype="S").astype(np.float64).astype(np.float32) if count else np.empty(0, np.float32), tail


def _poses(words: list[bytes]) -> tuple[se2.Pose, se2.Pose]:
    values = np.array([float(word) for word in words])
    if len(values) != 6 or not np.abs(values).max() < MAX_DISTANCE:
        raise DamagedLine("a pose that is missing, not finite or beyond 1000 km")
    return values[:3], values[3:]


def _stamp(word: bytes) -> int:
    seconds = Decimal(word.decode())
    if not abs(seconds) < 2**33:
        raise DamagedLine(f"a time of {word.decode()} s")
    return int(seconds.scaleb(9))


def _angles(beams: int) -> tuple[float, float]:
    """Return first angle and step of a SICK over 180 degrees, often without its last beam: 181 or 180 beams."""
    if not beams:
        raise DamagedLine("FLASER without ranges")
    steps = beams - 1 if beams % 2 or beams < 3 else beams
    return -math.pi / 2, math.pi / max(steps, 1)


class _Scans(Sequence[Scan]):
    def __init__(self, readings: list[Reading], max_range: float, no_echo: float):
        self._readings, self._max_range, self._no_echo = readings, max_range, no_echo

    def __len__(self) -> int:
        return len(self._readings)

    def __getitem__(self, i):  # pyrefly: ignore[bad-override]
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        return _scan(self._readings[i], self._max_range, self._no_echo)


def _scan(reading: Reading, max_range: float, no_echo: float) -> Scan:
    ranges = reading.ranges.copy()
    ranges[~(ranges > 0)] = np.nan
    ranges[ranges >= max_range] = no_echo
    T_base_sensor = lifted(reading.pose_base_sensor)
    return Scan(
        ranges, reading.angle_min, reading.angle_step, 0.0, max_range, lifted(reading.pose_odom_base) @ T_base_sensor,
        T_base_sensor, stamp_ns=reading.stamp_ns, name=f"line {reading.line}",
    )  # fmt: skip


def _readings(path: Path, damaged: list[str]) -> list[Reading]:
    offset, found = 0.0, []
    for number, line in _lines(path, damaged):
        word = next(iter(line[:24].split()), b"")
        if word == b"PARAM":
            offset = _offset(line, offset)
        elif word in LASERS:
            try:
                found.append(read_laser(line, number, offset))
            except DamagedLine as error:
                damaged.append(f"line {number}: {error}")
    return found


def _offset(line: bytes, before: float) -> float:
    words = line.split()
    try:
        value = float(words[2]) if words[1].decode("ascii", "replace") in OFFSETS else before
    except (IndexError, ValueError):
        return before
    return value if abs(value) < LASERS[b"FLASER"] else before


def _lines(path: Path, damaged: list[str]) -> Iterator[tuple[int, bytes]]:
    try:
        with _opened(path) as file:
            number, size, most = 0, 0, max(ALWAYS_ALLOWED, MAX_RATIO * path.stat().st_size)
            while line := file.readline(MAX_LINE_BYTES):
                number, size = number + 1, size + len(line)
                if size > most:
                    damaged.append(f"the packed file expands to more than {most} bytes; the rest is left out")
                    return
                yield number, line
    except EOFError:
        damaged.append("the packed file ends too early")
    except OSError as error:
        if not isinstance(error, FileNotFoundError | PermissionError | IsADirectoryError):
            damaged.append(f"the packed file is damaged ({error})")
            return
        raise SourceError(f"{path}: {os.strerror(error.errno or 0).lower()}; give a CARMEN log") from None


def _opened(path: Path) -> BinaryIO | bz2.BZ2File:
    return bz2.open(path) if path.suffix.lower() == ".bz2" else path.open("rb")


def _no_echo(readings: list[Reading], declared: float) -> float:
    """Return the range from which on a laser means "no echo".

    It is the largest range of the log if many beams have it and none lies just below it, unless a smaller one is
    `declared` (0: none is); else that; else whichever of a SICK's two conventions peaks in the log.
    """
    ranges = np.concatenate([reading.ranges for reading in readings])
    ranges = ranges[np.isfinite(ranges)]
    largest = float(ranges.max(initial=0.0))
    known = min((limit for limit in NO_ECHO if limit <= largest < 1.1 * limit), default=0.0)
    if known and not declared:
        return known
    return min(spike_of(ranges) or declared or NO_ECHO[-1], declared or np.inf)


def _notes(path: Path, damaged: list[str], max_range: float, no_echo: str) -> Iterator[str]:
    yield f"{path.name}: ranges of {max_range:g} m and more are no echo: {no_echo} (or ?max_range=, ?no_echo=free)"
    if damaged:
        yield f"{path.name}: {len(damaged)} damaged lines left out, the first: {damaged[0]}"
