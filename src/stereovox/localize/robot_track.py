# SPDX-License-Identifier: Apache-2.0
"""The track of a ground robot's recording, by SLAM or by localisation in a map, and its fit.

Fit of a robot's scans to a map along its track: a check for the right map and the right place.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config
from stereovox.errors import FrameRefused, MissingExtra, StereovoxError
from stereovox.frame import Progress, Scan, no_progress
from stereovox.frame.validate import validate_scan
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import need_gtsam
from stereovox.localize.amcl.localise import localise
from stereovox.localize.amcl.particles import DistanceField, distance_field
from stereovox.localize.slam.graph import MapDoubt
from stereovox.localize.slam.pipeline import SlamResult, map_scans
from stereovox.localize.track import Track, beams_of
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.sources.robots.robot import Robot

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


DOUBTFUL = 0.6
"""Share of fitting beams below which the track may be wrong."""


def slam_robot(robot: Robot, config: Config, progress: Progress = no_progress) -> SlamResult:
    """Run SLAM over a robot's scans.

    Raises MissingExtra without gtsam, StereovoxError if there are no scans, and as `map_scans`.
    """
    need_gtsam()  # now, not after an hour at the first loop
    if not len(robot.scans):
        raise StereovoxError(f"{robot.name}: holds no lidar scans to make a map of; give a bag with a LaserScan topic")
    try:
        return map_scans(robot.scans, config, progress)
    except MissingExtra:
        raise
    except StereovoxError as error:
        raise StereovoxError(f"{robot.name}: {error}") from None


def localise_robot(
    robot: Robot,
    floor: OccupancyGrid,
    config: Config,
    start: NDArray[np.floating] | None,
    progress: Progress = no_progress,
) -> Track:
    """Return the robot's track through a map; `start`: x, y, yaw in metres and radians, None: anywhere.

    Raises StereovoxError if there are no scans, and as `localise`.
    """
    total = len(robot.scans)
    if not total:
        raise StereovoxError(f"{robot.name}: holds no lidar scans to localise with; give a bag with a LaserScan topic")
    return localise(floor, robot.scans, config, start, progress=lambda done: progress(done, total, "localising"))


def parse_start(text: str, name: str = "--start") -> NDArray[np.float64] | None:
    """Return x, y in metres and yaw in radians of `X,Y,DEG`, None for ""; raises StereovoxError for anything else.

    name: of the option, for messages.
    """
    if not text:
        return None
    try:
        x, y, degrees = (float(part) for part in text.split(","))
    except ValueError:
        raise StereovoxError(f"{name} {text}: give X,Y,DEG, for example --start=1.5,-2,90") from None
    if not np.isfinite([x, y, degrees]).all():
        raise StereovoxError(f"{name} {text}: give finite numbers")
    return np.array([x, y, np.radians(degrees)])


def check_start(start: NDArray[np.floating] | None, floor: OccupancyGrid) -> None:
    """Raise StereovoxError for a start (x, y, yaw in radians) that is not three numbers or lies outside the map."""
    if start is None:
        return
    if start.shape != (3,) or not np.isfinite(start).all():
        raise StereovoxError(f"start {start.tolist()}: give x, y in metres and the yaw, three finite numbers")
    row, column = floor.indices(start[None, :2])[0]
    rows, columns = floor.cells.shape
    if not (0 <= row < rows and 0 <= column < columns):
        (x0, y0), (x1, y1) = floor.centres([0, rows - 1], [0, columns - 1])
        given = f"start {start[0]:g}, {start[1]:g} m, {np.degrees(start[2]):g} degrees"
        raise StereovoxError(f"{given}: lies outside of the map, from ({x0:.1f}, {y0:.1f}) to ({x1:.1f}, {y1:.1f}) m")


def refused_line(refused: Mapping[str, int], first: str = "") -> str:
    """Return one line about the refused scans, by reason; "" if there are none."""
    if not refused:
        return ""
    reasons = ", ".join(f"{number} x {reason}" for reason, number in refused.items())
    return f"{sum(refused.values())} scans refused: {reasons}" + (f", first: {first}" if first else "")


def doubt_lines(doubts: Sequence[MapDoubt]) -> list[str]:
    """Return the warnings about a SLAM map that may be wrong; empty if there are none."""
    if not doubts:
        return []
    return ["warning: this map may be wrong; inspect it before you use it", *(f"  {doubt.line()}" for doubt in doubts)]


def fit_of(robot: Robot, floor: OccupancyGrid, track: Track) -> tuple[float | None, str]:
    """Return the share of beams that fit the map along the track, and a line that states it, with a warning if it is
    low.

    None and "" if no beam has a return.
    """
    fit = fit_share(floor, robot.scans, track)
    if fit is None:
        return None, ""
    doubt = "; is it the right map, and the right start?" if fit < DOUBTFUL else ""
    return fit, f"{100 * fit:.0f} % of the beams end within {NEAR:g} m of an obstacle of the map{doubt}"
