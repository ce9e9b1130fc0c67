# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: a robot's lidar and odometry as lines of text (`.clf`, `.log`, each also as `.bz2`)."""

from __future__ import annotations

import bz2
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from stereovox.errors import SourceError
from stereovox.frame import Frame, Scan
from stereovox.planar import lifted
from stereovox.sources import parameters
from stereovox.sources.carmen_lines import LASERS, NO_ECHO, DamagedLine, Reading, read_laser
from stereovox.sources.poses import Poses

ENDINGS = (".clf", ".log", ".clf.bz2", ".log.bz2")
LONGEST = 1 << 20
"""Bytes of a line; what is longer is no line of a log."""
SMALL, PACKED_BEST = 1 << 18, 100
"""A packed log may become so many bytes, or so many for each of its own; text packs to a tenth."""
NO_ECHO_MEANS = {"unknown": np.nan, "free": np.inf}
OFFSETS = {"robot_frontlaser_offset", "robot_front_laser_offset", "frontlaser_offset"}


@dataclass(frozen=True)
class Options:
    """What may stand behind the file's name, as in `aces.clf.bz2?max_range=40`.

    max_range: metres from which on a range says "no echo"; 0: what the file says, else what its numbers say: the least
        of 50 m and 81.9 m (a SICK's "no echo") that the log holds as such.
    no_echo: what that means: `unknown`, since black and dazzling things give no echo either, or `free` up to there.
    """

    max_range: float = 0.0
    no_echo: str = "unknown"

    def __post_init__(self) -> None:
        if self.max_range < 0:
            raise SourceError(f"max_range={self.max_range:g} must be a positive number")
        if self.no_echo not in NO_ECHO_MEANS:
            raise SourceError(f"no_echo={self.no_echo} must be {' or '.join(NO_ECHO_MEANS)}")


class CarmenLog:
    """Scans (FLASER, ROBOTLASER1) of a CARMEN log, with the robot's raw odometry as poses.

    The mount is PARAM robot_frontlaser_offset (metres forward), in ROBOTLASER1 the difference of its two poses. Stamps
    are `ipc_timestamp`, which is what `.relations` files name. Lines that do not make sense are left out, counted and
    named in `notes`. `frames` is empty, `truth` unknown.
    Raises SourceError where the file cannot be read or holds no scan.
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
        self._max_range = options.max_range or self._readings[0].max_range or _no_echo(self._readings)
        self.notes = tuple(_notes(path, self.damaged, self._max_range, options.no_echo))
        self.scans: Sequence[Scan] = _Scans(self._readings, self._max_range, NO_ECHO_MEANS[options.no_echo])
        self.frames: Sequence[Frame] = ()
        self.truth: Poses | None = None

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Tell whether the name ends like a CARMEN log's."""
        return str(where).partition("?")[0].lower().endswith(ENDINGS)


class _Scans(Sequence[Scan]):
    def __init__(self, readings: list[Reading], max_range: float, no_echo: float):
        self._readings, self._max_range, self._no_echo = readings, max_range, no_echo

    def __len__(self) -> int:
        return len(self._readings)

    def __getitem__(self, i):  # pyright: ignore[reportIncompatibleMethodOverride, reportMissingParameterType]
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
            number, size, most = 0, 0, max(SMALL, PACKED_BEST * path.stat().st_size)
            while line := file.readline(LONGEST):
                number, size = number + 1, size + len(line)
                if size > most:
                    damaged.append(f"the packed file swells to more than {most} bytes; the rest is left out")
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


def _no_echo(readings: list[Reading]) -> float:
    """The range from which on a SICK means "no echo": one of its two conventions that is a peak in the log."""
    largest = max(float(np.max(reading.ranges, initial=0.0, where=np.isfinite(reading.ranges))) for reading in readings)
    return min((limit for limit in NO_ECHO if limit <= largest < 1.1 * limit), default=NO_ECHO[-1])


def _notes(path: Path, damaged: list[str], max_range: float, no_echo: str) -> Iterator[str]:
    yield f"{path.name}: ranges of {max_range:g} m and more are no echo: {no_echo} (or ?max_range=, ?no_echo=free)"
    if damaged:
        yield f"{path.name}: {len(damaged)} damaged lines left out, the first: {damaged[0]}"
