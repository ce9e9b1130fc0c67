# SPDX-License-Identifier: Apache-2.0
"""Virtual cameras for wide lenses. Fisheye images are warped to them so that rows of both eyes are the same planes.

Both eyes are on the x axis, and every row of pixels is a plane through it, `(v - cv) * step_v` radians down from the
z axis. Depth is the distance from the x axis; see `stereovox.cameras.pinhole` for the ray convention.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import STEREO, PinholeCamera, check_numbers
from stereovox.errors import StereovoxError

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
