# SPDX-License-Identifier: Apache-2.0
"""Lines of a CARMEN log: FLASER (of the old format) and ROBOTLASER1 (of the new one)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray

from stereovox import planar

LASERS = {b"FLASER": 100.0, b"ROBOTLASER1": 100.0}
"""Kinds of lines that hold a scan of the front laser, and the metres within which it must sit on the robot."""
NO_ECHO = (50.0, 81.9)
FARTHEST = 1e6
"""Metres from the world's origin within which a robot can be."""
MOST_BEAMS = 100_000


class DamagedLine(ValueError):  # noqa: N818 - reads as what happened
    """A line does not make sense; the message says why."""


@dataclass(frozen=True, eq=False)
class Reading:
    """One scan as the log holds it.

    ranges: (N,) float32 metres. pose_odom_base, pose_base_sensor: (3,) x, y, yaw. line: its number in the file.
    max_range: metres from which on nothing was seen, 0 where the line does not tell.
    """

    ranges: NDArray[np.float32]
    angle_min: float
    angle_step: float
    pose_odom_base: planar.Pose
    pose_base_sensor: planar.Pose
    stamp_ns: int
    line: int
    max_range: float = 0.0


def read_laser(line: bytes, number: int, offset: float) -> Reading:
    """Return the scan of a FLASER or ROBOTLASER1 line; `offset`: metres that the laser of FLASER lines sits forward.

    Raises DamagedLine.
    """
    words = line.split()
    try:
        return _flaser(words, number, offset) if words[0] == b"FLASER" else _robotlaser(words, number)
    except (IndexError, ValueError, ArithmeticError) as error:  # ArithmeticError: those of Decimal
        if isinstance(error, DamagedLine):
            raise
        raise DamagedLine(f"{words[0].decode()} with words that are missing or no numbers") from None


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
    if not (math.isfinite(start) and math.isfinite(step) and 0 < abs(step) < 1 and 0 <= most <= FARTHEST):
        raise DamagedLine(f"ROBOTLASER1 with beams {step:g} apart, from {start:g}, of {most:g} m")
    mount = planar.relative(robot, laser)
    if np.hypot(*mount[:2]) > LASERS[b"ROBOTLASER1"]:
        raise DamagedLine("ROBOTLASER1 with a laser that is not on the robot")
    return Reading(ranges, start, step, robot, mount, _stamp(tail[11]), number, most)


def _numbers(words: list[bytes], at: int) -> tuple[NDArray[np.float32], list[bytes]]:
    """Return the ranges whose number stands at `at`, and the words behind them."""
    count = int(words[at])
    values, tail = words[at + 1 : at + 1 + count], words[at + 1 + count :]
    if not 0 <= count <= MOST_BEAMS or len(values) < count:
        raise DamagedLine(f"{words[0].decode()} that tells {count} ranges and holds {len(words) - at - 1} words")
    return np.array(values, dtype="S").astype(np.float64).astype(np.float32) if count else np.empty(0, np.float32), tail


def _poses(words: list[bytes]) -> tuple[planar.Pose, planar.Pose]:
    values = np.array([float(word) for word in words])
    if len(values) != 6 or not np.abs(values).max() < FARTHEST:
        raise DamagedLine("a pose that is missing, not finite or beyond 1000 km")
    return values[:3], values[3:]


def _stamp(word: bytes) -> int:
    seconds = Decimal(word.decode())
    if not abs(seconds) < 2**33:
        raise DamagedLine(f"a time of {word.decode()} s")
    return int(seconds.scaleb(9))


def _angles(beams: int) -> tuple[float, float]:
    """First angle and step of a SICK over 180 degrees, whose last beam is often left out: 181 or 180 beams."""
    if not beams:
        raise DamagedLine("FLASER without ranges")
    steps = beams - 1 if beams % 2 or beams < 3 else beams
    return -math.pi / 2, math.pi / max(steps, 1)
