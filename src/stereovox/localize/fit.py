# SPDX-License-Identifier: Apache-2.0
"""Fit of a robot's scans to a map along its track: a check for the right map and the right place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil

import numpy as np

from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.frame.validate import validate_scan
from stereovox.geometry import se2
from stereovox.localize.amcl.models import DistanceField, distance_field
from stereovox.localize.scan_beams import beams_of
from stereovox.localize.track import Track
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid

NEAR = 0.25
"""Metres from an obstacle of the map within which a beam fits."""
SCANS, BEAMS, RIGID = 60, 60, 5e-3


def fit_share(grid: OccupancyGrid, scans: Sequence[Scan], track: Track) -> float | None:
    """Return the share of beams (0 to 1) that end near an obstacle of the map, over scans spread along the track.

    Beams without a return do not count. None if no beam has a return.
    """
    field = distance_field(_with_rim(grid), 2 * NEAR)
    found = [_distances(field, scans[i], track) for i in _spread(len(scans))]
    all_of_them = np.concatenate([np.empty(0), *found])
    return float(np.mean(all_of_them <= NEAR)) if all_of_them.size else None


def _with_rim(grid: OccupancyGrid) -> OccupancyGrid:
    """Return the map padded with unknown cells, so that walls at its border have a far side too."""
    rim = ceil(NEAR / grid.resolution)
    x, y, yaw = se2.compose(grid.origin, [-rim * grid.resolution, -rim * grid.resolution, 0.0]).tolist()
    return replace(grid, cells=np.pad(grid.cells, rim, constant_values=UNKNOWN), origin=(x, y, yaw))


def _spread(count: int) -> list[int]:
    return np.unique(np.linspace(0, count - 1, min(SCANS, count)).astype(int)).tolist()


def _distances(field: DistanceField, scan: Scan, track: Track) -> np.ndarray:
    try:
        beams = beams_of(validate_scan(scan, RIGID)).some(BEAMS, hits_only=True)
    except FrameRefused:
        return np.empty(0)
    pose = se2.compose(track.correction(scan.stamp_ns), scan.pose_world_base)
    return np.asarray(field.at(se2.transform(pose, beams.ends)), float)
