# SPDX-License-Identifier: Apache-2.0
"""A short drive of a robot with lidar and depth camera, and the reference map that SLAM makes of it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from stereovox.config import load_config
from stereovox.formats.map_server import write_map_server
from stereovox.localize.robot_track import slam_robot
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.simulate.floors.floor import Floor, write_bag

SCAN, DEPTH = "/scan", "/camera/depth/image_raw"


@cache
def floor() -> Floor:
    return Floor("sim:floor?plan=testbed&seconds=16&scan_hz=5&depth_hz=4&image_width=160")


@cache
def reference() -> OccupancyGrid:
    return slam_robot(floor(), load_config("ist2019")).grid


def write_drive(folder: Path) -> tuple[Path, Path]:
    """Write bag and reference map."""
    bag, map_file = folder / "drive.mcap", folder / "reference.yaml"
    write_bag(floor(), bag)
    write_map_server(reference(), map_file)
    return bag, map_file
