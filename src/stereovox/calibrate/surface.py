# SPDX-License-Identifier: Apache-2.0
"""Find the wall in a possibly distorted depth image, and fit its plane.

Seen from a pinhole camera a plane is linear in the slopes x = X/Z and y = Y/Z of the pixels: 1/z = a + b x + c y. So
the wall, however it leans, has three parameters, and a distorted one is approximated by a quadratic.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import StereovoxError

Array = NDArray[np.float64]
TERMS = 6
MIN_VALID = 0.3
"""Least share of pixels with depth."""
MIN_WALL = 0.6
"""Least share of the pixels with depth on the wall."""
TOLERANCE = 0.03
"""Largest deviation of a wall pixel from the quadratic, as a share of depth; four times the noise if larger."""
NOISIEST = 0.15
"""Noise, as a share of the depth, above which an image is unusable."""
STEEPEST_DEG = 20.0
"""A wall that leans more is refused."""
MAX_CURVED = 0.4
"""Largest plausible distortion, as a share of the depth."""
BLOCKS = 40
GUESSES = 400


@dataclass(frozen=True, eq=False)
class Wall:
    """The wall in an image: 1/z = coefficients . terms(x, y) in 1/m, and which pixels (height, width) are on it.

    noise: standard deviation from pixel to pixel as a share of the depth.
    """

    coefficients: Array
    on_wall: NDArray[np.bool_]
    noise: float

    @property
    def distance(self) -> float:
        """Metres along the optical axis, as measured."""
        return float(1 / self.coefficients[0])

    @property
    def tilt_deg(self) -> float:
        """Angle between the wall's normal and the optical axis in degrees."""
        return tilt_deg(self.coefficients[:3])

    def inverse(self, camera: PinholeCamera) -> Array:
        """Return 1/z (height, width) of the smooth surface in 1/m."""
        return terms(*slopes(camera)) @ self.coefficients


def slopes(camera: PinholeCamera) -> tuple[Array, Array]:
    """Return x and y (height, width): slopes of the pixels' rays."""
    x, y = (np.asarray(slope, float) for slope in camera.ray_slopes())
    return np.broadcast_to(x, (y.size, x.size)), np.broadcast_to(y[:, None], (y.size, x.size))


