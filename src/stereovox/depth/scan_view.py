# SPDX-License-Identifier: Apache-2.0
"""Where a camera looks, as a scan sees it: its rays in a level frame, the rows that look level, the beams it covers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage
from stereovox.rigs import VirtualCamera

STEEPEST_DEG = 80.0
"""Rays steeper than this have no direction on the floor to speak of: they say nothing."""
FINEST_STEP = float(np.radians(0.01))
"""Narrowest beam in radians, for cameras that would have narrower ones."""


class Directions(NamedTuple):
    """Where the beams of a scan point: the first, the step between two (radians), and how many there are."""

    first: float
    step: float
    number: int


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays through pixels' middles and borders, as `camera.rays()`: columns (n,), rows (m, 2), of borders one more."""

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


@lru_cache(maxsize=8)
def rays_of(camera: VirtualCamera) -> Rays:
    """Return the rays of a camera; a border's ray is halfway between two pixels'."""
    columns, rows = camera.rays()
    return Rays(columns, rows, _borders(columns), np.ascontiguousarray(_borders(rows)))


def levelled(image: DepthImage) -> tuple[NDArray[np.float64], float]:
    """Return what turns the optical frame into forward, left, up (3, 3), and the yaw of forward in the world.

    Raises FrameRefused `camera_vertical` where the camera looks so steeply that there is no forward.
    """
    R = image.T_world_sensor[:3, :3]
    ahead = R[:, 2]
    if np.hypot(ahead[0], ahead[1]) < np.cos(np.radians(STEEPEST_DEG)):
        raise FrameRefused(
            "camera_vertical",
            f"{name(image)}: the camera looks straight {'up' if ahead[2] > 0 else 'down'}, where no scan can be;"
            " check its pose (z of the world must point up)",
        )
    yaw = float(np.arctan2(ahead[1], ahead[0]))
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]]) @ R, yaw


def level_rows(image: DepthImage, rays: Rays, turn: NDArray[np.float64], number: int, off_level_deg: float) -> slice:
    """Return `number` rows round the one that looks level, fewer at the image's border.

    Raises FrameRefused `camera_tilted` where a ray of that row is more than `off_level_deg` off the level.
    """
    forward, _, up = turn @ np.column_stack([np.zeros(len(rays.rows)), rays.rows]).T
    middle = int(np.argmin(np.where(forward > 0, np.abs(np.arctan2(up, forward)), np.inf)))
    ends = np.column_stack([rays.columns[[0, -1]], rays.rows[[middle, middle]]]) @ turn.T
    off = float(np.degrees(np.abs(np.arctan2(ends[:, 2], np.hypot(ends[:, 0], ends[:, 1]))).max()))
    if off > off_level_deg:
        raise FrameRefused(
            "camera_tilted",
            f"{name(image)}: the camera is tilted: its most level row is {off:.1f} deg off the level, more than"
            f" scan.off_level_deg {off_level_deg:g}; set scan.method=cloud",
        )
    first = middle - (number - 1) // 2
    return slice(max(first, 0), min(first + number, len(rays.rows)))


def directions(rays: Rays, turn: NDArray[np.float64], step: float) -> tuple[Directions, float]:
    """Return the beams of `step` radians that a view covers, and the cosine of how steep it looks at most.

    A view that looks straight down or up somewhere has beams all over the half circle ahead, and no more.
    """
    forward, left, up = rays.border(turn)
    way = np.hypot(forward, left)
    flattest = float(np.cos(np.radians(STEEPEST_DEG)))
    flat = float((way / np.hypot(way, up)).min())
    ends = (-np.pi / 2, np.pi / 2)
    if forward.min() > 0 and flat > flattest:
        tangent = left / forward
        ends = float(np.arctan(tangent.min())), float(np.arctan(tangent.max()))
    first, last = int(np.floor(ends[0] / step + 1e-3)), int(np.ceil(ends[1] / step - 1e-3))
    return Directions((first + 0.5) * step, step, max(last - first, 1)), max(flat, flattest)


def check_heights(
    image: DepthImage, rays: Rays, turn: NDArray[np.float64], heights: tuple[float, float], far: float
) -> None:
    """Raise FrameRefused `heights_not_seen` where no ray is within `heights` before `far` metres of depth."""
    (low, high), at = heights, float(image.T_world_sensor[2, 3])
    across, rise = turn[2, 0] * rays.columns, rays.rows @ turn[2, 1:]
    lowest = at + far * min(float(across.min() + rise.min()), 0.0)
    highest = at + far * max(float(across.max() + rise.max()), 0.0)
    if lowest > high or highest < low:
        raise FrameRefused(
            "heights_not_seen",
            f"{name(image)}: the camera, {at:.2f} m high, sees nothing of scan.heights {low:g} to {high:g} m;"
            " set scan.heights, or check the camera's pose",
        )


def pixel_angle(camera: VirtualCamera) -> float:
    """Return the angle of a pixel in the middle of the image in radians."""
    return max(camera.binning / camera.focal_px, FINEST_STEP)


def name(image: DepthImage) -> str:
    """Return what to call an image in a message."""
    return f"frame at {image.stamp_ns} ns"


def _borders(middles: NDArray[np.float32]) -> NDArray[np.float32]:
    if len(middles) == 1:
        return np.repeat(middles, 2, axis=0)
    between = (middles[1:] + middles[:-1]) * np.float32(0.5)
    ends = middles[[0, -1]] + (middles[[0, -1]] - between[[0, -1]])
    return np.concatenate([ends[:1], between, ends[1:]])
