# SPDX-License-Identifier: Apache-2.0
"""Virtual cameras for wide lenses. Fisheye images are warped to them so that rows of both eyes are the same planes.

Both eyes are on the x axis, and every row of pixels is a plane through it, `(v - cv) * step_v` radians down from the
z axis. Depth is the distance from the x axis; see `stereovox.cameras.pinhole` for the ray convention.

Lenses with distortion: projection of directions into the image, and back.

Two models, both as in OpenCV: Brown and Conrady's for narrow lenses, Kannala and Brandt's for fisheyes. Optical frame:
x right, y down, z forward; pixel (u, v) has its centre at (u, v).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.pinhole import STEREO, PinholeCamera, check_numbers
from stereovox.errors import StereovoxError, did_you_mean

WIDEST_DEG = 88.0
"""Rays within two degrees of the x axis have no depth: both eyes see the same point there."""
WIDEST_BORDER_DEG = 93.0
"""Limit for the outer border of a pixel; its centre is limited by WIDEST_DEG."""
MIDDLE_DEG = 40.0
"""Largest half field of view of a wide camera's `middle`."""
FINEST_MIDDLE = 2400.0
"""Largest focal length of `middle` in pixels: it only represents the view; no image is made with it."""
SEEN_DEG = 89.0
"""Borders farther off count as this, because depths from the x axis become infinite there."""


