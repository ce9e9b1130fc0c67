# SPDX-License-Identifier: Apache-2.0
"""Camera models: how a pixel becomes a ray.

Optical frame: x right, y down, z forward. Pixel centres stand at whole numbers. In all cameras here the point that
pixel (u, v) sees at depth d is

    d * (columns[u], rows[v, 0], rows[v, 1])        with `columns, rows = camera.rays()`

so rows are straight lines of an image pair whose eyes stand side by side along x. What depth is: the distance along z
for a pinhole camera; the distance from the x axis, on which both eyes stand, for a spherical and a cylindrical one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError, did_you_mean

MAX_PIXELS = 100_000_000
"""Pixels of an image, at most."""
LIMITS = {
    "pixels": (1, MAX_PIXELS),
    "focal": (0.025, 1e6),
    "centre": (-1e9, 1e9),
    "step": (1e-6, 2 * math.pi),
    "baseline": (1e-9, 1e6),
    "subpixel": (1e-9, 1e6),
    "binning": (1, 1e12),
}
"""What numbers of a camera can be: focal length and centre in pixels, step in radians a pixel, baseline in metres."""
WHOLE = "pixels", "binning"
"""Which of them are whole numbers."""
STEREO = {"baseline": "baseline", "binning": "binning", "subpixel": "subpixel"}
"""Fields of all cameras with a depth, and which limits they have."""
MAX_COEFFICIENT = 1e36
"""Beyond it a correction leaves the range of float32."""

CORRECTIONS = {"scale": 6, "disparity": 6, "scale+disparity": 12, "thesis": 3}
"""Models of a depth correction and the number of their coefficients; see `DepthCorrection`."""


@dataclass(frozen=True)
class DepthCorrection:
    """What a depth camera measures wrongly, as found on flat walls (`stereovox calibrate wall`; Chien 2020, App. A).

    x = (u - cx) / fx and y = (v - cy) / fy are a pixel's slopes, z its measured depth in metres. With the quadratics
    s and q, each of six coefficients in the order 1, x, y, x^2, x y, y^2, the true depth is

        scale             z / (1 + s)          an error that is a share of the depth
        disparity         z / (1 + q z)        one of the disparity, q times focal length and baseline: eyes out of line
        scale+disparity   z / (1 + s + q z)    both; first the six of s, then those of q
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
    """Make the named fields of a frozen camera plain numbers, `width` and `height` too, and check what they can be.

    kinds: for each field a key of LIMITS. A field that is None by default may be None. Raises StereovoxError for what
    is no number within its limits, and for images of more than MAX_PIXELS.
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


STEEPEST = 20.0
"""Largest x/z or y/z at the borders of a pinhole camera's image: 87 degrees off the axis."""


@dataclass(frozen=True)
class PinholeCamera:
    """An undistorted pinhole camera.

    `fx, fy, cx, cy` are in pixels; pixel (u, v) has its centre at (u, v). `baseline` is the distance in metres
    between the two eyes (or projector and eye) of a stereo depth camera, None when not known. `binning` sensor pixels
    along each side make one pixel (see `binned`); `correction` is what its depth is to be corrected by; `subpixel` the
    noise of its disparity in pixels, None when not known.
    Raises StereovoxError for numbers that cannot be (see `LIMITS`), and where the image's borders are more than 87
    degrees off the axis.
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
                f"camera {self}: a ray {angle:.1f} deg off the axis is none of a pinhole; check fx, fy, cx, cy"
            )

    @classmethod
    def from_field_of_view(
        cls, width: int, height: int, hfov_deg: float, baseline: float | None = None
    ) -> PinholeCamera:
        """Return a camera with square pixels and a centred axis (Chien 2020, Eq 3.6).

        Raises StereovoxError for angles outside (0, 180) degrees.
        """
        if not 0 < hfov_deg < 180:
            raise StereovoxError(f"camera: field of view {hfov_deg} deg must lie between 0 and 180")
        focal = 0.5 * width / math.tan(math.radians(hfov_deg) / 2)
        return cls(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, baseline)

    def binned(self, n: int) -> PinholeCamera:
        """Return the camera whose pixels are blocks of n by n of this one's; blocks at the far borders may be cut."""
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
        """The camera itself; of a wide one, the pinhole camera that sees its middle."""
        return self

    @property
    def focal_px(self) -> float:
        """Pixels of the sensor per radian along a row, at its centre: what disparity is counted in."""
        return self.fx * self.binning

    def volume(self, depth: float) -> float:
        """Return how many cubic metres the image's borders enclose up to `depth` metres."""
        return self.width / self.fx * (self.height / self.fy) * depth**3 / 3

    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the columns (width,) and rows (height, 2) of the rays, float32, as the module says."""
        columns, slopes = self.ray_slopes()
        return columns, np.stack([slopes, np.ones_like(slopes)], axis=1)

    def depth_of(self, disparity: NDArray[np.floating], aligned: str = "left") -> NDArray[np.float64]:
        """Return the depth in metres for disparities (height, width) in pixels > 0 (Valenti 2018, Eq 4.1)."""
        return self.fx * (self.baseline or np.nan) / np.asarray(disparity, float)

    def ray_slopes(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return x/z of every column (width,) and y/z of every row (height,), float32."""
        x = (np.arange(self.width) - self.cx) / self.fx
        y = (np.arange(self.height) - self.cy) / self.fy
        return x.astype(np.float32), y.astype(np.float32)

    def back_project(self, depth_m: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return (height, width, 3) points in the optical frame for a depth image in metres (NaN stays NaN)."""
        depth = np.asarray(depth_m, float)
        v, u = np.mgrid[: self.height, : self.width]
        return np.stack([(u - self.cx) / self.fx * depth, (v - self.cy) / self.fy * depth, depth], axis=-1)
