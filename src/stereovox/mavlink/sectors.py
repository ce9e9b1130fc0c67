# SPDX-License-Identifier: Apache-2.0
"""MAVLink's OBSTACLE_DISTANCE from a map: the known free distance in 72 sectors around a vehicle.

The message (https://mavlink.io/en/messages/common.html#OBSTACLE_DISTANCE): whole centimetres; element i is at
`angle_offset + i * increment` degrees, clockwise seen from above, from the vehicle's front in MAV_FRAME_BODY_FRD;
`max_distance + 1` means no obstacle, UINT16_MAX unknown. The behaviour of its readers decides how it is filled here:


- PX4 1.14 has sectors of 10 degrees and takes element `ceil(angle / increment)` for each, every second one of 72
  (CollisionPrevention.cpp, `_addObstacleSensorData`). Elements therefore overlap (`overlap_deg`).
- PX4 ignores elements up to `min_distance`, and ArduPilot ignores these and 0 (AP_Proximity_MAV.cpp,
  `handle_obstacle_distance_msg`): the nearest obstacle would not count. `min_distance` is therefore 0 and an obstacle
  that touches the vehicle is at 1 cm.
- UINT16_MAX leaves PX4's sector unchanged for up to 0.5 s, during which the vehicle may turn; then it does not fly
  there (`CP_GO_NO_DATA` = 0). ArduPilot treats it as free. The default is therefore to send where the unknown begins,
  as if an obstacle were there; both stop before it.
- PX4 turns elements by the vehicle's yaw only, so sectors are level, whatever its roll and pitch.

MAVLink's OBSTACLE_DISTANCE_3D from a map: the nearest obstacle in each direction, including up and down.

One message is one place (https://mavlink.io/en/messages/ardupilotmega.html#OBSTACLE_DISTANCE_3D), in metres along the
body's own front, right and down (MAV_FRAME_BODY_FRD, the only frame ArduPilot reads). ArduPilot keeps the nearest place
in each of 8 sectors of 45 degrees in 5 layers of 30 (AP_Proximity_Boundary_3D.h); messages of one `time_boot_ms` that
follow each other within 50 ms form one scan, and a new time starts a new scan, in which directions without a
message are free (AP_Proximity_MAV.cpp, `handle_obstacle_distance_3d_msg`). PX4 does not read this message.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, inf
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import Transform, rigidity_error
from stereovox.maps import State, VoxelMap
from stereovox.maps.voxel_map import leaning
from stereovox.products.floor_axes import up_of, upright_axes

SECTORS = 72
INCREMENT_DEG = 360 / SECTORS
UNKNOWN = 0xFFFF
"""UINT16_MAX: unknown."""
NEAREST_CM = 1
"""Least distance sent: ArduPilot ignores 0, and so does PX4 if it is `min_distance`."""
MAX_CELLS = 20_000_000
"""Most cells inspected for one message."""
LEVEL_ERROR = 0.02
"""Length by which the map's `up` may miss its true direction (1.1 degrees)."""
STEEPEST = 0.1
"""Least horizontal length of the forward axis, a unit vector: 84 degrees of pitch."""
UnknownAs = Literal["obstacle", "unmeasured"]


@dataclass(frozen=True)
class SectorRules:
    """Rules for reading sectors from a map.

    Attributes:
        max_distance: Horizontal metres up to which cells are inspected, at most 655.
        half_height: Metres above and below the body's origin within which cells count; more than the vehicle reaches,
            roll and pitch included.
        overlap_deg: Degrees by which each sector reaches into its neighbours on either side, 0 to 45.
        own_radius: Horizontal metres around the body within which unknown and tentative cells count as the vehicle's
            own place. A camera does not see them before take-off; later no unknown cell gets this near, because the
            vehicle stops before the unknown. Occupied cells there count.
        oldest_s: Free cells whose last evidence is older count as unknown (needs `map.keep_times`); infinite: none.
        unknown: Value for unknown space before an obstacle: `obstacle`, the distance at which it begins;
            `unmeasured`, UINT16_MAX.

    Raises:
        StereovoxError: A value is out of range.
    """

    max_distance: float = 5.0
    half_height: float = 0.3
    overlap_deg: float = 5.0
    own_radius: float = 0.5
    oldest_s: float = inf
    unknown: UnknownAs = "obstacle"

    def __post_init__(self) -> None:
        _check("max_distance", self.max_distance, 0.1, 655)
        _check("half_height", self.half_height, 0, 100)
        _check("overlap_deg", self.overlap_deg, 0, 45)
        _check("own_radius", self.own_radius, 0, self.max_distance)
        _check("oldest_s", self.oldest_s, 0, inf)
        if self.unknown not in get_args(UnknownAs):
            raise StereovoxError(f"unknown '{self.unknown}': use {' or '.join(get_args(UnknownAs))}")

    @property
    def max_cm(self) -> int:
        """`max_distance` of the message, in whole centimetres."""
        return floor(100 * self.max_distance + 1e-6)