@dataclass(frozen=True)
class SphericalCamera:
    """An equirectangular camera: columns are equal steps of the angle from the y-z plane (Valenti 2018, 4.2).

    Attributes:
        width: Columns of the image.
        height: Rows of the image.
        step_u: Radians from one column to the next.
        step_v: Radians from one row to the next.
        cu: Column of the z axis.
        cv: Row of the z axis.
        baseline: Metres between both eyes; None if unknown.
        binning: As in `PinholeCamera`.
        subpixel: As in `PinholeCamera`.

    Raises:
        StereovoxError: A number is out of its limits (`LIMITS` of `cameras.pinhole`), or a column is more than 88
            degrees off the axis.
    """

    width: int
    height: int
    step_u: float
    step_v: float
    cu: float
    cv: float
    baseline: float | None = None
    binning: int = 1
    subpixel: float | None = None

    def __post_init__(self) -> None:
        check_numbers(self, step_u="step", step_v="step", cu="centre", cv="centre", **STEREO)
        _check(self, max(abs(self.cu), abs(self.width - 1 - self.cu)) * self.step_u)

    @classmethod
    def from_field_of_view(
        cls, width: int, height: int, hfov_deg: float, vfov_deg: float, baseline: float | None = None
    ) -> SphericalCamera:
        """Return a camera whose pixel borders span the given angles, centred on the z axis.

        Args:
            width: Columns of the image.
            height: Rows of the image.
            hfov_deg: Angle between the left and the right border in degrees.
            vfov_deg: Angle between the upper and the lower border in degrees.
            baseline: Metres between both eyes; None if unknown.

        Returns:
            The camera.
        """
        step_u, step_v = math.radians(hfov_deg) / width, math.radians(vfov_deg) / height
        return cls(width, height, step_u, step_v, (width - 1) / 2, (height - 1) / 2, baseline)

    @property
    def middle(self) -> PinholeCamera:
        """A pinhole camera of the middle of the view."""
        return _middle(self)

    @property
    def borders(self) -> tuple[float, float, float, float]:
        """Angles of the image's borders, radians: left, right from the y-z plane, top, bottom from the z axis."""
        left, right = ((u - self.cu) * self.step_u for u in (-0.5, self.width - 0.5))
        return left, right, (-0.5 - self.cv) * self.step_v, (self.height - 0.5 - self.cv) * self.step_v

    def volume(self, depth: float) -> float:
        """Return the volume of the view.

        Args:
            depth: Metres from the x axis, and along it, at which the view ends.

        Returns:
            Cubic metres.
        """
        return _volume(self.borders, depth)

    @property
    def focal_px(self) -> float:
        """Sensor pixels per radian along a row."""
        return self.binning / self.step_u

    def angles(self) -> NDArray[np.float64]:
        """Return the angle of each column from the y-z plane.

        Returns:
            (width,) radians, positive towards x.
        """
        return (np.arange(self.width, dtype=float) - self.cu) * self.step_u

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the rays of the pixels, in the convention of `stereovox.cameras.pinhole`.

        Returns:
            Columns (width,) and rows (height, 2), float32.
        """
        return np.tan(self.angles()).astype(np.float32), _row_rays(self)

    def depth_of(self, disparity: NDArray[np.floating], aligned: str = "left") -> NDArray[np.float64]:
        """Return the depth of disparities: rho cos(theta) of Valenti 2018, Eq 4.3 and 4.4.

        It is B / (tan(left angle) - tan(right angle)).

        Args:
            disparity: (height, width) in pixels, above 0.
            aligned: Eye that the disparities belong to, `left` or `right`.

        Returns:
            (height, width) float64 metres; NaN if the other eye's ray would point backwards (90 degrees and more).
        """
        here = self.angles()
        shift = np.asarray(disparity, float) * self.step_u
        other = here - shift if aligned == "left" else here + shift
        depth = (self.baseline or np.nan) * np.cos(here) * np.cos(other) / np.sin(shift)
        return np.where(np.abs(other) < np.pi / 2, depth, np.nan)


@dataclass(frozen=True)
class CylindricalCamera:
    """A camera with a pinhole's columns and rows of equal angles, so that depth is `fx baseline / disparity`.

    The noise of its depth is the same function of depth in all directions, unlike a spherical camera's.

    Attributes:
        width: Columns of the image.
        height: Rows of the image.
        fx: Focal length along rows, in pixels.
        step_v: Radians from one row to the next.
        cx: Column of the z axis.
        cv: Row of the z axis.
        baseline: Metres between both eyes; None if unknown.
        binning: As in `PinholeCamera`.
        subpixel: As in `PinholeCamera`.

    Raises:
        StereovoxError: As for `SphericalCamera`.
    """

    width: int
    height: int
    fx: float
    step_v: float
    cx: float
    cv: float
    baseline: float | None = None
    binning: int = 1
    subpixel: float | None = None

    def __post_init__(self) -> None:
        check_numbers(self, fx="focal", step_v="step", cx="centre", cv="centre", **STEREO)
        _check(self, math.atan(max(abs(self.cx), abs(self.width - 1 - self.cx)) / self.fx))

    @classmethod
    def from_field_of_view(
        cls, width: int, height: int, hfov_deg: float, vfov_deg: float, baseline: float | None = None
    ) -> CylindricalCamera:
        """Return a camera whose pixel borders span the given angles, centred on the z axis.

        Args:
            width: Columns of the image.
            height: Rows of the image.
            hfov_deg: Angle between the left and the right border in degrees.
            vfov_deg: Angle between the upper and the lower border in degrees.
            baseline: Metres between both eyes; None if unknown.

        Returns:
            The camera.
        """
        fx = 0.5 * width / math.tan(math.radians(hfov_deg) / 2)
        return cls(width, height, fx, math.radians(vfov_deg) / height, (width - 1) / 2, (height - 1) / 2, baseline)

    @property
    def middle(self) -> PinholeCamera:
        """A pinhole camera of the middle of the view."""
        return _middle(self)

    @property
    def borders(self) -> tuple[float, float, float, float]:
        """Angles of the image's borders, radians: left, right from the y-z plane, top, bottom from the z axis."""
        left, right = (math.atan((u - self.cx) / self.fx) for u in (-0.5, self.width - 0.5))
        return left, right, (-0.5 - self.cv) * self.step_v, (self.height - 0.5 - self.cv) * self.step_v

    def volume(self, depth: float) -> float:
        """Return the volume of the view.

        Args:
            depth: Metres from the x axis, and along it, at which the view ends.

        Returns:
            Cubic metres.
        """
        return _volume(self.borders, depth)

    @property
    def focal_px(self) -> float:
        """Sensor pixels per radian along a row, at its centre."""
        return self.fx * self.binning

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the rays of the pixels, in the convention of `stereovox.cameras.pinhole`.

        Returns:
            Columns (width,) and rows (height, 2), float32.
        """
        return ((np.arange(self.width) - self.cx) / self.fx).astype(np.float32), _row_rays(self)

    def depth_of(self, disparity: NDArray[np.floating], aligned: str = "left") -> NDArray[np.float64]:
        """Return the depth of disparities.

        Args:
            disparity: (height, width) in pixels, above 0.
            aligned: Eye that the disparities belong to, `left` or `right`; ignored here.

        Returns:
            (height, width) float64 metres; NaN without a baseline.
        """
        return self.fx * (self.baseline or np.nan) / np.asarray(disparity, float)


def _middle(camera: SphericalCamera | CylindricalCamera) -> PinholeCamera:
    columns, _ = camera.rays()
    limit = math.tan(math.radians(MIDDLE_DEG))
    across = min(limit, float(np.abs(columns).max()))
    down = min(limit, math.tan(min(camera.height * camera.step_v / 2, math.radians(MIDDLE_DEG))))
    focal = min(camera.focal_px / camera.binning, FINEST_MIDDLE)
    width, height = max(1, round(2 * across * focal)), max(1, round(2 * down * focal))
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, camera.baseline)


def _row_rays(camera: SphericalCamera | CylindricalCamera) -> NDArray[np.float32]:
    down = (np.arange(camera.height) - camera.cv) * camera.step_v
    return np.stack([np.sin(down), np.cos(down)], axis=1).astype(np.float32)


def _volume(borders: tuple[float, float, float, float], depth: float) -> float:
    left, right = (math.tan(angle) for angle in np.clip(borders[:2], -math.radians(SEEN_DEG), math.radians(SEEN_DEG)))
    return min(right - left, 3.0) * (borders[3] - borders[2]) * depth**3 / 3


def _check(camera: SphericalCamera | CylindricalCamera, widest: float) -> None:
    if math.degrees(widest) > WIDEST_DEG:
        raise StereovoxError(
            f"camera {camera}: columns reach {math.degrees(widest):.1f} deg off the axis, more than {WIDEST_DEG}"
        )
    left, right, top, bottom = camera.borders
    if math.degrees(max(-left, right)) > WIDEST_BORDER_DEG:
        raise StereovoxError(f"camera {camera}: columns end more than {WIDEST_BORDER_DEG} deg off the axis")
    if bottom - top > 2 * math.pi + 1e-9:
        raise StereovoxError(f"camera {camera}: rows span more than a full turn")


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
