# SPDX-License-Identifier: Apache-2.0
"""Resample one 2-D map onto the cells of another, whatever their cell sizes, origins and rotations.

Align one 2-D map with another: a map made by SLAM has its own frame.

Coarse: for every rotation, the cross-correlation (FFT) of two small images of the maps gives the best shift. Fine: the
best of these, and the start, are refined until walls lie on walls (`Fit`). Deterministic: nothing is sampled at random.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.geometry import se2
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.voxel_map import State

MAX_CELLS = 40_000_000
"""Most cells of the rectangle around both maps: 126 m x 126 m in cells of 2 cm. Distances take 40 bytes a cell."""
EMPTY_REFERENCE = "the reference has no free and no occupied cell: there is nothing to compare with; give another"
ROWS_AT_ONCE = 256
TIE = 1e-6
"""Share of a cell by which points on the border of two cells are shifted, so that rounding does not decide."""
Rectangle = tuple[float, float, float, float]
"""x0, y0, x1, y1 in metres: two opposite corners, in the reference's map frame."""


@dataclass(frozen=True, eq=False)
class AlignedGrids:
    """A map aligned with a reference: both on the cells of the reference, in the reference's map frame.

    map, reference: cover all cells known to either, at least one.
    excluded: (rows, columns) bool, cells whose centre is in an excluded region.
    motion: (3,) pose_reference_map by which the map was moved.
    """

    map: OccupancyGrid
    reference: OccupancyGrid
    excluded: NDArray[np.bool_]
    motion: se2.Pose


def aligned_grids(
    grid: OccupancyGrid, reference: OccupancyGrid, motion: ArrayLike = (0, 0, 0), exclude: Iterable[Rectangle] = ()
) -> AlignedGrids:
    """Resample `grid` on the cells of `reference`, moved by `motion`: (3,) pose_reference_map of the two map frames.

    A cell takes the value at its centre; an occupied cell of the map that contains no such centre (a coarser reference,
    a rotation) is entered at its own centre, so that no obstacle is lost. Raises StereovoxError for an invalid region,
    a reference without known cells, and maps too far apart for one image.
    """
    motion = np.asarray(motion, float)
    pose = se2.compose(se2.inverse(reference.origin), se2.compose(motion, grid.origin))
    corners = se2.transform(pose, grid.known_corners * grid.resolution)[:, ::-1] / reference.resolution
    known = np.concatenate([reference.known_corners[:, ::-1], corners])
    if not (reference.cells != UNKNOWN).any():
        raise StereovoxError(EMPTY_REFERENCE)
    first = np.floor(known.min(axis=0) + TIE).astype(int)
    rows, columns = (max(1, int(n)) for n in np.ceil(known.max(axis=0) - TIE) - first)
    _check_size(rows, columns, reference.resolution)
    offset = (first[1] * reference.resolution, first[0] * reference.resolution, 0.0)
    x, y, yaw = se2.compose(reference.origin, offset).tolist()
    target = replace(reference, cells=_window(reference.cells, first, (rows, columns)), origin=(x, y, yaw))
    pose_target_map = se2.compose(se2.inverse(offset), pose)
    source = replace(target, cells=resampled(grid, pose_target_map, target))
    source = replace(source, free_below=grid.free_below, occupied_above=grid.occupied_above)
    return AlignedGrids(source, target, excluded_cells(target, exclude), motion)


