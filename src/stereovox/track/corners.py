# SPDX-License-Identifier: Apache-2.0
"""Corners in grey images: detection, description, and optical flow to the next image."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

QUIET, NOISE = 10, 5.0
"""Percentile of corner strength taken as noise, and how many times stronger corners must be."""
ROUNDING = 1e-6
"""Corner strength of rounding to whole grey levels."""
WINDOW, LEVELS = (15, 15), 3
"""Window in pixels around a followed corner, and number of times the images are halved."""
BACK_PX = 0.25
"""Largest error in pixels of a corner that is tracked forward and back."""
ALIKE_BITS = 50
"""Largest Hamming distance between ORB descriptors of one corner."""


class Kind(NamedTuple):
    """Which corners are followed.

    block: pixels across of the square by which their strength is reported. quality: their least strength as a share of
    the strongest (Shi and Tomasi 1994). fewer: share that may be lost before new ones are detected.
    """

    block: int
    quality: float
    fewer: float


SHARP, SOFT = Kind(3, 0.01, 0.0), Kind(7, 0.003, 0.15)
"""Sharp corners, as in a street, which constrain turns best; and soft ones, as on nearly bare walls."""


def strongest(
    image: NDArray[np.uint8], number: int, apart_px: float, mask: NDArray[np.uint8], kind: Kind
) -> NDArray[np.float32]:
    """Return the strongest corners (N, 2) of an image where a mask is not 0, column and row with sub-pixel accuracy.

    An image narrower than the tracking window has none.
    """
    if min(image.shape) < max(WINDOW):
        return np.empty((0, 2), np.float32)
    strength = cv2.cornerMinEigenVal(image, kind.block)
    noise = max(float(np.percentile(strength[::4, ::4], QUIET)), ROUNDING)
    strong = mask * (strength > NOISE * noise)
    found = cv2.goodFeaturesToTrack(image, number, kind.quality, apart_px, mask=strong, blockSize=kind.block)
    if found is None:
        return np.empty((0, 2), np.float32)
    return np.asarray(cv2.cornerSubPix(image, found, (3, 3), (-1, -1), (3, 20, 0.01))[:, 0], np.float32)


def flow(
    before: NDArray[np.uint8], after: NDArray[np.uint8], pixels: NDArray[np.float32], guess: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the corners (N, 2) in another image, and which pass the forward-backward check (Lucas and Kanade 1981)."""
    if not len(pixels):
        return pixels, np.zeros(0, bool)
    settings: dict[str, Any] = {
        "winSize": WINDOW,
        "maxLevel": LEVELS,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
        "criteria": (3, 30, 0.01),
        "minEigThreshold": 1e-3,
    }
    size = np.array(after.shape[::-1], np.float32)
    guess = np.clip(np.asarray(guess, np.float32), 0, size - 1)
    there, ahead, _ = cv2.calcOpticalFlowPyrLK(before, after, pixels, guess.copy(), **settings)
    back, behind, _ = cv2.calcOpticalFlowPyrLK(after, before, there, there.copy(), **settings)
    there = np.asarray(there, np.float32)
    inside = np.all((there > 1) & (there < size - 2), axis=1)
    return there, (ahead[:, 0] > 0) & (behind[:, 0] > 0) & inside & (np.linalg.norm(back - pixels, axis=1) < BACK_PX)


def described(image: NDArray[np.uint8], pixels: NDArray[np.float32]) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
    """Return which corners can be described, and their ORB descriptors (N, 32) (Rublee and others 2011)."""
    points = [cv2.KeyPoint(float(u), float(v), 31.0, -1, 0, 0, i) for i, (u, v) in enumerate(pixels)]
    kept, descriptors = cv2.ORB.create().compute(image, points)
    if descriptors is None:
        return np.empty(0, np.intp), np.empty((0, 32), np.uint8)
    return np.array([point.class_id for point in kept], np.intp), np.asarray(descriptors, np.uint8)


def in_common(one: NDArray[np.uint8], other: NDArray[np.uint8]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the mutual nearest neighbours of two sets of descriptors: their indices in both."""
    if not len(one) or not len(other):
        return np.empty(0, np.intp), np.empty(0, np.intp)
    pairs = cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True).match(one, other)
    pairs = [pair for pair in pairs if pair.distance < ALIKE_BITS]
    return np.array([pair.queryIdx for pair in pairs], np.intp), np.array([pair.trainIdx for pair in pairs], np.intp)
