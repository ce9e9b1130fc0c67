# SPDX-License-Identifier: Apache-2.0
"""The motion that lays one 2-D map on another: a map made by SLAM stands in a frame of its own.

Coarse: for every turn, the correlation of two small pictures of the maps, by FFT, tells the best shift. Fine: the best
of these, and the start, are moved until walls lie on walls (`grid_fit`). Nothing is drawn by lot.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox import planar
from stereovox.evaluate.grid_fit import FEW, Fit, evenly
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import State

COARSE, MOST_COARSE = 128, 512
"""Pixels along the longer side of the smaller map's small picture, as far as the larger map's then has no more."""
CANDIDATES, BEST = 12, 4
"""Motions that are looked at closely, and very closely."""
MOST_POINTS = 500_000
"""Walls and floor cells of each map that are looked at."""
ALIKE = 0.98
"""Among motions so near to the best one the smallest is taken: a building may look alike from both ends."""


def align_grids(grid: OccupancyGrid, reference: OccupancyGrid, start: ArrayLike = (0, 0, 0)) -> planar.Pose:
    """Return (3,) pose_reference_map: the motion of `grid`'s map frame that lays it on `reference`.

    All turns and shifts are searched; of those that fit about as well as the best the one nearest to `start`, (3,), is
    taken. Where one of the maps has no occupied cell there is nothing to go by, and `start` is returned.
    """
    start = np.asarray(start, float)
    ours, theirs = _seen(grid), _seen(reference)
    if not len(ours.walls) or not len(theirs.walls):
        return start
    from_corner = planar.compose(planar.inverse(reference.origin), planar.compose(start, grid.origin))
    pose = _best(ours, theirs, max(grid.resolution, reference.resolution), from_corner)
    return planar.compose(planar.compose(reference.origin, pose), planar.inverse(grid.origin))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Middles of occupied and of free cells, (N, 2) x, y in metres from the lower left corner of cell (0, 0)."""

    walls: NDArray[np.float64]
    floor: NDArray[np.float64]


def _seen(grid: OccupancyGrid) -> _Seen:
    states, cornered = grid.states, replace(grid, origin=(0.0, 0.0, 0.0))
    places = (evenly(np.argwhere(states == state), MOST_POINTS) for state in (State.OCCUPIED, State.FREE))
    walls, floor = (cornered.centres(*place.T) for place in places)
    return _Seen(walls, floor)


def _best(ours: _Seen, theirs: _Seen, resolution: float, start: planar.Pose) -> planar.Pose:
    """Return the pose of our corner seen from theirs."""
    small, large = sorted(float(np.ptp(one.walls, axis=0).max()) for one in (ours, theirs))
    side = max(small / COARSE, large / MOST_COARSE, 2 * resolution)
    fit = Fit(ours.walls, theirs.walls, ours.floor, theirs.floor, resolution, side)
    poses = [fit.refined(pose, side, side / 8, FEW) for pose in (start, *_candidates(ours, theirs, side))]
    poses = sorted(poses, key=fit.agreement, reverse=True)[:BEST]
    poses = [fit.refined(pose, resolution, resolution / 50) for pose in poses]
    scores = [fit.agreement(pose) for pose in poses]
    alike = [pose for pose, score in zip(poses, scores, strict=True) if score >= ALIKE * max(scores)]
    return min(alike, key=lambda pose: fit.way(start, pose))


def _candidates(ours: _Seen, theirs: _Seen, side: float) -> list[planar.Pose]:
    """Return the best shifts of the best turns, each well apart from the others."""
    points, weights = _thinned(ours, side)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    points = points - middle
    reach = int(np.ceil(np.hypot(*points.T).max() / side)) + 1
    correlator = _Correlator(*_picture(*_thinned(theirs, side), side), side, reach)
    tried = []
    for yaw in np.arange(0, 2 * np.pi, 2 / (reach + 1)):
        score, where = correlator.best(planar.transform((0, 0, yaw), points), weights)
        tried.append((score, np.array([*where, yaw])))
    tried.sort(key=lambda one: -one[0])
    return [_from_origin(pose, middle) for pose in _apart([pose for _, pose in tried], side, reach)]


class _Correlator:
    """Finds the shift of weighted points that fits a picture best.

    image: (rows, columns); corner: (2,) x, y of the middle of its first pixel; side: of a pixel in metres; reach:
    pixels that no point lies further from (0, 0).
    """

    def __init__(self, image: NDArray[np.float32], corner: NDArray[np.float64], side: float, reach: int):
        self._corner, self._side, self._reach = corner, side, reach
        rows, columns = (-(-(n + 2 * reach) // 32) * 32 for n in image.shape)  # lengths that an FFT is quick at
        self._shape = (rows, columns)
        self._spectrum = np.fft.rfft2(image, self._shape)

    def best(self, points: NDArray[np.float64], weights: NDArray[np.float32]) -> tuple[float, NDArray[np.float64]]:
        """Return the highest correlation of points (N, 2) x, y in metres, and the shift (2,) that gives it."""
        size = 2 * self._reach + 1
        image = _binned(points / self._side + self._reach + 0.5, weights, (size, size))
        fits = np.fft.irfft2(self._spectrum * np.conj(np.fft.rfft2(image, self._shape)), self._shape)
        at = np.array(np.unravel_index(int(np.argmax(fits)), self._shape))
        at -= np.where(at >= np.array(self._shape) - 2 * self._reach, self._shape, 0)  # shifts below zero wrap round
        return float(fits.max()), self._corner + (at[::-1] + self._reach) * self._side


def _from_origin(pose_reference_middle: planar.Pose, middle: NDArray[np.float64]) -> planar.Pose:
    """Return pose_reference_map of a pose of the map's middle, where the map was turned about that."""
    return planar.compose(pose_reference_middle, [-middle[0], -middle[1], 0.0])


def _apart(poses: list[planar.Pose], side: float, reach: int) -> list[planar.Pose]:
    kept: list[planar.Pose] = []
    for pose in poses:
        gaps = (np.abs(pose - one) for one in kept)
        if all(max(*gap[:2] / side, reach * abs(float(planar.wrapped(gap[2])))) > 6 for gap in gaps):
            kept.append(pose)
        if len(kept) == CANDIDATES:
            break
    return kept


def _thinned(seen: _Seen, side: float) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return points (N, 2), at most one a cell of `side`, and their weights: walls above zero, floor below.

    A cell that holds both is a wall, and walls and floor weigh the same as a whole.
    """
    walls, floor = (np.floor(points / side).astype(np.int64) for points in (seen.walls, seen.floor))
    cells = np.zeros(np.concatenate([walls, floor]).max(axis=0) + 1, np.int8)
    cells[tuple(floor.T)], cells[tuple(walls.T)] = -1, 1
    places = np.argwhere(cells)
    is_wall = cells[tuple(places.T)] > 0
    weights = np.where(is_wall, max(1, (~is_wall).sum()) / is_wall.sum(), -1.0)
    return np.asarray((places + 0.5) * side, np.float64), weights.astype(np.float32)


def _picture(
    points: NDArray[np.float64], weights: NDArray[np.float32], side: float
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return the picture of weighted points, its walls softened, and the middle (2,) x, y of its first cell."""
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
