# SPDX-License-Identifier: Apache-2.0
"""Poses over time from text files of the TUM format, and the pose at a time between two of them."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable
from decimal import Decimal, InvalidOperation
from pathlib import Path

from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry import Transform, from_quaternion, interpolate

MAX_GAP_NS = 100_000_000
"""A pose this far (0.1 s) or further from an image, on either side, says too little about the image's own."""
LIMIT = 9_223_372_036
"""Seconds whose nanoseconds still fit into int64."""


class Trajectory:
    """Poses in a file of lines `stamp tx ty tz qx qy qz qw`: seconds, metres, quaternion of any length but zero.

    Lines may be in any order; of several with one stamp the first counts. A line that has a stamp but no usable pose
    is remembered, and whatever needs it is refused.
    Raises SourceError with file and line where a stamp is unreadable, or where there is no line at all.
    """

    def __init__(self, path: Path):
        self._path = path
        self._lines = by_time(stamped_lines(path))
        self._stamps = [stamp_ns for stamp_ns, _, _ in self._lines]
        if not self._lines:
            raise SourceError(f"{path}: holds no pose; write lines 'stamp tx ty tz qx qy qz qw'")

    def __len__(self) -> int:
        return len(self._lines)

    def at(self, stamp_ns: int) -> Transform:
        """Return the pose at `stamp_ns`: a line's own, else interpolated between the neighbours before and after.

        Raises FrameRefused: `no_pose` where one of the neighbours is missing or 0.1 s or more away, `bad_pose_file`
        where a neighbour's line holds no pose.
        """
        after = bisect_left(self._stamps, stamp_ns)
        if after < len(self._stamps) and self._stamps[after] == stamp_ns:
            return self._pose(after)
        self._check_gap(stamp_ns, after)
        start, end = self._stamps[after - 1], self._stamps[after]
        return interpolate(self._pose(after - 1), self._pose(after), (stamp_ns - start) / (end - start))

    def _check_gap(self, stamp_ns: int, after: int) -> None:
        gaps = {
            "before": stamp_ns - self._stamps[after - 1] if after else None,
            "after": self._stamps[after] - stamp_ns if after < len(self._stamps) else None,
        }
        for side, gap in gaps.items():
            if gap is None or gap >= MAX_GAP_NS:
                found = "there is none" if gap is None else f"the nearest is {gap / 1e9:.3f} s away"
                wanted = f"needs a pose less than {MAX_GAP_NS / 1e9:g} s {side} {seconds_from_ns(stamp_ns)} s"
                raise FrameRefused("no_pose", f"{self._path}: {wanted}, {found}; leave the image out or add poses")

    def _pose(self, k: int) -> Transform:
        _, rest, where = self._lines[k]
        try:
            numbers = [float(word) for word in rest.split()]
        except ValueError as error:
            raise FrameRefused("bad_pose_file", f"{where}: {error}; correct or delete the line") from None
        if len(numbers) != 7 or not all(map(math.isfinite, numbers)):
            raise FrameRefused("bad_pose_file", f"{where}: needs 'stamp tx ty tz qx qy qz qw'; correct or delete it")
        if math.hypot(*numbers[3:]) < 1e-6:
            raise FrameRefused("bad_pose_file", f"{where}: quaternion of length zero; correct or delete the line")
        return from_quaternion(numbers[:3], numbers[3:])


StampedLine = tuple[int, str, str]
"""Time in nanoseconds, the rest of the line, and `file:line` for messages."""


def stamped_lines(path: Path) -> list[StampedLine]:
    """Return the lines of `path` that start with a time in seconds, in file order, without comments and empty ones.

    Commas and tabs count as spaces. Raises SourceError naming file and line.
    """
    try:
        text = path.read_text("utf-8-sig", errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    return [_parse(line, f"{path}:{n}") for n, line in enumerate(map(_plain, text.splitlines()), 1) if line]


def by_time(lines: Iterable[StampedLine]) -> list[StampedLine]:
    """Return the lines sorted by time, only the first of those with the same stamp."""
    first: dict[int, StampedLine] = {}
    for line in lines:
        first.setdefault(line[0], line)
    return [first[stamp_ns] for stamp_ns in sorted(first)]


def ns_from_seconds(text: str) -> int:
    """Return the exact nanoseconds of a decimal number of seconds; digits beyond the ninth are rounded.

    A float would be off by up to 120 ns for today's dates. Raises ValueError for what is no number or too large for
    int64.
    """
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"'{text}' is no time in seconds") from None
    if not (seconds.is_finite() and -LIMIT < seconds < LIMIT):  # abs() may overflow
        raise ValueError(f"'{text}' is no time in seconds")
    return round(seconds * 1_000_000_000)


def seconds_from_ns(stamp_ns: int) -> str:
    """Return nanoseconds as seconds with all nine decimals."""
    return f"{Decimal(stamp_ns).scaleb(-9):.9f}"


def _plain(line: str) -> str:
    return line.partition("#")[0].replace(",", " ").strip()


def _parse(line: str, where: str) -> StampedLine:
    stamp, *rest = line.split(maxsplit=1)
    try:
        return ns_from_seconds(stamp), "".join(rest), where
    except ValueError as error:
        raise SourceError(f"{where}: {error}; correct or delete the line") from None
