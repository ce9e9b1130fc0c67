# SPDX-License-Identifier: Apache-2.0
"""Thickness, straightness and squareness of known walls in a map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.truth import Keys, indices, keys, occupied_cells, position
from stereovox.maps import VoxelMap
from stereovox.simulate.scene import Solid

REACH = 0.4
"""Metres before and behind a wall's face within which occupied cells count as the wall."""
FLAT = 1e-6
"""Largest distance in metres of a corner from the face of its solid."""


@dataclass(frozen=True, eq=False)
class Wall:
    """A flat rectangle in a known place.

    corner: (3,) one corner in metres, world frame; along: (2, 3) its two sides from there, at right angles.
    normal: (3,) unit vector towards the viewer.
    """

    name: str
    corner: NDArray[np.float64]
    along: NDArray[np.float64]
    normal: NDArray[np.float64]

    @classmethod
    def of(cls, solid: Solid, towards: ArrayLike) -> Wall:
        """Return the face of a box that faces direction `towards` (3,) most. Raises StereovoxError for other solids."""
        planes = solid.planes
        plane = planes[np.argmax(planes[:, :3] @ np.asarray(towards, float))]
        corners = np.unique(solid.triangles.reshape(-1, 3).round(9), axis=0)
        face = corners[np.abs(corners @ plane[:3] - plane[3]) < FLAT]
        sides = sorted(face[1:] - face[0], key=lambda side: float(np.linalg.norm(side))) if len(face) == 4 else []
        if not sides or abs(sides[0] @ sides[1]) > FLAT:
            raise StereovoxError(f"{solid.name}: has no rectangular face; only boxes can be measured as walls")
        return cls(solid.name, face[0], np.stack(sides[:2]), plane[:3])


@dataclass(frozen=True, eq=False)
class WallFound:
    """A wall as found in a map.

    thickness: (N,) occupied cells in each column of cells through the wall, columns without any left out.
    columns: number of columns inspected, including empty ones.
    offset: metres from the true face to the plane fitted to the occupied cells, positive towards the viewer.
    straightness: root mean square distance in metres of each column's middle from that plane.
    normal: (3,) unit normal of the fitted plane, on the viewer's side.
    """

    name: str
    thickness: NDArray[np.int64]
    columns: int
    offset: float
    straightness: float
    normal: NDArray[np.float64]

    def figures(self) -> dict[str, float | int | str]:
        """Return the numbers of a report: thickness as median, 95th percentile and share of columns of at most 2."""
        return {"name": self.name, **thickness_figures([self]), "offset": self.offset, "straight": self.straightness}


def measure_wall(
    voxel_map: VoxelMap, wall: Wall, *, only: Keys | None = None, others: Keys | None = None, reach: float = REACH
) -> WallFound:
    """Measure `wall` in a map.

    Columns run along the world axis nearest to the wall's normal, so a wall along the axes is measured straight
    through. Columns within one cell of the rectangle's rim are left out: another wall begins there.
    only: cells (N,) that were seen well; columns without one are left out. others: cells touched by objects other than
    the wall; columns with one within `reach` metres of the face are left out. Raises StereovoxError if fewer than three
    columns have an occupied cell.
    """
    size = voxel_map.voxel_size
    occupied = _near(occupied_cells(voxel_map), wall, size, reach)
    columns = judged_columns(wall, size, only=only, others=others, reach=reach)
    of_column = position(_column(occupied, _through(wall)), columns)
    occupied, of_column = occupied[of_column >= 0], of_column[of_column >= 0]
    thickness = np.bincount(of_column, minlength=len(columns))
    filled = thickness > 0
    if filled.sum() < 3:
        raise StereovoxError(f"{wall.name}: stands in {filled.sum()} columns of the map, at least 3 are needed")
    sums = [np.bincount(of_column, weights, len(columns)) for weights in voxel_map.centers(occupied).T]
    middle = np.stack(sums, axis=1)[filled] / thickness[filled, None]
    normal, residual = fit_plane(middle, wall.normal)
    offset = float((middle.mean(0) - wall.corner) @ wall.normal)
    return WallFound(wall.name, thickness[filled], len(columns), offset, float(np.sqrt(np.mean(residual**2))), normal)


def judged_columns(
    wall: Wall, size: float, *, only: Keys | None = None, others: Keys | None = None, reach: float = REACH
) -> Keys:
    """Return the columns (N,) through `wall` used by `measure_wall`, ascending; empty if none was seen well.

    size: side of a cell in metres; the others: see `measure_wall`.
    """
    axis = _through(wall)
    face = _over(wall, size) if only is None else indices(only)
    columns = np.unique(_column(_near(face, wall, size, size), axis))
    if others is None:
        return columns
    return np.setdiff1d(columns, _column(_near(indices(others), wall, size, reach), axis))


def _through(wall: Wall) -> int:
    """Return the world axis nearest to the wall's normal."""
    return int(np.argmax(np.abs(wall.normal)))


def fit_plane(points: NDArray[np.float64], towards: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the unit normal (3,), on the side of `towards`, and each point's distance (N,) from the best plane.

    points: (N, 3) metres, at least three. Best in the sense of total least squares.
    """
    centred = points - points.mean(0)
    normal = np.linalg.svd(centred, full_matrices=False)[2][2]
    normal = normal if normal @ np.asarray(towards, float) >= 0 else -normal
    return normal, centred @ normal


def corner_deg(one: WallFound, other: WallFound) -> float:
    """Return the angle in degrees, 0 to 180, inside the corner of two walls, on the side from which both are seen."""
    cosine = np.clip(-one.normal @ other.normal, -1, 1)
    return float(np.degrees(np.arccos(cosine)))


def thickness_figures(walls: Sequence[WallFound]) -> dict[str, float | int]:
    """Return columns, median, 95th percentile and share of at most 2 cells of the thickness of several walls, in cells.

    found: share of the columns with any occupied cell.
    """
    cells = np.concatenate([wall.thickness for wall in walls])
    columns = sum(wall.columns for wall in walls)
    return {
        "columns": columns,
        "found": len(cells) / columns,
        "thickness_median": float(np.median(cells)),
        "thickness_p95": float(np.percentile(cells, 95)),
        "thin_share": float((cells <= 2).mean()),
    }


def _near(cells: NDArray[np.integer], wall: Wall, size: float, reach: float) -> NDArray[np.int64]:
    """Return the cells (N, 3) whose centre is within `reach` of the face but not within a cell of its rim."""
    centre = (cells + 0.5) * size - wall.corner
    length = np.linalg.norm(wall.along, axis=1)
    place = centre @ (wall.along / length[:, None]).T
    inside = ((place > size) & (place < length - size)).all(axis=1)
    return np.asarray(cells[inside & (np.abs(centre @ wall.normal) <= reach)], np.int64)


def _over(wall: Wall, size: float) -> NDArray[np.int64]:
    """Return the cells (N, 3) that contain the face."""
    steps = [np.arange(0, 1, size / 4 / np.linalg.norm(side)) for side in wall.along]
    a, b = (grid.ravel()[:, None] for grid in np.meshgrid(*steps, indexing="ij"))
    return np.unique(np.floor((wall.corner + a * wall.along[0] + b * wall.along[1]) / size).astype(np.int64), axis=0)


def _column(cells: NDArray[np.integer], axis: int) -> Keys:
    """Return the key (N,) of each cell's column along `axis`."""
    flat = np.array(cells)
    flat[:, axis] = 0
    return keys(flat)
