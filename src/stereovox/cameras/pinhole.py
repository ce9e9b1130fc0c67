# SPDX-License-Identifier: Apache-2.0
"""The pinhole camera, the ray convention of all camera models, and depth corrections.

Optical frame: x right, y down, z forward. Pixel centres are at whole numbers. For all cameras here, pixel (u, v)
at depth d shows the point

    d * (columns[u], rows[v, 0], rows[v, 1])        with `columns, rows = camera.rays()`

so the rows of a pair whose eyes are next to each other along x are straight lines. Depth is the distance along z for a
pinhole camera, and the distance from the x axis, on which both eyes lie, for a spherical or cylindrical one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError, did_you_mean

MAX_PIXELS = 100_000_000
"""Most pixels of an image."""
LIMITS = {
    "pixels": (1, MAX_PIXELS),
    "focal": (0.025, 1e6),
    "centre": (-1e9, 1e9),
    "step": (1e-6, 2 * math.pi),
    "baseline": (1e-9, 1e6),
    "subpixel": (1e-9, 1e6),
    "binning": (1, 1e12),
}
"""Limits of a camera's numbers: focal length and centre in pixels, step in radians a pixel, baseline in metres."""
WHOLE = "pixels", "binning"
"""Keys of LIMITS whose values must be whole numbers."""
STEREO = {"baseline": "baseline", "binning": "binning", "subpixel": "subpixel"}
"""Fields of all depth cameras, with the key of their limits."""
MAX_COEFFICIENT = 1e36
"""Larger coefficients of a correction overflow float32."""
STEEPEST = 20.0
"""Largest x/z or y/z at the borders of a pinhole camera's image: 87 degrees off the axis."""
CORRECTIONS = {"scale": 6, "disparity": 6, "scale+disparity": 12, "thesis": 3}
"""Models of a depth correction and the number of their coefficients; see `DepthCorrection`."""


@dataclass(frozen=True)
class DepthCorrection:
    """Systematic depth error of a camera, as measured on flat walls (`stereovox calibrate wall`; Chien 2020, App. A).

    x = (u - cx) / fx and y = (v - cy) / fy are a pixel's slopes, z its measured depth in metres. With the quadratics
    s and q, each of six coefficients in the order 1, x, y, x^2, x y, y^2, the true depth is

        scale             z / (1 + s)          error proportional to depth
        disparity         z / (1 + q z)        disparity error, q times focal length and baseline: misaligned eyes
        scale+disparity   z / (1 + s + q z)    both; first the six coefficients of s, then those of q
        thesis            z - (p1 X^2 + p2 X + p3) with X = x z: Chien 2020, Eq A.3

    Raises StereovoxError for an unknown model, a wrong number of coefficients, or one that is not finite.
    """

    model: str
    coefficients: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.model not in CORRECTIONS:
            raise StereovoxError(f"correction: unknown model '{self.model}'{did_you_mean(self.model, CORRECTIONS)}")
        numbers = tuple(float(number) for number in self.coefficients)  # a list from a file cannot be hashed
        if len(numbers) != CORRECTIONS[self.model] or not all(abs(n) <= MAX_COEFFICIENT for n in numbers):
            needed = f"{CORRECTIONS[self.model]} finite coefficients"
            raise StereovoxError(f"correction: model '{self.model}' needs {needed}, not {list(numbers)}")
        object.__setattr__(self, "coefficients", numbers)


def check_numbers(camera: object, **kinds: str) -> None:
    """Convert the named fields of a frozen camera, and `width` and `height`, to plain numbers and check their limits.

    kinds: for each field a key of LIMITS. A field that is None by default may be None. Raises StereovoxError
    for values that are not numbers within their limits, and for images of more than MAX_PIXELS.
    """
    for name, kind in {"width": "pixels", "height": "pixels", **kinds}.items():
        value, (low, high), whole = getattr(camera, name), LIMITS[kind], kind in WHOLE
        if value is None and getattr(type(camera), name, 0) is None:
            continue
        value = value.item() if isinstance(value, np.generic) else value
        if not isinstance(value, int | float) or not low <= value <= high or (whole and value % 1):
            wanted = f"a {'whole ' if whole else ''}number from {low:g} to {high:g}"
            raise StereovoxError(f"camera {camera}: {name} must be {wanted}")
        object.__setattr__(camera, name, int(value) if whole else float(value))
    if getattr(camera, "width", 0) * getattr(camera, "height", 0) > MAX_PIXELS:
        raise StereovoxError(f"camera {camera}: more than {MAX_PIXELS:,} pixels; check width and height")


