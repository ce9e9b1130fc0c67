# SPDX-License-Identifier: Apache-2.0
"""Reduce a depth image to the scan of a 2-D lidar at the camera's position (IST 2019, III-C)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.depth import _cloud
from stereovox.errors import ConfigError, FrameRefused
from stereovox.frame import DepthImage, Reason, Scan
from stereovox.geometry.se2 import lifted

STEEPEST_DEG = 80.0
"""Steeper rays have no usable direction on the floor and are ignored."""
STEEPEST = np.tan(np.radians(STEEPEST_DEG))
FINEST_STEP = float(np.radians(0.01))
"""Narrowest beam in radians."""
FLOOR_NOISE = 1.25
"""Factor on the smallest measured depth within which TOO_NEAR may be the floor."""
SPARSE = 4
"""Step between the rows and columns that are searched for that depth."""
DEEP, MOST_DEEP = 0.3, 0.1
"""At most this share of the visible points is this many metres below the floor, as on stairs that lead down."""
WHOLE = 1e-3
"""A beam that is free up to `range_max` less this share counts as free up to it, since rays are not exactly level."""


def scan_of(image: DepthImage, config: Config) -> Scan:
    """Return the scan of a depth image; the floor is level, at `scan.floor`, or else at 0.

    The scan's sensor is at the camera, upright, with its x axis along the camera's viewing direction; ranges are metres
    along the floor. The mount on the robot is not known here: `T_base_sensor` is the identity. `scan.method` `rows`
    takes the nearest of a few rows round the level one (the job of depthimage_to_laserscan), `cloud` the nearest of all
    points within `scan.heights` (pointcloud_to_laserscan). A pixel belongs to each beam whose centre it covers, or else
    to the one that contains its own centre. Any camera will do; rays that point backwards or are steeper than 80
    degrees are ignored.

    A beam is -inf, and free nowhere, if something too near may be within the heights; else it has the range
    of its nearest point; else +inf if it is free all the way to `max_range`, else NaN. `clear` is the distance up to
    which some ray of the beam was seen to be free *within the heights*. Beyond the end of all its rays, or their exit
    from the heights, it is unknown. One ray is enough, as with a lidar: an object lower than all rays of its beam is
    not seen, and its place counts as free. Points beyond `max_range` along the floor are dropped: their rays are free
    up to there.

    Raises FrameRefused: `camera_tilted` if no row is level (method `rows`), `camera_vertical` if the camera
    points straight up or down, `heights_not_seen` if no ray meets the heights; ConfigError if z is not up.
    """
    if config.up.removeprefix("+") != "z":
        raise ConfigError(f"up {config.up}: scans need a world whose z axis points up; rotate the poses, and set up=z")
    turn, yaw = levelled(image)
    rays, rows, heights = rays_of(image.camera), slice(0, image.camera.height), config.scan.heights
    if config.scan.method == "rows":
        rows = level_rows(image, rays, turn, config.scan.rows, config.scan.off_level_deg)
        rays, heights = rays.of_rows(rows), (-np.inf, np.inf)
    camera = float(image.T_world_sensor[2, 3]) - (config.scan.floor or 0.0)
    check_heights(image, rays, turn, heights, config.max_range, camera)
    step = config.scan.angle_step_deg
    where, flattest = directions(rays, turn, pixel_angle(image.camera) if step is None else np.radians(step))
    depths = config.min_range, config.max_range
    floor = FLOOR_NOISE * max(config.min_range, nearest(image)) if heights[0] > 0 else 0.0
    band = Band(*np.array([*heights, camera, *depths, config.max_range, STEEPEST, floor], np.float32))
    beams = _gathered(image.depth_m[rows], image.reason[rows], rays, turn, band, where)
    closest = blind(beams, band) if config.scan.method == "cloud" else np.zeros(1, np.float32)
    ranges, clear, clear_from = _to_ranges(beams, config.max_range, closest)
    T = lifted([*image.T_world_sensor[:2, 3], yaw])
    T[2, 3] = image.T_world_sensor[2, 3]
    return Scan(
        ranges, where.first, where.step, config.min_range * flattest, config.max_range, T,
        clear=clear, clear_from=clear_from, stamp_ns=image.stamp_ns,
    )  # fmt: skip


class Directions(NamedTuple):
    """Directions of the beams of a scan: the first, the step between two (radians), and their number."""

    first: float
    step: float
    number: int


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays through pixels' centres and borders, as `camera.rays()`: columns (n,), rows (m, 2); one more for borders."""

    columns: NDArray[np.float32]
    rows: NDArray[np.float32]
    edge_columns: NDArray[np.float32]
    edge_rows: NDArray[np.float32]

    def of_rows(self, rows: slice) -> Rays:
        """Return the rays of rows `rows.start` to `rows.stop`."""
        edges = self.edge_rows[rows.start : rows.stop + 1]
        return Rays(self.columns, self.rows[rows], self.edge_columns, edges)

    def border(self, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rays (3, N) along the image's border, turned by (3, 3)."""
        across, down = turn[:, :1], turn[:, 1:]
        sides = [across * self.edge_columns + down @ row[:, None] for row in self.edge_rows[[0, -1]]]
        ends = [across * column + down @ self.edge_rows.T for column in self.edge_columns[[0, -1]]]
        return np.concatenate([*sides, *ends], axis=1)


class Band(NamedTuple):
    """Heights and ranges that count, in metres; near and far are depths, range_max a distance along the floor."""

    low: np.float32
    high: np.float32
    camera: np.float32
    near: np.float32
    far: np.float32
    range_max: np.float32
    steepest: np.float32  # rise per metre along the floor from which a ray is ignored
    floor: np.float32  # depth up to which TOO_NEAR may be the floor; 0 if the floor is an obstacle


class Fan(NamedTuple):
    """A ray `angle` radians to the left is at angle * per_radian + offset; beam b spans b - 0.5 to b + 0.5."""

    per_radian: np.float32
    offset: np.float32
    last: np.float32


class Beams(NamedTuple):
    """State of the beams, (N,) arrays as the kernel writes them, in metres along the floor."""

    hit: NDArray[np.float32]  # inf: none; -inf: something is nearer than the camera can measure
    start: NDArray[np.float32]  # free from here
    end: NDArray[np.float32]  # up to here; 0: nowhere
    lowest: NDArray[np.float32]  # rise of its lowest ray per metre along the floor; inf: it has no ray
    unmeasured: NDArray[np.float32]  # nothing is measured nearer than this


@lru_cache(maxsize=8)
def rays_of(camera: VirtualCamera) -> Rays:
    """Return the rays of a camera; a border's ray is halfway between two pixels'."""
    columns, rows = camera.rays()
    return Rays(columns, rows, _borders(columns), np.ascontiguousarray(_borders(rows)))


def levelled(image: DepthImage) -> tuple[NDArray[np.float64], float]:
    """Return the rotation (3, 3) from the optical frame to forward, left, up, and the yaw of forward in the world.

    Raises FrameRefused `camera_vertical` if the camera points so steeply that there is no forward direction.
    """
    R = image.T_world_sensor[:3, :3]
    ahead = R[:, 2]
    if np.hypot(ahead[0], ahead[1]) < np.cos(np.radians(STEEPEST_DEG)):
        raise FrameRefused(
            "camera_vertical",
            f"{name(image)}: the camera points straight {'up' if ahead[2] > 0 else 'down'}, which gives no scan;"
            " check its pose (z of the world must point up)",
        )
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) @ R, yaw