def three_states(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """Return (rows, columns) uint8 of UNKNOWN, FREE and OCCUPIED; tentative cells are unknown, as in map_server."""
    states = grid.states
    states[states == State.TENTATIVE] = State.UNKNOWN
    return states


def resampled(grid: OccupancyGrid, pose_target_source: ArrayLike, target: OccupancyGrid) -> NDArray[np.int8]:
    """Resample `grid` onto the cells of `target`: (rows, columns) int8.

    pose_target_source: (3,), the lower left corner of `grid` in the frame of `target`'s.
    """
    shape = target.cells.shape
    cells, found = np.full(shape, UNKNOWN, np.int8), np.zeros(grid.cells.shape, bool)
    back = se2.inverse(pose_target_source)
    for start in range(0, shape[0], ROWS_AT_ONCE):
        rows = np.arange(start, min(start + ROWS_AT_ONCE, shape[0]))
        row, column = _landed(back, rows[:, None], np.arange(shape[1]), target.resolution, grid.resolution)
        inside = _inside(row, column, grid.cells.shape)
        row, column = row[inside], column[inside]
        cells[rows[0] : rows[-1] + 1][inside] = grid.cells[row, column]
        found[row, column] = True
    lost = np.nonzero((grid.states == State.OCCUPIED) & ~found)
    row, column = _landed(pose_target_source, lost[0], lost[1], grid.resolution, target.resolution)
    inside = _inside(row, column, shape)
    np.maximum.at(cells, (row[inside], column[inside]), grid.cells[lost][inside])
    return cells


def excluded_cells(grid: OccupancyGrid, exclude: Iterable[Rectangle]) -> NDArray[np.bool_]:
    """Return which cells (rows, columns) have their centre in one of the regions of the map frame."""
    out = np.zeros(grid.cells.shape, bool)
    rows, columns = (np.arange(n) for n in out.shape)
    for region in exclude:
        x0, y0, x1, y1 = _checked(region)
        for start in range(0, len(rows), ROWS_AT_ONCE):
            part = rows[start : start + ROWS_AT_ONCE]
            x, y = _moved(grid.origin, part[:, None], columns, grid.resolution)
            out[part] |= (x >= x0) & (x <= x1) & (y >= y0) & (y <= y1)
    return out


def _checked(region: Rectangle) -> Rectangle:
    numbers = np.asarray(region, float)
    if numbers.shape != (4,) or not np.isfinite(numbers).all():
        raise StereovoxError(f"{region}: no region; give X0,Y0,X1,Y1 in metres, two opposite corners")
    (x0, y0), (x1, y1) = numbers.reshape(2, 2).min(axis=0), numbers.reshape(2, 2).max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def _check_size(rows: int, columns: int, resolution: float) -> None:
    if rows * columns > MAX_CELLS:
        size = f"{columns * resolution:.0f} m x {rows * resolution:.0f} m in cells of {resolution:g} m"
        raise StereovoxError(f"both maps together cover {size}: too far apart; are they in one frame? align them")


def _window(cells: NDArray[np.int8], first: NDArray[np.int_], shape: tuple[int, int]) -> NDArray[np.int8]:
    """Return `shape` cells from the row and column `first` on; unknown outside the map."""
    out = np.full(shape, UNKNOWN, np.int8)
    low = np.maximum(first, 0)
    high = np.minimum(first + shape, cells.shape)
    if (high > low).all():
        (r, c), (r1, c1) = low - first, high - first
        out[r:r1, c:c1] = cells[low[0] : high[0], low[1] : high[1]]
    return out


def _moved(
    pose: ArrayLike, rows: NDArray, columns: NDArray, side: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return x and y of the centres of cells, moved by `pose`; rows and columns are broadcast."""
    x, y, yaw = np.asarray(pose, float)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    along, up = (columns + 0.5) * side, (rows + 0.5) * side
    return x + cosine * along - sine * up, y + sine * along + cosine * up


def _landed(pose: ArrayLike, rows: NDArray, columns: NDArray, side: float, other_side: float) -> tuple[NDArray, ...]:
    """Return rows and columns of the cells of size `other_side` that contain the centres of cells."""
    x, y = _moved(pose, rows, columns, side)
    return tuple(np.floor(value / other_side + TIE).astype(np.int64) for value in (y, x))


def _inside(rows: NDArray, columns: NDArray, shape: tuple[int, ...]) -> NDArray[np.bool_]:
    return (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])


FEW, MANY = 600, 4000
"""Wall and floor cells sampled from each map: to rank motions, and to refine the best."""
MAX_ACROSS = 3000
"""Pixels along the longer side of a distance image; larger maps get larger pixels."""
STEPS = ((1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1))
Points = NDArray[np.float64]
"""(N, 2) x, y in metres."""
COARSE, MAX_COARSE = 128, 512
"""Pixels along the longer side of the small image: of the smaller map, and at most of the larger one."""
CANDIDATES, BEST = 12, 4
"""Number of motions that are refined coarsely, and then finely."""
MAX_POINTS = 500_000
"""Number of wall and floor cells of each map that are used."""
ALIKE = 0.98
"""Among motions with a score this close to the best, the smallest is taken: a building may be symmetric."""


class Fit:
    """Two maps as points: centres of their occupied and free cells, in metres from each map's lower left corner.

    walls, their_walls: at least one each. resolution: side of a cell in metres. reach: largest distance in metres that
    counts.
    """

    def __init__(
        self, walls: Points, their_walls: Points, floor: Points, their_floor: Points, resolution: float, reach: float
    ):
        self.resolution = resolution
        self._walls, self._their_walls, self._floor = walls, their_walls, floor
        self._ours, self._theirs = (_Field(one, resolution, 4 * reach) for one in (walls, their_walls))
        self._their_floor = _Field(their_floor, resolution, reach) if len(their_floor) else None
        self._middle = (walls.min(axis=0) + walls.max(axis=0)) / 2
        self._radius = max(float(np.hypot(*np.ptp(walls, axis=0))) / 2, resolution)

    def likelihood(self, pose: ArrayLike, width: float, max_points: int = MANY) -> float:
        """Return how well walls lie on walls, 0 to 1: mean of exp(-d^2 / (2 width^2)) in both directions.

        pose: (3,), our corner in their frame; width in metres; max_points: number of points sampled from each map.
        """
        moved = se2.transform(pose, evenly_sampled(self._walls, max_points))
        back = se2.transform(se2.inverse(pose), evenly_sampled(self._their_walls, max_points))
        pairs = ((self._theirs, moved), (self._ours, back))
        return float(np.mean([np.exp(-0.5 * (field.metres(at) / width) ** 2).mean() for field, at in pairs]))

    def agreement(self, pose: ArrayLike) -> float:
        """Return the likelihood for walls two cells wide, plus the share of our floor on theirs; 0 to 2."""
        walls = self.likelihood(pose, 2 * self.resolution)
        if not len(self._floor) or self._their_floor is None:
            return walls
        metres = self._their_floor.metres(se2.transform(pose, evenly_sampled(self._floor, MANY)))
        return walls + float((metres < self.resolution).mean())

    def refined(self, pose: ArrayLike, width: float, stop: float, max_points: int = MANY) -> se2.Pose:
        """Return the pose near `pose` of the highest likelihood: steps along x, y and yaw, halved if none helps.

        The likelihood's width is `width` at first and half as much at the end; `stop` is the smallest step in metres.
        """
        best = np.asarray(pose, float)
        for reach in (width, width / 2):
            score, step = self.likelihood(best, reach, max_points), reach
            while step > stop:
                tried = [self._stepped(best, step * np.array(one)) for one in STEPS]
                scores = [self.likelihood(one, reach, max_points) for one in tried]
                if max(scores) > score + 1e-9:
                    score, best = max(scores), tried[int(np.argmax(scores))]
                else:
                    step /= 2
        return best

    def distance(self, start: ArrayLike, end: ArrayLike) -> float:
        """Return the distance of two poses in metres: of the map's centre, plus the rotation's shift of its rim."""
        x, y, yaw = se2.relative(self._at_middle(start), self._at_middle(end))
        return float(np.hypot(x, y) + self._radius * abs(yaw))

    def _at_middle(self, pose: ArrayLike) -> se2.Pose:
        return se2.compose(pose, [*self._middle, 0.0])

    def _stepped(self, pose: se2.Pose, step: NDArray[np.float64]) -> se2.Pose:
        """Return the pose moved by step[:2] and rotated about the walls' centre so that their rim moves step[2]."""
        x, y, yaw = self._at_middle(pose) + step * [1, 1, 1 / self._radius]
        return se2.compose([x, y, yaw], [-self._middle[0], -self._middle[1], 0.0])


class _Field:
    """Distance to the nearest of a set of points, as an image."""

    def __init__(self, points: Points, resolution: float, margin: float):
        from scipy.ndimage import distance_transform_edt

        across = float(np.ptp(points, axis=0).max()) + 2 * margin
        self._side = max(resolution, across / MAX_ACROSS)
        self._low = points.min(axis=0) - (np.ceil(margin / self._side)) * self._side
        cells = np.rint((points - self._low) / self._side).astype(np.int64)
        empty = np.ones(cells.max(axis=0)[::-1] + 1 + int(np.ceil(margin / self._side)), bool)
        empty[cells[:, 1], cells[:, 0]] = False
        self._metres = np.asarray(distance_transform_edt(empty, sampling=self._side), np.float32)

    def metres(self, points: Points) -> NDArray[np.float32]:
        """Interpolate the distance of (N, 2) points; beyond the image, the value at its rim."""
        from scipy.ndimage import map_coordinates

        places = (points - self._low).T[::-1] / self._side
        return np.asarray(map_coordinates(self._metres, places, order=1, mode="nearest"), np.float32)


def evenly_sampled(points: NDArray[Any], max_points: int) -> NDArray[Any]:
    """Return at most `max_points` rows of an array, evenly spaced."""
    if len(points) <= max_points:
        return points
    return points[np.linspace(0, len(points) - 1, max_points).astype(int)]


def align_grids(grid: OccupancyGrid, reference: OccupancyGrid, start: ArrayLike = (0, 0, 0)) -> se2.Pose:
    """Return (3,) pose_reference_map, the motion of the frame of `grid` that aligns it with `reference`.

    All rotations and shifts are searched; among those that fit about as well as the best, the one nearest to `start`,
    (3,), is returned. If one of the maps has no occupied cell, `start` is returned.
    """
    start = np.asarray(start, float)
    ours, theirs = _cell_centres(grid), _cell_centres(reference)
    if not len(ours.walls) or not len(theirs.walls):
        return start
    from_corner = se2.compose(se2.inverse(reference.origin), se2.compose(start, grid.origin))
    pose = _best(ours, theirs, max(grid.resolution, reference.resolution), from_corner)
    return se2.compose(se2.compose(reference.origin, pose), se2.inverse(grid.origin))


@dataclass(frozen=True, eq=False)
class _CellCentres:
    """Centres of occupied and of free cells, (N, 2) x, y in metres from the lower left corner of cell (0, 0)."""

    walls: NDArray[np.float64]
    floor: NDArray[np.float64]


def _cell_centres(grid: OccupancyGrid) -> _CellCentres:
    states, cornered = grid.states, replace(grid, origin=(0.0, 0.0, 0.0))
    places = (evenly_sampled(np.argwhere(states == state), MAX_POINTS) for state in (State.OCCUPIED, State.FREE))
    walls, floor = (cornered.centres(*place.T) for place in places)
    return _CellCentres(walls, floor)


def _best(ours: _CellCentres, theirs: _CellCentres, resolution: float, start: se2.Pose) -> se2.Pose:
    """Return the pose of our corner in their frame."""
    small, large = sorted(float(np.ptp(one.walls, axis=0).max()) for one in (ours, theirs))
    side = max(small / COARSE, large / MAX_COARSE, 2 * resolution)
    fit = Fit(ours.walls, theirs.walls, ours.floor, theirs.floor, resolution, side)
    poses = [fit.refined(pose, side, side / 8, FEW) for pose in (start, *_candidates(ours, theirs, side))]
    poses = sorted(poses, key=fit.agreement, reverse=True)[:BEST]
    poses = [fit.refined(pose, resolution, resolution / 50) for pose in poses]
    scores = [fit.agreement(pose) for pose in poses]
    alike = [pose for pose, score in zip(poses, scores, strict=True) if score >= ALIKE * max(scores)]
    return min(alike, key=lambda pose: fit.distance(start, pose))


def _candidates(ours: _CellCentres, theirs: _CellCentres, side: float) -> list[se2.Pose]:
    """Return the best shifts of the best rotations, well apart from each other."""
    points, weights = _thinned(ours, side)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    points = points - middle
    reach = int(np.ceil(np.hypot(*points.T).max() / side)) + 1
    correlator = _Correlator(*_picture(*_thinned(theirs, side), side), side, reach)
    tried = []
    for yaw in np.arange(0, 2 * np.pi, 2 / (reach + 1)):
        score, where = correlator.best(se2.transform((0, 0, yaw), points), weights)
        tried.append((score, np.array([*where, yaw])))
    tried.sort(key=lambda one: -one[0])
    return [_from_origin(pose, middle) for pose in _apart([pose for _, pose in tried], side, reach)]


class _Correlator:
    """Finds the shift of weighted points that fits an image best.

    image: (rows, columns); corner: (2,) x, y of the centre of its first pixel; side: of a pixel in metres; reach:
    largest distance of a point from (0, 0) in pixels.
    """

    def __init__(self, image: NDArray[np.float32], corner: NDArray[np.float64], side: float, reach: int):
        self._corner, self._side, self._reach = corner, side, reach
        rows, columns = (-(-(n + 2 * reach) // 32) * 32 for n in image.shape)  # lengths for which an FFT is fast
        self._shape = (rows, columns)
        self._spectrum = np.fft.rfft2(image, self._shape)

    def best(self, points: NDArray[np.float64], weights: NDArray[np.float32]) -> tuple[float, NDArray[np.float64]]:
        """Return the highest correlation of points (N, 2) x, y in metres, and the shift (2,) that gives it."""
        size = 2 * self._reach + 1
        image = _binned(points / self._side + self._reach + 0.5, weights, (size, size))
        fits = np.fft.irfft2(self._spectrum * np.conj(np.fft.rfft2(image, self._shape)), self._shape)
        at = np.array(np.unravel_index(int(np.argmax(fits)), self._shape))
        at -= np.where(at >= np.array(self._shape) - 2 * self._reach, self._shape, 0)  # shifts below zero wrap around
        return float(fits.max()), self._corner + (at[::-1] + self._reach) * self._side


def _from_origin(pose_reference_middle: se2.Pose, middle: NDArray[np.float64]) -> se2.Pose:
    """Return pose_reference_map from a pose of the map's centre, the centre of rotation."""
    return se2.compose(pose_reference_middle, [-middle[0], -middle[1], 0.0])


def _apart(poses: list[se2.Pose], side: float, reach: int) -> list[se2.Pose]:
    kept: list[se2.Pose] = []
    for pose in poses:
        gaps = (np.abs(pose - one) for one in kept)
        if all(max(*gap[:2] / side, reach * abs(float(se2.wrapped(gap[2])))) > 6 for gap in gaps):
            kept.append(pose)
        if len(kept) == CANDIDATES:
            break
    return kept


def _thinned(centres: _CellCentres, side: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return points (N, 2), at most one per cell of `side`, and their weights: walls above zero, floor below.

    A cell with both is a wall; all walls together weigh as much as all floor.
    """
    walls, floor = (np.floor(points / side).astype(np.int64) for points in (centres.walls, centres.floor))
    cells = np.zeros(np.concatenate([walls, floor]).max(axis=0) + 1, np.int8)
    cells[tuple(floor.T)], cells[tuple(walls.T)] = -1, 1
    places = np.argwhere(cells)
    is_wall = cells[tuple(places.T)] > 0
    weights = np.where(is_wall, max(1, (~is_wall).sum()) / is_wall.sum(), -1.0)
    return np.asarray((places + 0.5) * side, np.float64), weights.astype(np.float32)


def _picture(
    points: NDArray[np.float64], weights: NDArray[np.float32], side: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the image of weighted points, its walls blurred, and the centre (2,) x, y of its first cell."""
    from scipy.ndimage import gaussian_filter

    low, high = points.min(axis=0), points.max(axis=0)
    columns, rows = np.rint((high - low) / side).astype(int) + 1
    image = _binned((points - low) / side + 0.5, weights, (rows, columns))
    return np.asarray(gaussian_filter(image, 0.7, mode="constant"), np.float32), low


def _binned(places: NDArray[np.float64], weights: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Return an image of the sums of weights; places: (N, 2) column and row, in pixels."""
    columns, rows = np.floor(places).astype(np.int64).T
    flat = np.bincount(rows * shape[1] + columns, weights, shape[0] * shape[1])
    return flat.reshape(shape).astype(np.float32)