class Sectors(NamedTuple):
    """The sectors of a map. Sector i is centred at 5 i degrees clockwise of the vehicle's front.

    Attributes:
        obstacle_m: (72,) float64 horizontal metres from the body's origin to the nearest cell that is occupied, or
            tentative beyond `own_radius`; infinite: none up to `max_distance`.
        unknown_m: (72,) float64 the same for cells beyond `own_radius` that are unknown, or tentative although evidence
            has made them no likelier: space that is not free yet.
    """

    obstacle_m: NDArray[np.float64]
    unknown_m: NDArray[np.float64]

    @property
    def free_m(self) -> NDArray[np.float64]:
        """(72,) float64 metres of known free space; infinite: up to `max_distance`."""
        return np.minimum(self.obstacle_m, self.unknown_m)

    def centimetres(self, rules: SectorRules) -> NDArray[np.uint16]:
        """Return the message's `distances` (72,), rounded down.

        Args:
            rules: The rules that the sectors were made with.
        """
        free_m = self.free_m
        whole = np.floor(100 * np.minimum(free_m, rules.max_distance) + 1e-6)
        cm = np.where(np.isinf(free_m), rules.max_cm + 1, np.clip(whole, NEAREST_CM, rules.max_cm))
        if rules.unknown == "unmeasured":
            cm[self.unknown_m < self.obstacle_m] = UNKNOWN
        return cm.astype(np.uint16)


class Heading(NamedTuple):
    """The horizontal plane through a body. axes: (3, 3) rows x, y and up as directions in the world."""

    axes: NDArray[np.float64]
    forward: NDArray[np.float64]
    """(2,) unit vector, x and y."""


def obstacle_sectors(voxel_map: VoxelMap, T_world_body: Transform, rules: SectorRules | None = None) -> Sectors:
    """Return the known free distance in sectors around a body.

    A cell counts in all sectors that it reaches into, with the distance of its nearest point.

    Args:
        voxel_map: The map, with `up` along one of its axes.
        T_world_body: (4, 4) maps the body (optical axes: x right, y down, z forward) into the world.
        rules: What to inspect; by default `SectorRules()`.

    Returns:
        The nearest obstacle and the nearest unknown of each sector.

    Raises:
        StereovoxError: The pose is not rigid or looks straight up or down, the map is tilted, or there are too
            many cells to inspect.
    """
    rules = rules or SectorRules()
    heading, cell = heading_of(voxel_map, T_world_body), np.asarray(voxel_map.config.cell)
    upright = [int(np.argmax(np.abs(axis))) for axis in heading.axes]
    low, high = _spans(T_world_body[:3, 3], cell, upright, rules)
    states = _states(voxel_map, cell, low, high, rules.oldest_s)
    columns = np.moveaxis(states, upright, (0, 1, 2))
    flat = _Columns(T_world_body[:3, 3], heading, cell, low, upright, columns.shape[:2], rules)
    occupied, tentative = (columns == State.OCCUPIED).any(axis=2), (columns == State.TENTATIVE).any(axis=2)
    obstacle = occupied | (tentative & ~flat.own)
    unknown = (columns == State.UNKNOWN).any(axis=2) & ~flat.own
    return Sectors(flat.nearest(obstacle), flat.nearest(unknown))


def heading_of(voxel_map: VoxelMap, T_world_body: Transform) -> Heading:
    """Return a body's heading in the map's horizontal plane; raises StereovoxError as `obstacle_sectors` does."""
    if not rigidity_error(T_world_body) < 1e-3:
        raise StereovoxError("T_world_body is no rigid motion (4, 4); give a rotation and metres")
    axes = upright_axes(voxel_map.config.up)
    if np.linalg.norm(up_of(voxel_map.config) - axes[2]) > LEVEL_ERROR:
        raise StereovoxError("the map's world is tilted, so no height is level in it; map with --level")
    forward = axes[:2] @ T_world_body[:3, 2]
    length = float(np.linalg.norm(forward))
    if length < STEEPEST:
        raise StereovoxError("the body looks straight up or down and has no heading; is its mount right?")
    return Heading(axes, forward / length)