def level_rows(image: DepthImage, rays: Rays, turn: NDArray[np.float64], number: int, off_level_deg: float) -> slice:
    """Return `number` rows round the level one, fewer at the image's border.

    Raises FrameRefused `camera_tilted` if a ray of that row is more than `off_level_deg` off the horizon.
    """
    forward, _, up = turn @ np.column_stack([np.zeros(len(rays.rows)), rays.rows]).T
    middle = int(np.argmin(np.where(forward > 0, np.abs(np.arctan2(up, forward)), np.inf)))
    ends = np.column_stack([rays.columns[[0, -1]], rays.rows[[middle, middle]]]) @ turn.T
    off = float(np.degrees(np.abs(np.arctan2(ends[:, 2], np.hypot(ends[:, 0], ends[:, 1]))).max()))
    if off > off_level_deg:
        raise FrameRefused(
            "camera_tilted",
            f"{name(image)}: the camera is tilted: its most level row is {off:.1f} deg off the horizon, more than"
            f" scan.off_level_deg {off_level_deg:g}; set scan.method=cloud",
        )
    first = middle - (number - 1) // 2
    return slice(max(first, 0), min(first + number, len(rays.rows)))


def directions(rays: Rays, turn: NDArray[np.float64], step: float) -> tuple[Directions, float]:
    """Return the beams of `step` radians that a view covers, and the cosine of its steepest angle.

    A view that includes straight down or up has beams over the whole half circle ahead, and no more.
    """
    forward, left, up = rays.border(turn)
    floor_m = np.hypot(forward, left)
    flattest = float(np.cos(np.radians(STEEPEST_DEG)))
    flat = float((floor_m / np.hypot(floor_m, up)).min())
    ends = (-np.pi / 2, np.pi / 2)
    if forward.min() > 0 and flat > flattest:
        tangent = left / forward
        ends = float(np.arctan(tangent.min())), float(np.arctan(tangent.max()))
    first, last = int(np.floor(ends[0] / step + 1e-3)), int(np.ceil(ends[1] / step - 1e-3))
    return Directions((first + 0.5) * step, step, max(last - first, 1)), max(flat, flattest)


