# SPDX-License-Identifier: Apache-2.0
"""Find the wall in a possibly distorted depth image, and fit its plane.

Seen from a pinhole camera a plane is linear in the slopes x = X/Z and y = Y/Z of the pixels: 1/z = a + b x + c y. So
the wall, however it leans, has three parameters, and a distorted one is approximated by a quadratic.

Correlation of the errors of neighbouring pixels, and the number of independent measurements in a patch. A recording of
a flat wall by a camera at rest, reduced to a few sums per pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import e, sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth.prepare import correct
from stereovox.errors import StereovoxError
from stereovox.frame import AnyFrame, Frame, Reason, StereoFrame
from stereovox.sensors.noise import kept_by_means

LAGS = 16
"""Pixels up to which errors are compared."""
SHAPE_FROM = 12
"""Correlation at this lag and beyond is due to the shape of the wall's image, not noise, and is subtracted."""
LEAST = 0.05
"""A correlation below this counts as zero and ends the sum."""
INDEPENDENT = 1.02
"""Sums up to this mean independent pixels."""
WIDEST_PX = 8.0
"""Largest standard deviation in pixels of the fitted Gaussian."""


@dataclass(frozen=True)
class Correlation:
    """Correlation of the errors of pixels 0 to LAGS apart.

    rows, columns: along a row and along a column; 1 at lag 0.
    """

    rows: tuple[float, ...]
    columns: tuple[float, ...]

    @classmethod
    def of(cls, products: NDArray[np.float64]) -> Correlation:
        """Return the correlation from sums as `add_products` makes them; independent pixels if there are no errors."""
        means = products[..., 0] / np.maximum(products[..., 1], 1)
        if not (means[:, 0] > 0).all():
            means = np.broadcast_to(np.arange(LAGS + 1) == 0, means.shape).astype(float)
        means = means / means[:, :1]
        shape = np.maximum(means[:, SHAPE_FROM:].mean(axis=1, keepdims=True), 0)
        rows, columns = (means - shape) / np.maximum(1 - shape, 1e-6)
        return cls(tuple(rows.tolist()), tuple(columns.tolist()))

    @property
    def length_px(self) -> float:
        """Standard deviation in pixels of the Gaussian that, smoothing independent noise, makes large patches as noisy.

        0: pixels are independent. For noise smoothed by it the correlation falls to 1/e at twice that.
        """
        share = sqrt(_sum(self.rows) * _sum(self.columns))
        if share < INDEPENDENT:
            return 0.0
        widths = np.linspace(0, WIDEST_PX, 801)
        return float(np.interp(share, [kept_by_means(width) for width in widths.tolist()], widths))

    @property
    def falls_to_1_e_px(self) -> tuple[float, float]:
        """Pixels at which the correlation along rows and along columns falls to 1/e; LAGS if it does not."""
        return _falls(self.rows), _falls(self.columns)

    def looks(self, side: int) -> float:
        """Return the number of independent measurements in a patch of side x side pixels, for side up to LAGS.

        That many independent ones would have an equally noisy mean. The correlation along a diagonal is taken as the
        product of row and column correlations, as for a Gaussian.
        """
        weights = 1 - np.arange(side) / side
        counts = [1 + 2 * float(np.sum(weights[1:] * line[1:side])) for line in (self.rows, self.columns)]
        return side * side / max(counts[0] * counts[1], 1e-9)


def add_products(products: NDArray[np.float64], errors: NDArray[np.floating]) -> None:
    """Add to `products` (2, LAGS + 1, 2), for each lag along rows and columns, the products' sum and number.

    errors: (height, width), NaN if missing.
    """
    known = np.isfinite(errors)
    values, there = np.where(known, errors, 0).astype(np.float32), known.astype(np.float32)
    for axis in range(2):
        across, there_ = (values.T, there.T) if axis else (values, there)
        across, there_ = np.ascontiguousarray(across), np.ascontiguousarray(there_)
        width = across.shape[1]
        for lag in range(min(LAGS + 1, width)):
            cut = width - lag
            products[axis, lag] += (
                np.einsum("ij,ij->", across[:, :cut], across[:, lag:], dtype=np.float64),
                np.einsum("ij,ij->", there_[:, :cut], there_[:, lag:], dtype=np.float64),
            )


def _sum(line: tuple[float, ...]) -> float:
    """Return the sum of a correlation over lags of both signs, up to its end."""
    values = np.array(line)
    ends = np.flatnonzero(values < LEAST)
    return 1 + 2 * float(values[1 : ends[0] if ends.size else len(values)].sum())


def _falls(line: tuple[float, ...]) -> float:
    values = np.array(line)
    below = np.flatnonzero(values < 1 / e)
    if not below.size:
        return float(LAGS)
    i = int(below[0])
    return float(i - 1 + (values[i - 1] - 1 / e) / (values[i - 1] - values[i]))


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