class _Columns:
    """Columns of cells around a body: distance and bearings of each, all (n, m)."""

    def __init__(
        self,
        origin: NDArray[np.float64],
        heading: Heading,
        cell: NDArray[np.float64],
        low: NDArray[np.int64],
        upright: list[int],
        shape: tuple[int, ...],
        rules: SectorRules,
    ):
        here, faces = heading.axes[:2] @ origin, []
        for axis, number in enumerate(shape):
            edges = (low[upright[axis]] + np.arange(number + 1)) * cell[upright[axis]] - here[axis]
            faces.append(np.stack([edges[:-1], edges[1:]]))
        x, y = faces[0][:, :, None], faces[1][:, None, :]
        nearest = [np.maximum(np.maximum(side[0], -side[1]), 0) for side in (x, y)]
        self._away = np.hypot(*nearest)
        self._x, self._y, self._forward = x, y, heading.forward
        self._within = self._away <= rules.max_distance
        self._half_deg = INCREMENT_DEG / 2 + rules.overlap_deg
        self.own = np.hypot(x.mean(axis=0), y.mean(axis=0)) <= rules.own_radius

    def nearest(self, chosen: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return the distance (72,) of the nearest chosen column in each sector, infinite if missing."""
        row, column = np.nonzero(chosen & self._within)
        away = self._away[row, column]
        first, last = self._reach(row, column)
        first[away == 0], last[away == 0] = 0, SECTORS - 1  # all sectors
        found = np.full(SECTORS, inf)
        for step in range(int((last - first).max(initial=-1)) + 1):
            reached = first + step <= last
            np.minimum.at(found, (first + step)[reached] % SECTORS, away[reached])
        return found

    def _reach(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first and last sector, not wrapped, that each column overlaps."""
        x, y = self._x[:, row, 0], self._y[:, 0, column]
        middle = self._bearing_deg(x.mean(axis=0), y.mean(axis=0))
        corners = np.stack([self._bearing_deg(x[i], y[j]) for i in (0, 1) for j in (0, 1)])
        off = (corners - middle + 180) % 360 - 180
        first = np.ceil((middle + off.min(axis=0) - self._half_deg) / INCREMENT_DEG - 1e-9)
        last = np.floor((middle + off.max(axis=0) + self._half_deg) / INCREMENT_DEG + 1e-9)
        return first.astype(np.int64), np.minimum(last, first + SECTORS - 1).astype(np.int64)

    def _bearing_deg(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return degrees clockwise of the front, seen from above."""
        ahead, left = self._forward @ np.stack([x, y]), self._forward @ np.stack([y, -x])
        return np.degrees(np.arctan2(-left, ahead))


def _spans(
    origin: NDArray[np.float64], cell: NDArray[np.float64], upright: list[int], rules: SectorRules
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the lowest and highest cell (3,) to inspect, in the map's axes."""
    reach = np.full(3, rules.max_distance)
    reach[upright[2]] = rules.half_height
    low = np.floor((origin - reach) / cell).astype(np.int64)
    high = np.floor((origin + reach) / cell).astype(np.int64)
    check_number_of_cells(low, high)
    return low, high


def check_number_of_cells(low: NDArray[np.int64], high: NDArray[np.int64]) -> None:
    """Raise StereovoxError if a box of cells is too large to inspect for each message."""
    number = np.prod((high - low + 1).astype(float))
    if number > MAX_CELLS:
        raise StereovoxError(f"{number:.0f} cells for one message; lessen max_distance, or map with larger cells")


def _states(
    voxel_map: VoxelMap, cell: NDArray[np.float64], low: NDArray[np.int64], high: NDArray[np.int64], oldest_s: float
) -> NDArray[np.uint8]:
    """Return the `states_of` a box of cells (i, j, k)."""
    shape = tuple(high - low + 1)
    centres = np.empty((*shape, 3))
    for axis in range(3):
        line = (low[axis] + np.arange(shape[axis]) + 0.5) * cell[axis]
        centres[..., axis] = line.reshape([-1 if other == axis else 1 for other in range(3)])
    return states_of(voxel_map, centres.reshape(-1, 3), oldest_s).reshape(shape)


def states_of(voxel_map: VoxelMap, points: NDArray[np.float64], oldest_s: float) -> NDArray[np.uint8]:
    """Return the states (N,) of points (N, 3).

    What is not free yet is unknown: tentative cells no likelier than the prior, and free ones whose evidence is older
    than `oldest_s`.
    """
    with voxel_map.lock:
        states = leaning(voxel_map, points, State.UNKNOWN)
        if oldest_s < inf:
            free = np.flatnonzero(states == State.FREE)
            states[free[~(voxel_map.age(points[free]) <= oldest_s)]] = State.UNKNOWN
    return states


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise StereovoxError(f"{name} {value:g}: give a number from {low:g} to {high:g}")


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