def terms(x: Array, y: Array) -> Array:
    """Return (..., 6): 1, x, y, x^2, x y, y^2."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def tilt_deg(plane: Array) -> float:
    """Return the angle in degrees between the optical axis and the normal (b, c, a) of 1/z = a + b x + c y."""
    a, b, c = plane
    return float(np.degrees(np.arctan2(np.hypot(b, c), a)))


def find_wall(inverse: Array, camera: PinholeCamera, name: str) -> Wall:
    """Return the wall that fills most of an image of 1/z (height, width, NaN: no value).

    Raises StereovoxError, one line that begins with `name`: too few or too scattered pixels with depth, no surface
    that is nearly flat, too much tilt, too much curvature.
    """
    valid = np.isfinite(inverse)
    if valid.mean() < MIN_VALID:
        raise StereovoxError(
            f"{name}: only {valid.mean():.0%} of the pixels have depth; take a textured wall, nearer, in more light"
        )
    x, y = slopes(camera)
    noise = _noise(inverse)
    if noise > NOISIEST:
        raise StereovoxError(
            f"{name}: no flat wall in view: neighbouring pixels differ by {noise:.0%} of the depth; "
            "let a wall fill the image"
        )
    tolerance = max(TOLERANCE, 4 * noise)
    coefficients = _refined(x[valid], y[valid], inverse[valid], _guess(x, y, inverse, tolerance, name), tolerance)
    surface = terms(x, y) @ coefficients
    on_wall = valid & (np.abs(inverse - surface) < tolerance * np.abs(surface))
    wall = Wall(coefficients, on_wall, noise)
    plane = terms(x, y)[..., :3] @ coefficients[:3]
    _check(wall, surface, plane, float(on_wall.sum() / valid.sum()), name)
    return wall


def fit_plane(x: Array, y: Array, inverse: Array, distance: float | None = None, square: bool = False) -> Array:
    """Return (a, b, c) of the plane 1/z = a + b x + c y through points (N,), each weighted by its depth.

    distance: where the optical axis meets the plane in metres, if known; square: the plane is perpendicular to
    the axis.
    """
    columns = np.stack([np.ones_like(x), x, y], axis=1)
    free = [distance is None, not square, not square]
    plane = np.array([0.0 if distance is None else 1 / distance, 0.0, 0.0])
    if any(free):
        weights = 1 / inverse
        A, b = columns[:, free] * weights[:, None], (inverse - columns @ plane) * weights
        plane[free] = np.linalg.lstsq(A, b, rcond=None)[0]
    return plane


def _noise(inverse: Array) -> float:
    """Return the noise as a share of the depth, from the differences between neighbours."""
    steps = np.abs(np.diff(inverse, axis=1))
    steps = steps[np.isfinite(steps)]
    return float(1.4826 * np.median(steps) / np.sqrt(2) / np.nanmedian(inverse)) if len(steps) else 0.0


def _guess(x: Array, y: Array, inverse: Array, tolerance: float, name: str) -> Array:
    """Return the quadratic through six blocks of pixels that most other blocks fit."""
    u, v, m = _blocks(x), _blocks(y), _blocks(inverse)
    known = np.isfinite(m)
    if known.sum() < TERMS:
        raise StereovoxError(
            f"{name}: the pixels with depth are too scattered, hardly any patch is half full; "
            "take a textured wall, nearer, in more light"
        )
    u, v, m = u[known], v[known], m[known]
    random = np.random.default_rng(0)
    picks = random.integers(len(m), size=(GUESSES, TERMS))
    A, columns = terms(u, v)[picks], terms(u, v)
    possible = np.linalg.cond(A) < 1e6
    if not possible.any():
        return np.asarray(np.linalg.lstsq(columns, m, rcond=None)[0], float)
    guesses = np.linalg.solve(A[possible], m[picks[possible]][..., None])[..., 0]
    hits = (np.abs(columns @ guesses.T - m[:, None]) < tolerance * m[:, None]).sum(axis=0)
    return guesses[np.argmax(hits)]


def _blocks(image: Array) -> Array:
    """Return the medians of blocks of pixels, about 40 across; without noise and stray pixels. NaN: none has depth."""
    n = max(1, image.shape[1] // BLOCKS)
    rows, columns = image.shape[0] // n, image.shape[1] // n
    blocks = image[: rows * n, : columns * n].reshape(rows, n, columns, n).swapaxes(1, 2).reshape(rows, columns, n * n)
    mostly = np.isfinite(blocks).sum(axis=-1) * 2 >= n * n
    result = np.full((rows, columns), np.nan)
    result[mostly] = np.nanmedian(blocks[mostly], axis=-1)
    return result


def _refined(x: Array, y: Array, inverse: Array, coefficients: Array, tolerance: float) -> Array:
    columns = terms(x, y)
    for _ in range(5):
        near = np.abs(columns @ coefficients - inverse) < tolerance * inverse
        if near.sum() < TERMS:
            break
        A = columns[near]
        coefficients = np.asarray(np.linalg.solve(A.T @ A + 1e-12 * np.eye(TERMS), A.T @ inverse[near]), float)
    return coefficients


def _check(wall: Wall, surface: Array, plane: Array, share: float, name: str) -> None:
    if share < MIN_WALL or wall.coefficients[0] <= 0:
        raise StereovoxError(
            f"{name}: no flat wall in view: the best surface explains {share:.0%} of the pixels, "
            f"{MIN_WALL:.0%} are needed; let a wall fill the image"
        )
    if wall.tilt_deg > STEEPEST_DEG:
        raise StereovoxError(
            f"{name}: the wall leans by {wall.tilt_deg:.0f} deg, more than {STEEPEST_DEG:.0f}; face it squarely"
        )
    curved = np.abs(surface / plane - 1)[wall.on_wall].max()
    if curved > MAX_CURVED:
        raise StereovoxError(f"{name}: the surface bends by {curved:.0%} of its depth: that is not a flat wall")