def check_heights(
    image: DepthImage, rays: Rays, turn: NDArray[np.float64], heights: tuple[float, float], far: float, at: float
) -> None:
    """Raise FrameRefused `heights_not_seen` if no ray is within `heights` up to `far` metres of depth.

    at: height of the camera above the floor in metres.
    """
    low, high = heights
    across, rise = turn[2, 0] * rays.columns, rays.rows @ turn[2, 1:]
    lowest = at + far * min(float(across.min() + rise.min()), 0.0)
    highest = at + far * max(float(across.max() + rise.max()), 0.0)
    if lowest > high or highest < low:
        raise FrameRefused(
            "heights_not_seen",
            f"{name(image)}: the camera, {at:.2f} m high, sees nothing of scan.heights {low:g} to {high:g} m;"
            " set scan.heights, or check the camera's pose",
        )


def check_floor(image: DepthImage, config: Config) -> None:
    """Raise FrameRefused `below_floor` if an image shows that the floor is not at `scan.floor`, or at 0.

    The camera, or much of what it sees, is then below it, as in a world that begins at the camera: obstacles would be
    below the heights that count, and their places would be free.
    """
    at = float(image.T_world_sensor[2, 3]) - (config.scan.floor or 0.0)
    some = (slice(None, None, SPARSE), slice(None, None, SPARSE))
    columns, rows = image.camera.rays()
    upward = image.T_world_sensor[2, :3]
    rise = upward[0] * columns[None, ::SPARSE] + (rows[::SPARSE] @ upward[1:])[:, None]
    deep = (at + image.depth_m[some] * rise)[image.reason[some] == Reason.VALID] < -DEEP
    share = float(deep.mean()) if deep.size else 0.0
    if at <= 0 or share > MOST_DEEP:
        raise FrameRefused(
            "below_floor",
            f"{name(image)}: the camera is {at:.2f} m above the floor of the settings, and {share:.0%} of what it sees"
            " is below that floor; set scan.floor to the floor's height in the world of the poses, in metres",
        )


def pixel_angle(camera: VirtualCamera) -> float:
    """Return the angle of a pixel in the middle of the image in radians."""
    return max(camera.binning / camera.focal_px, FINEST_STEP)


def blind(beams: Beams, band: Band) -> NDArray[np.float32]:
    """Return the distance up to which each beam cannot see objects on the floor, (N,) metres along it; inf: everywhere.

    Up to there its lowest ray is still above the lowest height, or the camera measures nothing so near.
    """
    drop = max(band.camera - band.low, np.float32(0))
    with np.errstate(divide="ignore"):
        sunk = np.where(beams.lowest < 0, drop / -beams.lowest, np.float32(np.inf if drop else 0))
    return np.maximum(sunk, beams.unmeasured)


def nearest(image: DepthImage) -> float:
    """Return roughly the smallest depth in metres in the image (its 1st percentile); 0 if it has none.

    The camera's real minimum depth may exceed `min_range` without being reported.
    """
    some = (slice(None, None, SPARSE), slice(None, None, SPARSE))
    known = image.depth_m[some][image.reason[some] == Reason.VALID]
    return float(np.partition(known, len(known) // 100)[len(known) // 100]) if known.size else 0.0


def name(image: DepthImage) -> str:
    """Return the name of an image for messages."""
    return f"frame at {image.stamp_ns} ns"


def _gathered(
    depth_m: NDArray[np.float32],
    reason: NDArray[np.uint8],
    rays: Rays,
    turn: NDArray[np.float64],
    band: Band,
    where: Directions,
) -> Beams:
    n = where.number
    start, end, unmeasured = np.zeros((3, n), np.float32)
    beams = Beams(np.full(n, np.inf, np.float32), start, end, np.full(n, np.inf, np.float32), unmeasured)
    fan = Fan(np.float32(1 / where.step), np.float32(-where.first / where.step), np.float32(n - 1))
    _cloud.gather(
        depth_m, reason, rays.columns, rays.rows, rays.edge_columns, rays.edge_rows, turn.astype(np.float32), band, fan,
        beams, np.empty((9, len(rays.edge_columns)), np.float32),
    )  # fmt: skip
    return beams


def _to_ranges(
    beams: Beams, range_max: float, closest: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return the ranges of the beams (REP 117), and the end and start of their free part, which is at least
    `closest`."""
    clear = np.minimum(beams.end, beams.hit).clip(min=0)
    clear[clear <= beams.start] = 0
    whole = (clear >= range_max * (1 - WHOLE)) & (beams.start == 0)
    ranges = np.where(whole, np.float32(np.inf), np.float32(np.nan))
    np.copyto(ranges, beams.hit, where=beams.hit < np.inf)
    clear_from = np.maximum(beams.start, closest)
    clear[clear <= clear_from] = 0
    clear_from[clear == 0] = 0
    return ranges, clear, clear_from


def _borders(middles: NDArray[np.float32]) -> NDArray[np.float32]:
    if len(middles) == 1:
        return np.repeat(middles, 2, axis=0)
    between = (middles[1:] + middles[:-1]) * np.float32(0.5)
    ends = middles[[0, -1]] + (middles[[0, -1]] - between[[0, -1]])
    return np.concatenate([ends[:1], between, ends[1:]])
