# SPDX-License-Identifier: Apache-2.0
"""MAVLink's OBSTACLE_DISTANCE_3D from a map: the nearest obstacle in each direction, including up and down.

One message is one place (https://mavlink.io/en/messages/ardupilotmega.html#OBSTACLE_DISTANCE_3D), in metres along the
body's own front, right and down (MAV_FRAME_BODY_FRD, the only frame ArduPilot reads). ArduPilot keeps the nearest place
in each of 8 sectors of 45 degrees in 5 layers of 30 (AP_Proximity_Boundary_3D.h); messages of one `time_boot_ms` that
follow each other within 50 ms form one scan, and a new time starts a new scan, in which directions without a
message are free (AP_Proximity_MAV.cpp, `handle_obstacle_distance_3d_msg`). PX4 does not read this message.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import Transform, rigidity_error
from stereovox.maps import State, VoxelMap
from stereovox.mavlink.sectors import check_number_of_cells, states_of

LAYERS, LAYER_DEG, SECTOR_DEG = 5, 30, 45
LEAST_M = 0.01
"""Nearer places are sent at this distance; ArduPilot ignores one at the origin."""
FRD_OF_OPTICAL = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
"""Turns optical axes (right, down, forward) into front, right, down."""


@dataclass(frozen=True)
class DirectionRules:
    """Rules for reading directions from a map.

    Attributes:
        max_distance: Metres up to which cells are inspected.
        own_radius: Metres around the body within which unknown and tentative cells count as the vehicle's own
            place, as in `SectorRules`.
        oldest_s: As in `SectorRules`.
        unknown: Whether unknown cells are sent like obstacles. Otherwise ArduPilot treats unknown directions as free.

    Raises:
        StereovoxError: A value is out of range.
    """

    max_distance: float = 3.0
    own_radius: float = 0.5
    oldest_s: float = inf
    unknown: bool = True

    def __post_init__(self) -> None:
        if not (0.1 <= self.max_distance <= 1000 and 0 <= self.own_radius <= self.max_distance):
            raise StereovoxError(
                f"max_distance {self.max_distance:g}, own_radius {self.own_radius:g}: give 0.1 to 1000 m, and no "
                "larger radius than that"
            )
        if not self.oldest_s >= 0:
            raise StereovoxError(f"oldest_s {self.oldest_s:g}: give seconds, 0 or more")


def nearest_places(
    voxel_map: VoxelMap, T_world_body: Transform, rules: DirectionRules | None = None
) -> NDArray[np.float64]:
    """Return the nearest place in each of ArduPilot's 40 directions that is not known to be free.

    A cell counts in the direction of its nearest point.

    Args:
        voxel_map: The map.
        T_world_body: (4, 4) maps the body (optical axes: x right, y down, z forward) into the world.
        rules: What to inspect; by default `DirectionRules()`.

    Returns:
        (N, 3) float64 metres to the front, right and down; N up to 40.

    Raises:
        StereovoxError: The pose is not rigid, or there are too many cells to inspect.
    """
    rules = rules or DirectionRules()
    if not rigidity_error(T_world_body) < 1e-3:
        raise StereovoxError("T_world_body is no rigid motion (4, 4); give a rotation and metres")
    cell, origin = np.array(voxel_map.config.cell, np.float64), np.asarray(T_world_body[:3, 3], np.float64)
    cells = _cells_within(origin, cell, rules.max_distance)
    centres: NDArray[np.float64] = (cells + 0.5) * cell
    states = states_of(voxel_map, centres, rules.oldest_s)
    beyond = np.linalg.norm(centres - origin, axis=1) > rules.own_radius
    uncertain = (states == State.TENTATIVE) | ((states == State.UNKNOWN) & rules.unknown)
    counts = (states == State.OCCUPIED) | (uncertain & beyond)
    nearest = np.clip(origin, cells[counts] * cell, (cells[counts] + 1) * cell) - origin
    places = _no_nearer(nearest, centres[counts] - origin) @ T_world_body[:3, :3] @ FRD_OF_OPTICAL.T
    return _nearest_in_each(places)


def _cells_within(origin: NDArray[np.float64], cell: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
    """Return the cells (N, 3) that a ball touches."""
    low, high = np.floor((origin - radius) / cell), np.floor((origin + radius) / cell)
    check_number_of_cells(low.astype(np.int64), high.astype(np.int64))
    lines = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
    away = [np.clip(o, line * side, (line + 1) * side) - o for o, line, side in zip(origin, lines, cell, strict=True)]
    squares = away[0][:, None, None] ** 2 + away[1][None, :, None] ** 2 + away[2][None, None, :] ** 2
    return (np.argwhere(squares <= radius**2) + low).astype(np.int64)


def _no_nearer(nearest: NDArray[np.float64], centres: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return places (N, 3) at least LEAST_M away: for cells that contain the origin, towards their centres."""
    length = np.linalg.norm(nearest, axis=1, keepdims=True)
    towards = np.where(length > 0, nearest, centres)
    size = np.linalg.norm(towards, axis=1, keepdims=True)
    return np.where(length >= LEAST_M, nearest, LEAST_M * towards / np.where(size > 0, size, 1))


def _nearest_in_each(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nearest of places (N, 3) in each direction; see AP_Proximity_Boundary_3D.h, `get_face`."""
    length = np.linalg.norm(places, axis=1)
    yaw = np.degrees(np.arctan2(places[:, 1], places[:, 0])) % 360
    pitch = np.degrees(np.arctan2(-places[:, 2], np.hypot(places[:, 0], places[:, 1])))
    sector = ((yaw + SECTOR_DEG / 2) % 360 // SECTOR_DEG).astype(int)
    layer = np.clip((pitch + LAYERS * LAYER_DEG / 2) // LAYER_DEG, 0, LAYERS - 1).astype(int)
    face, order = layer * (360 // SECTOR_DEG) + sector, np.argsort(length, kind="stable")
    _, first = np.unique(face[order], return_index=True)
    return places[order[first]]
