# SPDX-License-Identifier: Apache-2.0
"""Matching of either image of a pair, and checks of the raw disparity: confidence, texture, reasons.

From disparities to points, and their uncertainty (Valenti 2018, chapter 4). Plain NumPy.

Points are in the optical frame of the eye whose image the disparities belong to: the thesis uses the right one. Its
misprints are corrected: Eq 4.3 means sin((v - v0) dtheta_v), Eq 4.6 B (cos / tan - sin).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.cameras.wide import SphericalCamera
from stereovox.config import StereoConfig
from stereovox.depth.stereo import _disparity
from stereovox.depth.stereo.matchers import Matcher
from stereovox.kernels.threads import in_shards, shards

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_] | None
RADIUS = 10
"""Half width of the square confidence window, 21 by 21 pixels."""
TALL = 5
"""Half height of the upright one, 11 rows by 3 columns."""
FAR_PX = 0.5
"""Smaller disparities are dropped: the pixel is too far to have a depth."""
SURE = 0.5
"""Confidence that TOO_FAR needs, since it clears everything before it."""
DOUBTFUL_PX, SEEN = 3.0, 4.0
"""Without texture, matchers tend to find small disparities: below 3 px at least this much texture is needed."""
DOWN, ACROSS = 3, 7
"""Half sizes of the texture window, 7 rows and 15 columns."""


@dataclass(frozen=True, eq=False)
class Disparity:
    """The result of matching for each pixel of the aligned image.

    disparity: (height, width) float32, pixels of the full image; NaN: none.
    confidence: (height, width) float32 from 0 (a guess) to 1 (certain); 0 without a value.
    reason: (height, width) uint8 of `Reason`, VALID if there is a disparity.
    """

    disparity: NDArray[np.float32]
    confidence: NDArray[np.float32]
    reason: NDArray[np.uint8]


def match_aligned(match: Matcher, left: Image, right: Image, aligned: str) -> NDArray[np.float32]:
    """Return the raw disparity (height, width) of the left or the right image, each in its own eye's pixels.

    Matchers compute it for the left image only; in a mirrored pair the right image takes that role.
    """
    if aligned == "left":
        return match(left, right)
    mirrored = match(np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1]))
    return np.ascontiguousarray(mirrored[:, ::-1])


def halved(image: Image) -> Image:
    """Return the image whose pixels are means of 2 by 2; an odd last row or column is first repeated."""
    import cv2

    height, width = image.shape
    even = cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
    return np.asarray(cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)


def doubled(disparity: NDArray[np.float32], shape: tuple[int, int], threads: int = 1) -> NDArray[np.float32]:
    """Return a disparity of halved images in full pixels, cut to `shape`: linear where smooth, else each value four
    times.

    A pixel is smooth if the two differ by less than a pixel; edges stay in place.
    """
    full = np.empty(shape, np.float32)

    def double(rows: slice) -> None:
        _disparity.double(disparity, rows.start, rows.stop, full)

    in_shards(double, shards(shape[0], threads))
    return full


def confidence(disparity: NDArray[np.float32], threads: int = 1) -> NDArray[np.float32]:
    """Return the confidence of each disparity (height, width), 0 to 1: the mean of share^3 / (1 + off) in two windows.

    One spans 21 by 21 pixels, the other 11 rows by 3 columns: a pole fills the second, but little of the first.
    share: of the window's pixels that have a disparity; if matching failed nearby, the rest is mostly chance. off:
    between the disparity and the window's mean, in pixels / (1 + 0.1 disparity). Both were chosen over the matching
    cost, its margin and curvature, texture and others, because they rank errors best (docs/stereo.md).
    """
    height, width = disparity.shape
    sure = np.empty_like(disparity)

    def fill(rows: slice) -> None:
        sums = np.empty((6, width + 2 * RADIUS + 1), np.int32)
        _disparity.confidence(disparity, RADIUS, TALL, rows.start, rows.stop, sums, sure)

    in_shards(fill, shards(height, threads))
    return sure


def texture(image: Image, threads: int = 1) -> NDArray[np.float32]:
    """Return the mean grey step over two columns (height, width) float32 in a window of 7 rows and 15 columns."""
    height, width = image.shape
    steps = np.empty(image.shape, np.float32)

    def fill(rows: slice) -> None:
        sums = np.empty(width + 2, np.int32), np.empty(width + 2 * ACROSS + 1, np.int32)
        _disparity.texture(image, DOWN, ACROSS, rows.start, rows.stop, *sums, steps)

    in_shards(fill, shards(height, threads))
    return steps


def explained(
    raw: NDArray[np.float32], image: Image, valid: Mask, valid_other: Mask, config: StereoConfig
) -> Disparity:
    """Return the disparity with confidence and reasons; `raw` (height, width), in full pixels, is changed.

    image: (height, width) uint8 that `raw` is aligned with. valid, valid_other: (height, width) bool of that image and
    of the other, None: all may be used. A pixel is MASKED if it or its match is, and in cropped
    columns. TOO_NEAR: the best match is the last one searched; a nearer one may be missing. TOO_FAR: certainly less
    than half a pixel, with texture. Other pixels without a value are UNMATCHED.
    """
    right = config.aligned == "right"
    side = 1 if right else -1
    parts = shards(raw.shape[0], config.threads)

    def check(rows: slice) -> None:
        _disparity.cross_check(raw[rows], side, np.float32(config.left_right), np.empty(raw.shape[1], np.float32))

    if config.left_right:
        in_shards(check, parts)
    sure, steps = confidence(raw, config.threads), texture(image, config.threads)
    reason = np.empty(raw.shape, np.uint8)
    last = config.disparities - (2 if config.halve else 1)
    crop = (0, config.rcrop) if right else (config.rcrop, 0)
    sures = config.min_confidence, max(SURE, config.min_confidence)
    seen = config.texture, DOUBTFUL_PX, max(SEEN, config.texture)
    limits = np.array([last - 0.1, FAR_PX, *sures, *crop, *seen], np.float32)
    none = np.empty((0, 0), np.bool_)
    masks = [none if mask is None else np.ascontiguousarray(mask, np.bool_) for mask in (valid, valid_other)]

    def explain(rows: slice) -> None:
        seen = (mask[rows] if mask.size else mask for mask in masks)
        _disparity.explain(raw[rows], sure[rows], steps[rows], *seen, side, limits, reason[rows])

    in_shards(explain, parts)
    return Disparity(raw, sure, reason)


Aligned = Literal["left", "right"]
"""The eye whose pixels the disparities belong to: u (left) = u (right) + disparity."""


def reproject(disparity: ArrayLike, camera: VirtualCamera, aligned: Aligned = "left") -> NDArray[np.float64]:
    """Return the points (height, width, 3) in metres of pixels with these disparities.

    disparity: (height, width) in pixels of `camera`; NaN, infinity, zero and less mean "no value" and give NaN points.
    camera: the virtual camera of both eyes. Frame: optical frame of the aligned eye (x right, y down, z forward).
    Pinhole: Valenti 2018, Eq 4.1; spherical: Eq 4.3 and 4.4, for the left eye with -d in place of +d in 4.4;
    cylindrical: the pinhole's depth along rays with equal angles between rows.
    """
    return _along_rays(camera.depth_of(usable(disparity), aligned), camera)


def point_sigma(
    disparity: ArrayLike, camera: VirtualCamera, disparity_sigma: float, aligned: Aligned = "left"
) -> NDArray[np.float64]:
    """Return the standard deviations (height, width, 3) in metres of the three coordinates of each point.

    disparity_sigma: standard deviation of the disparity in pixels of `camera`. Pinhole: Valenti 2018, Eq 4.2;
    spherical: Eq 4.7, which is the same for both eyes. First order: valid while it is small against the disparity.
    All three come from one error along the ray, so they are fully correlated.
    """
    return np.abs(_along_rays(depth_sigma(disparity, camera, disparity_sigma, aligned), camera))


def depth_sigma(
    disparity: ArrayLike, camera: VirtualCamera, disparity_sigma: float, aligned: Aligned = "left"
) -> NDArray[np.float64]:
    """Return the standard deviation (height, width) in metres of the depth measured by `camera`.

    Pinhole and cylindrical: f B / d^2; spherical: B cos^2(column angle) dtheta / sin^2(d dtheta); times the
    disparity's standard deviation in pixels.
    """
    d = np.where(np.isfinite(camera.depth_of(usable(disparity), aligned)), usable(disparity), np.nan)
    baseline = camera.baseline or np.nan
    if isinstance(camera, SphericalCamera):
        flatness = np.cos(camera.angles()) ** 2
        return baseline * flatness * camera.step_u / np.sin(d * camera.step_u) ** 2 * disparity_sigma
    return camera.fx * baseline / d**2 * disparity_sigma


def usable(disparity: ArrayLike) -> NDArray[np.float64]:
    """Return disparities of any shape, with NaN for values that are not positive and finite."""
    d = np.asarray(disparity, float)
    return np.where(np.isfinite(d) & (d > 0), d, np.nan)


def _along_rays(depth: NDArray[np.float64], camera: VirtualCamera) -> NDArray[np.float64]:
    columns, rows = (rays.astype(float) for rays in camera.rays())
    directions = np.broadcast_arrays(columns[None, :], rows[:, :1], rows[:, 1:])
    return depth[..., None] * np.stack(directions, axis=-1)