@dataclass(frozen=True)
class PinholeCamera:
    """An undistorted pinhole camera. The centre of pixel (u, v) is at (u, v).

    Attributes:
        width: Columns of the image.
        height: Rows of the image.
        fx: Focal length along rows, in pixels.
        fy: Focal length along columns, in pixels.
        cx: Column of the optical axis.
        cy: Row of the optical axis.
        baseline: Metres between the two eyes (or projector and eye) of a stereo depth camera; None if unknown.
        binning: Sensor pixels along each side of one pixel; see `binned`.
        correction: Correction of its depth; None for none.
        subpixel: Standard deviation of its disparity in pixels; None if unknown.

    Raises:
        StereovoxError: A number is out of its limits (`LIMITS`), or a border is more than 87 degrees off the axis.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float | None = None
    binning: int = 1
    correction: DepthCorrection | None = None
    subpixel: float | None = None

    def __post_init__(self) -> None:
        check_numbers(self, fx="focal", fy="focal", cx="centre", cy="centre", **STEREO)
        across, down = ((n - 0.5 - c, c + 0.5) for n, c in ((self.width, self.cx), (self.height, self.cy)))
        steepest = max(max(across) / self.fx, max(down) / self.fy)
        if steepest > STEEPEST:
            angle = math.degrees(math.atan(steepest))
            raise StereovoxError(
                f"camera {self}: a ray {angle:.1f} deg off the axis is impossible for a pinhole; check fx, fy, cx, cy"
            )

    @classmethod
    def from_field_of_view(
        cls, width: int, height: int, hfov_deg: float, baseline: float | None = None
    ) -> PinholeCamera:
        """Return a camera with square pixels and a centred axis (Chien 2020, Eq 3.6).

        Args:
            width: Columns of the image.
            height: Rows of the image.
            hfov_deg: Angle between the left and the right border in degrees.
            baseline: Metres between the two eyes; None if unknown.

        Returns:
            The camera.

        Raises:
            StereovoxError: The angle is not between 0 and 180 degrees.
        """
        if not 0 < hfov_deg < 180:
            raise StereovoxError(f"camera: field of view {hfov_deg} deg must lie between 0 and 180")
        focal = 0.5 * width / math.tan(math.radians(hfov_deg) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, baseline)

    def binned(self, n: int) -> PinholeCamera:
        """Return the camera whose pixels are blocks of n by n pixels of this one; blocks at the far borders may be cut.

        Args:
            n: Pixels along each side of a block.

        Returns:
            The camera with 1/n of the resolution, rounded up.
        """
        middle = (n - 1) / 2
        return replace(
            self,
            width=-(-self.width // n),
            height=-(-self.height // n),
            fx=self.fx / n,
            fy=self.fy / n,
            cx=(self.cx - middle) / n,
            cy=(self.cy - middle) / n,
            binning=self.binning * n,
        )

    @property
    def middle(self) -> PinholeCamera:
        """The camera itself; for wide cameras, a pinhole camera of their middle."""
        return self

    @property
    def focal_px(self) -> float:
        """Sensor pixels per radian along a row, at its centre: the unit of disparity."""
        return self.fx * self.binning

    def volume(self, depth: float) -> float:
        """Return the volume of the view.

        Args:
            depth: Depth in metres at which the view ends.

        Returns:
            Cubic metres.
        """
        return self.width / self.fx * (self.height / self.fy) * depth**3 / 3

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the rays of the pixels, in the convention of `stereovox.cameras.pinhole`.

        Returns:
            Columns (width,) and rows (height, 2), float32.
        """
        columns, slopes = self.ray_slopes()
        return columns, np.stack([slopes, np.ones_like(slopes)], axis=1)

    def depth_of(self, disparity: NDArray[np.floating], aligned: str = "left") -> NDArray[np.float64]:
        """Return the depth of disparities (Valenti 2018, Eq 4.1).

        Args:
            disparity: (height, width) in pixels, above 0.
            aligned: Eye that the disparities belong to, `left` or `right`; ignored here.

        Returns:
            (height, width) float64 metres; NaN without a baseline.
        """
        return self.fx * (self.baseline or np.nan) / np.asarray(disparity, float)

    def ray_slopes(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the slopes of the pixels' rays.

        Returns:
            x/z of every column (width,) and y/z of every row (height,), float32.
        """
        x = (np.arange(self.width) - self.cx) / self.fx
        y = (np.arange(self.height) - self.cy) / self.fy
        return x.astype(np.float32), y.astype(np.float32)

    def back_project(self, depth_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the points of a depth image.

        Args:
            depth_m: (height, width) metres along the optical axis; NaN: no value.

        Returns:
            (height, width, 3) float64 metres in the optical frame; NaN if the depth is NaN.
        """
        depth = np.asarray(depth_m, float)
        v, u = np.mgrid[: self.height, : self.width]
        return np.stack([(u - self.cx) / self.fx * depth, (v - self.cy) / self.fy * depth, depth], axis=-1)
