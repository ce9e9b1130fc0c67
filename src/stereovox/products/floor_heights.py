# SPDX-License-Identifier: Apache-2.0
"""The height of the floor at each place of a map, or that it is unknown: what all 2-D products measure heights from.

A map's world may begin anywhere: z = 0 of a tracked map is where the camera began. So heights that matter to a robot
are never measured from the world's origin, unless a user states that the floor lies at a certain height there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.products.floor_axes import check_level, floor_axes
from stereovox.products.floor_search import FloorSearch
from stereovox.products.ground_surfaces import NO_SURFACE, floor_of, place_of
from stereovox.threads import one_state

REACH = 0.5
"""Metres from the nearest floor that was seen, within which its height holds."""
SMOOTHED = 5
"""Cells along the sides of the square of which a floor's height is the median: one noisy cell does not lift it."""


@dataclass(frozen=True, eq=False)
class FloorHeights:
    """The height of the floor at each place of a map, seen from above; row 0 and column 0 are the lowest.

    Attributes:
        height: (rows, columns) float32, metres along the map's `up` from the world's origin: of the nearest floor that
            was seen. NaN if there is none at all.
        away: (rows, columns) float32, horizontal metres to that floor; 0 where it was seen itself.
        resolution: Side of a cell in metres.
        origin: x, y, yaw of the corner of cell (0, 0), in the axes of `projection.project`.
        up: The axis of the map that points up.
        elsewhere: Height in metres of the floor outside of the picture; NaN if it is unknown there.
    """

    height: NDArray[np.float32]
    away: NDArray[np.float32]
    resolution: float
    origin: tuple[float, float, float]
    up: str
    elsewhere: float = float("nan")

    @classmethod
    def level(cls, height: float, up: str = "z") -> FloorHeights:
        """Return a floor that is level everywhere, because the user states so.

        Args:
            height: Metres along `up` from the world's origin.
            up: The axis of the map that points up.

        Raises:
            StereovoxError: The height is not finite.
        """
        if not np.isfinite(height):
            raise StereovoxError(f"floor {height}: give the height of the floor in metres from the world's origin")
        nothing = np.empty((0, 0), np.float32)
        return cls(nothing, nothing, 1.0, (0.0, 0.0, 0.0), up, float(height))

    @classmethod
    def unknown(cls, up: str = "z") -> FloorHeights:
        """Return a floor whose height is known nowhere."""
        nothing = np.empty((0, 0), np.float32)
        return cls(nothing, nothing, 1.0, (0.0, 0.0, 0.0), up)

    @property
    def known(self) -> bool:
        """Whether the height is known anywhere."""
        return bool(np.isfinite(self.elsewhere) or np.isfinite(self.height).any())

    def at(self, points: ArrayLike, reach: float = REACH) -> NDArray[np.float64]:
        """Return the height of the floor below or above places.

        Args:
            points: (N, 3) metres, world frame.
            reach: Metres to the nearest floor that was seen within which its height holds.

        Returns:
            (N,) metres along `up` from the world's origin; NaN if the floor is unknown there.
        """
        x, y, _, _ = floor_axes(self.up)
        across = np.asarray(points, float).reshape(-1, 3)[:, [x, y]]
        columns, rows = np.floor((across - self.origin[:2]) / self.resolution + 1e-9).astype(np.int64).T
        inside = (rows >= 0) & (columns >= 0) & (rows < self.height.shape[0]) & (columns < self.height.shape[1])
        found = np.full(len(across), self.elsewhere)
        near = self.away[rows[inside], columns[inside]] <= reach
        found[inside] = np.where(near, self.height[rows[inside], columns[inside]], self.elsewhere)
        return found


@one_state
def find_floor(voxel_map: VoxelMap, start: ArrayLike | None = None) -> FloorHeights:
    """Find the floor of a map: heights per place, so that it may slope, and have steps of up to 0.1 m.

    The floor is the lowest large surface near and below the camera of the last frame, with room for 1.8 m above it, and
    what continues it (`floor_search`). Where it was not seen the nearest floor's height stands, with its distance.

    Args:
        voxel_map: The map.
        start: (3,) metres, near the floor that counts instead, of several storeys or steps.

    Returns:
        The floor's height at each place, unknown everywhere if the map shows no floor.

    Raises:
        StereovoxError: The map is too large or not level, or `start` is no place.
    """
    from scipy.ndimage import distance_transform_edt, median_filter

    check_level(voxel_map.config)
    if voxel_map.bounds() is None:
        return FloorHeights.unknown(voxel_map.config.up)
    floor, viewpoint = floor_of(voxel_map), voxel_map.viewpoint
    here = None if start is None else place_of(floor, start)
    camera = None if viewpoint is None else place_of(floor, viewpoint.T_world_camera[:3, 3])
    levels = FloorSearch(floor, here, camera).levels()
    if (levels == NO_SURFACE).all():
        return FloorHeights.unknown(voxel_map.config.up)
    away, nearest = map(np.asarray, distance_transform_edt(levels == NO_SURFACE, return_indices=True) or ())
    height = (median_filter(levels[tuple(nearest)], SMOOTHED, mode="nearest") - 0.5) * floor.side
    return FloorHeights(
        height.astype(np.float32), (away * floor.resolution).astype(np.float32), floor.resolution, floor.origin,
        voxel_map.config.up,
    )  # fmt: skip
