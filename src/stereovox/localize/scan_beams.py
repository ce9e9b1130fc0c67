# SPDX-License-Identifier: Apache-2.0
"""A validated scan as beams in the robot's frame, seen from above."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.frame import Scan, name_of


@dataclass(frozen=True, eq=False)
class Beams:
    """The usable beams of a scan: hits, and beams without a return up to `range_max`.

    origin: (2,) float64 x, y of the sensor in the robot's frame.
    directions: (K, 2) float64, direction of a beam per metre of its length, seen from above in the robot's frame.
        Shorter than one if the sensor is tilted.
    ranges: (K,) float64 metres; `range_max` if there is no return.
    at_max: (K,) bool, which have no return.
    range_max: metres.
    """

    origin: NDArray[np.float64]
    directions: NDArray[np.float64]
    ranges: NDArray[np.float64]
    at_max: NDArray[np.bool_]
    range_max: float

    @property
    def ends(self) -> NDArray[np.float64]:
        """Where the beams end in the robot's frame, (K, 2) metres."""
        return self.origin + self.directions * self.ranges[:, None]

    def some(self, most: int, hits_only: bool = False) -> Beams:
        """Return at most `most` beams, evenly chosen from all or from the hits."""
        chosen = np.flatnonzero(~self.at_max) if hits_only else np.arange(len(self.ranges))
        if len(chosen) > most:
            chosen = chosen[np.linspace(0, len(chosen) - 1, most).round().astype(int)]
        return self.only(chosen)

    def only(self, chosen: NDArray[np.integer] | NDArray[np.bool_]) -> Beams:
        """Return the chosen beams."""
        return replace(self, directions=self.directions[chosen], ranges=self.ranges[chosen], at_max=self.at_max[chosen])


def beams_of(scan: Scan, max_range: float | None = None) -> Beams:
    """Return the beams of a scan: NaN, -inf and ranges below `range_min` are ignored, +inf means no return.

    max_range: metres beyond which returns do not count; None: the scan's own. The scan must be validated
    (`validate_scan`). Raises FrameRefused with the reason: `bad_scan`, `no_valid_range`.
    """
    ranges, farthest = np.asarray(scan.ranges, float), _farthest(scan, max_range)
    known = (ranges >= scan.range_min) & (ranges > 0)
    if not known.any():
        raise FrameRefused("no_valid_range", f"{name_of(scan)}: not one beam has a range; is the lidar covered?")
    angles = scan.angles[known]
    across = np.column_stack([np.cos(angles), np.sin(angles)]) @ scan.T_base_sensor[:2, :2].T
    at_max = ranges[known] >= farthest
    return Beams(scan.T_base_sensor[:2, 3], across, np.minimum(ranges[known], farthest), at_max, farthest)


def _farthest(scan: Scan, max_range: float | None) -> float:
    farthest = scan.range_max if max_range is None else min(max_range, scan.range_max)
    if not 0 < farthest < np.inf:
        said = f"{name_of(scan)}: the lidar measures up to {scan.range_max:g} m; amcl.max_range must bound that"
        raise FrameRefused("bad_scan", said)
    return float(farthest)
