# SPDX-License-Identifier: Apache-2.0
"""Finished maps in bags: `nav_msgs/OccupancyGrid`, `octomap_msgs/Octomap`, `sensor_msgs/PointCloud2`, read and
written."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from stereovox.errors import FrameRefused, MapFileError, SourceError, StereovoxError
from stereovox.formats.clouds import PointFile, map_of_cloud
from stereovox.formats.octomap import BINARY_TITLE, TREE_TITLE, full_tree, map_of_nodes
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.floor_axes import upright_axes
from stereovox.products.floor_heights import FloorHeights, floor_of_map
from stereovox.products.projection import Heights, project
from stereovox.sources.bags import open_bag
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.robot_messages import (
    OCCUPANCY_GRID,
    OCTOMAP,
    POINT_CLOUD,
    read_occupancy_grid,
    read_octomap_message,
    read_point_cloud,
)
from stereovox.sources.bags.writer import BagWriter

MAP_FRAME, CELLS_FRAME = "map", "map_cells"
"""Names of the frame whose z is up, and of the cells' frame if another axis of the map is up."""
MapT = TypeVar("MapT")


@one_state
def write_bag(
    voxel_map: VoxelMap,
    path: str | Path,
    heights: Heights | None = None,
    floor: FloorHeights | float | None = None,
    start: ArrayLike | None = None,
) -> None:
    """Write the map into a new bag, `.bag` (ROS 1), `.mcap` or `.db3` (ROS 2), with all topics latched.

    `/octomap_full`: an Octomap of every known cell with its log-odds. `/occupied_cells`: a PointCloud2 of the centres
    of the occupied cells. `/map_mapping`: an OccupancyGrid, the map seen from above; heights, floor and start: see
    `projection.project`; left out if the map shows no floor.
    All are in frame `map`; if the map's `up` is not z, the first two are in `map_cells`, rotated by `/tf_static`.
    Stamps are the last frame's, or zero. Raises MapFileError if the map cannot be written, MissingExtra
    without rosbags.
    """
    axes = upright_axes(voxel_map.config.up)
    turned = not np.array_equal(axes, np.eye(3))
    stamp_ns = 0 if voxel_map.viewpoint is None else voxel_map.viewpoint.stamp_ns
    frame = CELLS_FRAME if turned else MAP_FRAME
    try:
        found, tree = floor_of_map(voxel_map, floor, start), full_tree(voxel_map).data
        grid = project(voxel_map, heights, found) if found.known else None
        with BagWriter(path) as bag:
            if turned:
                T_map_cells = np.eye(4)
                T_map_cells[:3, :3] = axes
                bag.fixed(MAP_FRAME, CELLS_FRAME, T_map_cells)
            bag.octomap(stamp_ns, tree, voxel_map.voxel_size, frame_id=frame)
            bag.cloud(stamp_ns, voxel_map.occupied(), frame_id=frame)
            if grid is not None:
                bag.occupancy(stamp_ns, grid, frame_id=MAP_FRAME)
    except SourceError as error:
        raise MapFileError(str(error)) from None
    except ImportError:
        raise
    except StereovoxError as error:
        raise MapFileError(f"{path}: {error}") from None


def write_grid_bag(grid: OccupancyGrid, path: str | Path) -> None:
    """Write a floor's map as an OccupancyGrid on `/map_mapping`, latched; raises as `write_bag` does."""
    try:
        with BagWriter(path) as bag:
            bag.occupancy(0, grid, frame_id=MAP_FRAME)
    except SourceError as error:
        raise MapFileError(str(error)) from None


def read_bag_map(path: str | Path, voxel_size: float | None = None, topic: str | None = None) -> VoxelMap:
    """Return the map in the last Octomap of a bag's topic, cell for cell, or the cells that contain a PointCloud2's
    points.

    topic: required if the bag has several Octomaps, and for a PointCloud2, whose points are used as world
    coordinates. voxel_size: metres, for a PointCloud2 only; None: a suggested one. Raises MapFileError.
    """
    path_name = Path(path).name

    def octomap_cells(wire: Wire) -> VoxelMap:
        if voxel_size is not None:
            raise ValueError("an Octomap has its own cell size; leave --voxel-size out")
        return _octomap_cells(wire)

    def cloud_cells(wire: Wire) -> VoxelMap:
        points = np.asarray(read_point_cloud(wire).points, np.float64).reshape(-1, 3)
        cloud = PointFile(points, f"{POINT_CLOUD}, {len(points):,} points", metres=((1.0, 1.0, 1.0), "metres"))
        return map_of_cloud(cloud, path_name, voxel_size, origin=(0.0, 0.0, 0.0))

    return _last(Path(path), topic, {OCTOMAP: octomap_cells, POINT_CLOUD: cloud_cells})


def read_bag_grid(path: str | Path, topic: str | None = None) -> OccupancyGrid:
    """Return the last OccupancyGrid of a bag's topic; topic: required if there are several. Raises MapFileError."""
    return _last(Path(path), topic, {OCCUPANCY_GRID: read_occupancy_grid})


def _octomap_cells(wire: Wire) -> VoxelMap:
    message = read_octomap_message(wire)
    title = BINARY_TITLE if message.binary else TREE_TITLE
    return map_of_nodes(title, message.data, message.resolution, tree=message.tree)


def _last(path: Path, topic: str | None, readers: dict[str, Callable[[Wire], MapT]]) -> MapT:
    """Read the last message of a topic with the reader of its type; None: the only topic of the first type."""
    try:
        bag = open_bag(path)
        topic = topic or _only(bag.types, next(iter(readers)))
        if bag.types.get(topic) not in readers:
            raise ValueError(f"{topic} holds no {' or '.join(readers)}; {_held(bag.types)}")
        return readers[bag.types[topic]](bag.read(topic, len(bag.stamps(topic)) - 1))
    except (SourceError, FrameRefused) as error:
        raise MapFileError(str(error)) from None
    except ValueError as error:
        raise MapFileError(f"{path}: {error}") from None


def _only(types: dict[str, str], kind: str) -> str:
    found: Sequence[str] = sorted(topic for topic, held in types.items() if held == kind)
    if len(found) != 1:
        told = f"has {len(found)} topics of {kind}" if found else f"has no {kind}"
        raise ValueError(f"{told}; name a topic with --topic; {_held(types)}")
    return found[0]


def _held(types: dict[str, str]) -> str:
    return f"the bag has {', '.join(f'{name} ({kind})' for name, kind in sorted(types.items())) or 'nothing'}"
