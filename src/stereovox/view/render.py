# SPDX-License-Identifier: Apache-2.0
"""Ambient occlusion: faces are darker the more cells are in front of them, so that corners, gaps and contacts show.

Render cells as shaded cubes: orthographic, with hidden surfaces removed, in NumPy alone.

All cells are equal and the projection is parallel, so all visible faces of one direction have the same pixel pattern;
a face is drawn by writing its cell's rank over the pattern from far to near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.truth import Keys, keys, position

RADII = ((1, 0.15), (2, 0.3), (3, 0.4), (4, 0.6))
"""Radii in cells of the boxes before a face whose occupied share darkens it, and how strongly."""

BURIED = 0.6
"""Mean brightness of a cell without an exposed face, visible if cells are drawn coarser."""


class Occlusion:
    """Sky visibility of the faces of a set of cells.

    Args:
        cells: (N, 3) indices, none twice.
        radii: As `RADII`; without any, all faces see the whole sky.
    """

    def __init__(self, cells: NDArray[np.integer], radii: Sequence[tuple[int, float]] = RADII):
        self._radii = radii
        self._keys = keys(cells)
        self._sorted = np.sort(self._keys)
        self._found: dict[tuple[int, int], NDArray[np.float32]] = {}

    def brightness(self, axis: int, side: int) -> NDArray[np.float32]:
        """Return the brightness (N,) of the faces along `axis`, upper ones for side 1 and lower ones for -1.

        1: nothing is in front of the face. 0: a cell covers it.
        """
        if (axis, side) not in self._found:
            self._found[axis, side] = self._look(axis, side)
        return self._found[axis, side]

    def mean(self) -> NDArray[np.float32]:
        """Return the mean brightness (N,) of each cell's exposed faces, for uses with one colour per cell."""
        total, number = np.zeros(len(self._keys), np.float32), np.zeros(len(self._keys), np.float32)
        for axis in range(3):
            for side in (-1, 1):
                brightness = self.brightness(axis, side)
                total += brightness
                number += brightness > 0
        return np.where(number > 0, total / np.maximum(number, 1), BURIED).astype(np.float32)

    def _look(self, axis: int, side: int) -> NDArray[np.float32]:
        step = np.zeros(3, np.int64)
        step[axis] = side
        exposed = np.flatnonzero(position(self._keys + _shift(step), self._sorted) < 0)
        shade = np.zeros(len(exposed))
        for radius, weight in self._radii:
            low, high = np.full(3, -radius), np.full(3, radius)
            low[axis], high[axis] = (1, radius) if side > 0 else (-radius, -1)
            shade += weight * self._count(self._keys[exposed], low, high) / np.prod(high - low + 1)
        brightness = np.zeros(len(self._keys), np.float32)
        brightness[exposed] = np.exp(-shade)
        return brightness

    def _count(self, around: Keys, low: NDArray[np.int64], high: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the number of cells in a box around each key (n,); keys are consecutive along z."""
        number = np.zeros(len(around), np.int64)
        for dx in range(low[0], high[0] + 1):
            for dy in range(low[1], high[1] + 1):
                first, last = (_shift(np.array([dx, dy, z])) for z in (low[2], high[2]))
                number += np.searchsorted(self._sorted, around + last, "right")
                number -= np.searchsorted(self._sorted, around + first, "left")
        return number


def _shift(step: NDArray[np.integer]) -> int:
    """Return the change of a key by a step of (3,) cells."""
    cell, origin = keys(np.stack([step, np.zeros(3, np.int64)]))
    return int(cell - origin)


LIGHT = {"top": 1.0, "x": 0.84, "y": 0.70}
"""Brightness of the faces perpendicular to each axis, before ambient occlusion."""
_SUPERSAMPLING = 2
_MAX_WRITES = 60_000_000
_MAX_CELL_PX = 20
"""Largest width of a cell in pixels; the caller may enlarge the image."""


@dataclass(frozen=True, eq=False)
class Direction:
    """Direction of view: unit vectors (3,) to the right, up, and towards the viewer."""

    right: NDArray[np.float64]
    up: NDArray[np.float64]
    toward: NDArray[np.float64]

    @classmethod
    def of(cls, azimuth_deg: float, elevation_deg: float) -> Direction:
        """Return the view from `azimuth_deg` (0 = from +x, 90 = from +y) and `elevation_deg` (90 = from above)."""
        azimuth, elevation = np.radians([azimuth_deg, elevation_deg])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0])
        toward = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
        return cls(right, np.cross(toward, right), toward)

    def flat(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return picture coordinates (N, 2) in metres, right and up, of points (N, 3)."""
        return np.asarray(points, float) @ np.stack([self.right, self.up], axis=1)


@dataclass(frozen=True, eq=False)
class Rendering:
    """An RGBA image (height, width, 4) float32 and its extent: left, right, bottom, top in picture metres.

    near: (rows, columns) float32, distance towards the viewer of each pixel's cell centre, in metres; -inf
    if there is none. It may be finer than the image.
    """

    image: NDArray[np.float32]
    extent: tuple[float, float, float, float]
    near: NDArray[np.float32]

    def hidden(self, flat: NDArray[np.float64], toward: NDArray[np.float64], slack: float) -> NDArray[np.bool_]:
        """Return which points are behind cells: picture coordinates (N, 2), and metres towards the viewer (N,).

        NaN is never hidden. slack: metres by which a cell's centre must be nearer to count as in front.
        """
        left, right, bottom, top = self.extent
        rows, columns = self.near.shape
        there = np.isfinite(toward)
        flat = np.where(there[:, None], flat, [left, top])
        column = np.floor((flat[:, 0] - left) / (right - left) * columns).astype(int)
        row = np.floor((top - flat[:, 1]) / (top - bottom) * rows).astype(int)
        inside = there & (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        found = np.zeros(len(flat), bool)
        found[inside] = self.near[row[inside], column[inside]] > toward[inside] + slack
        return found


def render(
    cells: NDArray[np.integer],
    colours: NDArray[np.floating],
    voxel_size: float,
    direction: Direction,
    width_px: int,
    height_px: int,
    occlusion: Occlusion | None = None,
) -> Rendering:
    """Draw `cells` (N, 3) in `colours` (N, 3) as large as fits in an image of this size; N > 0.

    occlusion: that of `cells`, for several views of the same ones.
    """
    order = np.argsort((cells + 0.5) @ direction.toward, kind="stable")
    light = _lit(occlusion or Occlusion(cells), direction)[order]
    cells, colours = cells[order], colours[order]
    faces = [np.flatnonzero(light[:, axis]) for axis in range(3)]
    low, high = extent(cells, voxel_size, direction)
    scale = float(min(width_px / (high[0] - low[0]), height_px / (high[1] - low[1]), _MAX_CELL_PX / voxel_size))
    area = sum(len(face) for face in faces) * (scale * voxel_size) ** 2
    finer = _SUPERSAMPLING if area * _SUPERSAMPLING**2 < _MAX_WRITES else 1
    canvas = _Canvas(low, high, scale * finer)
    for axis, face in enumerate(faces):
        canvas.draw(cells[face], face * 3 + axis, axis, voxel_size, direction)
    depth = (cells + 0.5) @ direction.toward * voxel_size
    near = np.where(canvas.front >= 0, depth[np.maximum(canvas.front, 0) // 3], -np.inf).astype(np.float32)
    image = _shade(canvas.front, near, colours.astype(np.float32), light, voxel_size)
    return Rendering(_reduced(image, finer), (low[0], high[0], low[1], high[1]), near)


class _Canvas:
    """An image that keeps the largest number written to each pixel, -1 if none was."""

    def __init__(self, low: NDArray[np.float64], high: NDArray[np.float64], scale: float):
        self.low, self.high, self.scale = low, high, scale
        width, height = np.maximum(np.ceil((high - low) * scale).astype(int), 1)
        self.front = np.full((height, width), -1, np.int32)

    def draw(
        self,
        cells: NDArray[np.integer],
        numbers: NDArray[np.integer],
        axis: int,
        voxel_size: float,
        direction: Direction,
    ) -> None:
        """Write `numbers` (n,) to the pixels of viewer-facing faces, across `axis`, of `cells` (n, 3)."""
        if not len(cells):
            return
        height, width = self.front.shape
        corner = np.zeros(3)
        corner[axis] = direction.toward[axis] > 0
        base = (direction.flat((cells + corner) * voxel_size) - [self.low[0], self.high[1]]) * [self.scale, -self.scale]
        sides = np.delete(np.eye(3), axis, axis=0) * voxel_size
        pattern = _pattern(direction.flat(sides) * [self.scale, -self.scale])
        numbers = numbers.astype(np.int32)
        column, row = np.floor(base).astype(np.int32).T
        for dx, dy in pattern:
            x, y = np.clip(column + dx, 0, width - 1), np.clip(row + dy, 0, height - 1)
            np.maximum.at(self.front.ravel(), y * width + x, numbers)


def _lit(occlusion: Occlusion, direction: Direction) -> NDArray[np.float32]:
    """Return the brightness (N, 3) of each cell's three viewer-facing faces, 0 for hidden ones."""
    light = []
    for axis, name in enumerate(("x", "y", "top")):
        edge_on = abs(direction.toward[axis]) < 1e-6
        side = int(np.sign(direction.toward[axis]))
        light.append(LIGHT[name] * occlusion.brightness(axis, side) * (not edge_on))
    return np.stack(light, axis=1).astype(np.float32)


def extent(cells: NDArray[np.integer], voxel_size: float, direction: Direction) -> NDArray[np.float64]:
    """Return the lowest and highest picture coordinates (2, 2) that `cells` (N, 3) cover."""
    cube = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3) * voxel_size
    flat, corner = direction.flat(cells * voxel_size), direction.flat(cube)
    return np.stack([flat.min(0) + corner.min(0), flat.max(0) + corner.max(0)])


def _pattern(sides: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the pixels (n, 2), relative to its first corner's, of a parallelogram with sides (2, 2) in pixels.

    It is half a pixel larger on all sides, so that rounding leaves no seams between neighbours.
    """
    corners = np.array([[0, 0], sides[0], sides[1], sides[0] + sides[1]])
    low, high = np.floor(corners.min(0)).astype(int) - 1, np.ceil(corners.max(0)).astype(int) + 1
    x, y = np.meshgrid(np.arange(low[0], high[0] + 1), np.arange(low[1], high[1] + 1))
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    if abs(np.linalg.det(sides)) < 0.05:
        return np.zeros((1, 2), int)
    inverse = np.linalg.inv(sides)
    share, margin = pixels @ inverse, 0.5 * np.abs(inverse).sum(0)
    inside = ((share >= -margin) & (share <= 1 + margin)).all(axis=1)
    return pixels[inside]


def _shade(
    front: NDArray[np.int32],
    near: NDArray[np.float32],
    colours: NDArray[np.float32],
    light: NDArray[np.float32],
    voxel_size: float,
) -> NDArray[np.float32]:
    drawn = front >= 0
    cell, side = np.divmod(np.maximum(front, 0), 3)
    image = np.zeros((*front.shape, 4), np.float32)
    image[..., :3] = colours[cell] * (light[cell, side] * _contour(near, voxel_size))[..., None]
    image[..., 3] = drawn
    image[~drawn] = 0
    return image


def _contour(near: NDArray[np.float32], voxel_size: float) -> NDArray[np.float32]:
    """Return a brightness (height, width) that darkens pixels next to nearer ones, so that edges stand out."""
    shadow = np.zeros_like(near)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            for step in (-3, -1, 1, 3):
                ahead = np.roll(near, step, axis) - near - 2 * voxel_size
                shadow += np.clip(np.nan_to_num(ahead, nan=0.0, posinf=0.0, neginf=0.0), 0, 0.4)
    return np.exp(-0.6 * shadow)


def _reduced(image: NDArray[np.float32], times: int) -> NDArray[np.float32]:
    height, width = (size // times * times for size in image.shape[:2])
    blocks = image[:height, :width].reshape(height // times, times, width // times, times, 4).mean((1, 3))
    alpha = blocks[..., 3:]
    return np.concatenate([blocks[..., :3] / np.maximum(alpha, 1e-6), alpha], axis=-1).clip(0, 1)
