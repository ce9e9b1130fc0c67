# SPDX-License-Identifier: Apache-2.0
"""Lenses with distortion: projection of directions into the image, and back.

Two models, both as in OpenCV: Brown and Conrady's for narrow lenses, Kannala and Brandt's for fisheyes. Optical frame:
x right, y down, z forward; pixel (u, v) has its centre at (u, v).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.pinhole import check_numbers
from stereovox.errors import StereovoxError, did_you_mean

MODELS = {"pinhole": 8, "fisheye": 4}
"""Lens models and their largest numbers of coefficients."""
COUNTS = {"pinhole": (0, 4, 5, 8), "fisheye": (0, 4)}
"""Numbers of coefficients that a calibration may have; any other number in a file is an error."""
FARTHEST = {"pinhole": math.radians(89.9), "fisheye": math.pi}
"""Largest angle off the axis in radians that the model covers."""
LARGEST = 1e9
"""Bound of the coefficients; larger ones overflow float64."""
STEPS = 2000
"""Angles in the table that starts the inverse."""
ROUNDS = 12
"""Newton steps of the inverse."""
GOOD = 1e-10
"""Residual of a converged inverse, in focal lengths."""


@dataclass(frozen=True)
class Lens:
    """A calibrated camera with distortion.

    model: `pinhole` with up to 8 coefficients of Brown and Conrady (k1 k2 p1 p2 k3 k4 k5 k6, OpenCV's order), or
    `fisheye` with the four of Kannala and Brandt; missing ones are zero. fx, fy, cx, cy in pixels.
    Raises StereovoxError for an unknown model, numbers out of their limits (`pinhole.LIMITS`), too many coefficients.
    """

    model: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.model not in MODELS:
            raise StereovoxError(f"lens: unknown model '{self.model}'{did_you_mean(self.model, MODELS)}")
        check_numbers(self, fx="focal", fy="focal", cx="centre", cy="centre")
        coefficients = tuple(float(number) for number in self.distortion)  # a list from a file cannot be hashed
        if len(coefficients) > MODELS[self.model] or not all(abs(n) <= LARGEST for n in coefficients):
            wanted = f"at most {MODELS[self.model]} finite coefficients up to {LARGEST:g}"
            raise StereovoxError(f"lens: model '{self.model}' takes {wanted}, not {list(coefficients)}")
        object.__setattr__(self, "distortion", coefficients)

    @classmethod
    def from_field_of_view(cls, model: str, width: int, height: int, hfov_deg: float) -> Lens:
        """Return a lens without distortion whose outer pixel edges span `hfov_deg`; a fisheye is linear in angle."""
        half = math.radians(hfov_deg) / 2
        if not 0 < half < (math.pi / 2 if model == "pinhole" else math.pi):
            raise StereovoxError(f"lens: a {model} cannot see {hfov_deg} deg; give less")
        focal = 0.5 * width / (math.tan(half) if model == "pinhole" else half)
        return cls(model, width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    @cached_property
    def widest(self) -> float:
        """Largest angle off the axis in radians that the lens sees; beyond it the model would fold the image back."""
        k = self._k
        if self.model == "fisheye":
            return min(math.sqrt(_first_root(np.array([1.0, *k]) * (1, 3, 5, 7, 9))), FARTHEST["fisheye"])
        over, under = np.array([1.0, k[0], k[1], k[4]]), np.array([1.0, k[5], k[6], k[7]])
        # d/dr of r N(s) / D(s) with s = r^2 is (N D + 2 s (N' D - N D')) / D^2
        product = np.convolve(over, under)
        change = np.convolve(_slope(over), under) - np.convolve(over, _slope(under))
        rising = product + np.concatenate([[0], 2 * change, [0] * (len(product) - 1 - len(change))])
        steepest = math.sqrt(min(_first_root(rising), _first_root(under)))
        return min(math.atan(steepest), FARTHEST["pinhole"])

    def project(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, 2) pixels, inside the image or not, that show the (N, 3) points of the optical frame.

        NaN for points that the lens cannot see: behind a pinhole, beyond `widest`, at the lens itself.
        """
        x, y, z = np.asarray(points, float).T
        with np.errstate(divide="ignore", invalid="ignore"):
            across = np.hypot(x, y)
            angle = np.arctan2(across, z)
            if self.model == "fisheye":
                scale = np.where(across > 0, self._bent(angle) / across, 0.0)
                plane = np.stack([x * scale, y * scale], axis=1)
            else:
                plane = self._distorted(np.stack([x / z, y / z], axis=1))
            seen = (angle <= self.widest) & ((across > 0) | (z > 0))
        return np.where(seen[:, None], plane * (self.fx, self.fy) + (self.cx, self.cy), np.nan)

    def directions(self, pixels: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, 3) unit rays of (N, 2) pixels; NaN for pixels that show nothing (see `widest`)."""
        plane = (np.asarray(pixels, float) - (self.cx, self.cy)) / (self.fx, self.fy)
        radius = np.hypot(*plane.T)
        angle = self._angles(radius)
        if self.model == "fisheye":
            angle = self._unbent(angle, radius)
            turn = np.divide(np.sin(angle), radius, out=np.zeros_like(radius), where=radius > 0)
            rays = np.column_stack([plane * turn[:, None], np.cos(angle)])
            return np.where(np.isfinite(angle)[:, None], rays, np.nan)
        turn = np.divide(np.tan(angle), radius, out=np.ones_like(radius), where=radius > 0)
        slopes = self._undistorted(plane * turn[:, None], plane)
        rays = np.column_stack([slopes, np.ones(len(slopes))])
        return rays / np.linalg.norm(rays, axis=1, keepdims=True)

    @cached_property
    def _k(self) -> NDArray[np.float64]:
        return np.pad(self.distortion, (0, MODELS[self.model] - len(self.distortion)))

    def _bent(self, angle: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the radius in focal lengths at which a fisheye shows an angle (Kannala and Brandt 2006)."""
        s = angle * angle
        k1, k2, k3, k4 = self._k
        return angle * (1 + s * (k1 + s * (k2 + s * (k3 + s * k4))))

    def _distorted(self, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        k1, k2, p1, p2, k3, k4, k5, k6 = self._k
        x, y = slopes.T
        s = x * x + y * y
        radial = (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))
        across = x * radial + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        down = y * radial + p1 * (s + 2 * y * y) + 2 * p2 * x * y
        return np.stack([across, down], axis=1)

    def _angles(self, radius: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the approximate angles off the axis of these radii in focal lengths; NaN beyond the widest."""
        angles = np.linspace(0, self.widest, STEPS)
        if self.model == "fisheye":
            return np.interp(radius, self._bent(angles), angles, right=np.nan)
        k, s = self._k, np.tan(angles) ** 2
        radial = np.polyval([k[4], k[1], k[0], 1], s) / np.polyval([k[7], k[6], k[5], 1], s)
        return np.interp(radius, np.tan(angles) * radial, angles)  # clamped: tangential distortion may reach further

    def _unbent(self, angle: NDArray[np.float64], radius: NDArray[np.float64]) -> NDArray[np.float64]:
        rates = self._k * (3, 5, 7, 9)
        for _ in range(ROUNDS):
            s = angle * angle
            rate = 1 + s * np.polyval(rates[::-1], s)
            angle = angle - (self._bent(angle) - radius) / np.maximum(rate, 1e-6)
        return np.where(np.abs(self._bent(angle) - radius) < 1e-9, angle, np.nan)

    def _undistorted(self, slopes: NDArray[np.float64], plane: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the slopes x/z, y/z that appear at `plane`, by Newton's method; NaN if missing."""
        with np.errstate(all="ignore"):
            for _ in range(ROUNDS):
                missing = plane - self._distorted(slopes)
                if np.abs(missing).max(initial=0) < GOOD:
                    break
                slopes = slopes + _solved(self._rates(slopes), missing)
            found = np.abs(plane - self._distorted(slopes)).max(axis=1, initial=0) < 1e-7
            found &= np.hypot(*slopes.T) <= math.tan(self.widest) * (1 + 1e-9)
        return np.where(found[:, None], slopes, np.nan)

    def _rates(self, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, 2, 2) derivatives of `_distorted` by differences, since it is smooth and of order one."""
        step = 1e-6
        sides = [(self._distorted(slopes + d) - self._distorted(slopes - d)) / (2 * step) for d in step * np.eye(2)]
        return np.stack(sides, axis=2)


def _solved(A: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x of A x = b for (N, 2, 2) and (N, 2), by Cramer's rule."""
    determinant = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    x = A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1]
    y = A[:, 0, 0] * b[:, 1] - A[:, 1, 0] * b[:, 0]
    return np.stack([x, y], axis=1) / determinant[:, None]


def _slope(polynomial: NDArray[np.float64]) -> NDArray[np.float64]:
    return polynomial[1:] * np.arange(1, len(polynomial))


def _first_root(polynomial: NDArray[np.float64]) -> float:
    """Return the smallest positive root of a polynomial (constant first), infinity if it has none."""
    roots = np.roots(polynomial[::-1])
    real = roots.real[(np.abs(roots.imag) < 1e-9 * np.maximum(1, np.abs(roots.real))) & (roots.real > 0)]
    return float(real.min(initial=np.inf))
