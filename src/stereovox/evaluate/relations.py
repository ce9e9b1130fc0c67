# SPDX-License-Identifier: Apache-2.0
"""How well a trajectory keeps known motions between pairs of times (Kuemmerle et al. 2009, Eq 5 to 9)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.errors import SourceError
from stereovox.localize.track import Track
from stereovox.sources.trajectory import ns_from_seconds
from stereovox.untrusted import MOST_LIST, read_text

TOLERANCE_S = 0.05
"""A relation whose time is further than this from any pose is not scored."""


@dataclass(frozen=True, eq=False)
class Relations:
    """Known motions of a robot, most of them between neighbouring times, some between visits of one place.

    stamps_ns: (N, 2) int64, the two times. motion: (N, 3) float64, pose_first_second (x, y, yaw).
    """

    stamps_ns: NDArray[np.int64]
    motion: planar.Pose

    def __len__(self) -> int:
        return len(self.motion)


@dataclass(frozen=True, eq=False)
class RelationErrors:
    """What is left between a trajectory's motions and the known ones.

    metres, radians: (N,) absolute errors of the relations that have poses. missed: how many have none.
    """

    metres: NDArray[np.float64]
    radians: NDArray[np.float64]
    missed: int

    def rows(self) -> dict[str, tuple[float, float]]:
        """Return mean and standard deviation in the papers' units: m, degrees, m^2, degrees^2."""
        degrees = np.degrees(self.radians)
        table = {
            "absolute_m": self.metres,
            "absolute_deg": degrees,
            "squared_m2": self.metres**2,
            "squared_deg2": degrees**2,
        }
        return {name: (float(values.mean()), float(values.std())) for name, values in table.items()}

    def as_dict(self) -> dict[str, Any]:
        """Return the figures by name, as a command's result."""
        table = {name: {"mean": mean, "std": std} for name, (mean, std) in self.rows().items()}
        return {"relations": len(self.metres), "without_pose": self.missed, **table}

    def line(self) -> str:
        """Return the figures in one line."""
        rows = self.rows()
        metres, degrees = ("{:.4f} +- {:.4f}".format(*rows[name]) for name in ("absolute_m", "absolute_deg"))
        missed = f", {self.missed} more have no pose" if self.missed else ""
        return f"{len(self.metres)} relations: off by {metres} m and {degrees} degrees{missed}"


def read_relations(path: str | os.PathLike[str]) -> Relations:
    """Return the relations of a file with lines `time1 time2 x y z roll pitch yaw` (seconds, metres, radians).

    Raises SourceError, one line, where it cannot be read, a line does not make sense, or there is none.
    """
    path = Path(path)
    try:
        lines = read_text(path, MOST_LIST, "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {os.strerror(error.errno or 0).lower()}; give a .relations file") from None
    rows = [_row(path, number, line) for number, line in enumerate(lines, 1) if line.strip() and line[0] != "#"]
    if not rows:
        raise SourceError(f"{path}: holds no relation (time1 time2 x y z roll pitch yaw)")
    return Relations(np.array([row[:2] for row in rows], np.int64), np.array([row[2:] for row in rows], float))


def _row(path: Path, number: int, line: str) -> tuple[int, int, float, float, float]:
    words = line.split()
    try:
        first, second = (ns_from_seconds(word) for word in words[:2])
        x, y, _, _, _, yaw = (float(word) for word in words[2:])
        if not np.isfinite([x, y, yaw]).all():
            raise ValueError
    except ValueError:
        raise SourceError(f"{path}: line {number} is no relation (time1 time2 x y z roll pitch yaw)") from None
    return first, second, x, y, yaw


def score_relations(track: Track, path: str | os.PathLike[str]) -> RelationErrors:
    """Return how far a track's motions are from those in a `.relations` file."""
    return relation_errors(read_relations(path), track.stamps_ns, track.pose_map_base)


def relation_errors(
    relations: Relations, stamps_ns: ArrayLike, poses: ArrayLike, tolerance_s: float = TOLERANCE_S
) -> RelationErrors:
    """Return how far a trajectory's motions are from the known ones.

    stamps_ns: (M,) int64, rising. poses: (M, 3) pose_map_base. Each time of a relation takes the pose nearest in time.
    The error is delta (-) delta*, length and angle apart: independent of the map's frame (Kuemmerle 2009, Eq 7).
    Raises SourceError where no relation has poses.
    """
    stamps, poses = np.asarray(stamps_ns, np.int64), np.asarray(poses, float)
    nearest = _nearest(stamps, relations.stamps_ns)
    near = np.abs(stamps[nearest] - relations.stamps_ns).max(axis=1) <= tolerance_s * 1e9
    if not near.any():
        raise SourceError("no relation has a time that the trajectory has; are they of one recording?")
    found = planar.relative(poses[nearest[near, 0]], poses[nearest[near, 1]])
    left = planar.relative(relations.motion[near], found)
    return RelationErrors(np.hypot(left[:, 0], left[:, 1]), np.abs(left[:, 2]), int((~near).sum()))


def _nearest(stamps: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    after = np.clip(np.searchsorted(stamps, wanted), 1, max(len(stamps) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps) - 1)
    return np.where(wanted - stamps[before] <= stamps[after] - wanted, before, after)