GROSS = 0.25
"""Values off by a larger share of the depth are not noise: mismatches, or a person walking through."""
USUAL = 0.5
"""A pixel counts if it has a value in this share of the frames; rarer ones scatter in one direction."""


@dataclass(eq=False)
class WallRecording:
    """Sums over the frames of one recording for each pixel, without gross errors.

    camera: its correction, if any, is already applied. distance: where the optical axis meets the wall, as
    measured by hand, in metres, or None.
    sums (4, height, width) float64: number of values, then the sums of 1/z, z and z^2 (z in metres).
    gross: number of values left out as gross errors; skipped: frames without usable depth, first_fault: why the first
    of them was. Poses are ignored.
    products: of the errors of 1/z of neighbouring pixels, see `add_products`, against the surface in the first frame.
    greys: mean grey level of the pixels with a value, of each frame whose image is known.
    condition: light, emitter power or texture, in words.
    """

    name: str
    camera: PinholeCamera
    distance: float | None = None
    frames: int = 0
    skipped: int = 0
    first_fault: str = ""
    gross: int = 0
    sums: NDArray[np.float64] = field(default_factory=lambda: np.zeros((4, 0, 0)))
    products: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, LAGS + 1, 2)))
    greys: list[float] = field(default_factory=list)
    condition: str = ""

    @property
    def count(self) -> NDArray[np.float64]:
        """Number of values of each pixel, (height, width)."""
        return self.sums[0]

    @property
    def inverse(self) -> NDArray[np.float64]:
        """Mean of 1/z in 1/m, (height, width), NaN if fewer than half the frames have a value.

        Not of z: a stereo camera's noise is uniform in disparity, which is proportional to 1/z; far away the mean of z
        is biased upwards.
        """
        enough = self.count >= max(1.0, USUAL * self.frames)
        return np.where(enough, self.sums[1] / np.maximum(self.count, 1), np.nan)

    @property
    def valid_share(self) -> float:
        """Share of all pixels of all frames that have a value, gross errors left out."""
        return float(self.count.sum() / max(1, self.frames * self.count.size))


def itself(frame: AnyFrame) -> Frame:
    """Return the frame, which must have depth."""
    assert isinstance(frame, Frame)
    return frame


def read_wall(
    frames: Iterable[AnyFrame],
    name: str,
    camera: PinholeCamera,
    distance: float | None = None,
    matched: Callable[[AnyFrame], Frame] = itself,
    condition: str = "",
) -> WallRecording:
    """Return the sums over `frames`, which may lack poses; depths are corrected if `camera` has a correction.

    matched: turns stereo frames into depth frames. condition: see `WallRecording`.

    The first frame gives the wall, and so defines gross errors.
    Raises StereovoxError if no frame has usable depth, and as `find_wall` if the first shows no wall.
    """
    wall = WallRecording(name, camera, distance, sums=np.zeros((4, camera.height, camera.width)), condition=condition)
    expected, gross = None, GROSS
    for seen in frames:
        frame = matched(seen)
        depth_m = metres(frame)
        if depth_m.shape != wall.count.shape or not np.isfinite(depth_m).any():
            wall.skipped += 1
            wall.first_fault = wall.first_fault or frame.fault_detail or f"{frame.name}: no valid depth"
            continue
        correct(depth_m, camera)
        if expected is None:
            found = find_wall(1 / depth_m.astype(float), camera, name)
            expected, gross = found.inverse(camera), max(GROSS, 6 * found.noise)
        _add(wall, depth_m, expected, gross)
        if isinstance(seen, StereoFrame) and seen.left.shape[:2] == depth_m.shape:
            wall.greys.append(float(seen.left[np.isfinite(depth_m)].mean()))
    if not wall.frames:
        raise StereovoxError(f"{name}: no valid depth in any frame ({wall.first_fault or 'it has none'})")
    return wall


def metres(frame: Frame) -> NDArray[np.float32]:
    """Return the depth as measured in metres, float32, NaN if missing; poses and corrections are ignored."""
    raw = np.asarray(frame.depth)
    depth_m = raw.astype(np.float32) * np.float32(frame.depth_scale)
    usable = np.isfinite(depth_m) & (depth_m > 0)
    if raw.dtype == np.uint16:
        usable &= raw != np.iinfo(np.uint16).max
    if frame.reason is not None and frame.reason.shape == raw.shape:
        usable &= frame.reason == Reason.VALID
    return np.where(usable, depth_m, np.float32(np.nan))


def _add(wall: WallRecording, depth_m: NDArray[np.float32], expected: NDArray[np.float64], gross: float) -> None:
    z = depth_m.astype(float)
    known = np.isfinite(z)
    with np.errstate(invalid="ignore"):
        usable = known & (np.abs(z * expected - 1) <= gross)
    wall.gross += int(known.sum() - usable.sum())
    z[~usable] = 0
    inverse = np.divide(1, z, out=np.zeros_like(z), where=usable)
    wall.sums += [usable, inverse, z, z * z]
    add_products(wall.products, np.where(usable, inverse - expected, np.nan))
    wall.frames += 1
