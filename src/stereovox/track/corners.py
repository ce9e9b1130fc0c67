# SPDX-License-Identifier: Apache-2.0
"""Corners in grey images: where the strongest are, how they look, and where they are in the next image."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

QUIET, NOISE = 10, 5.0
"""Percent of an image that shows no corners but noise, and how much stronger than that corners are."""
ROUNDING = 1e-6
"""Strength of the noise of an image in whole grey levels."""
WINDOW, LEVELS = (15, 15), 3
"""Pixels around a corner that are followed, in images halved so many times."""
BACK_PX = 0.25
"""Pixels by which a corner may miss where it came from when it is followed back."""
ALIKE_BITS = 50
"""Bits by which ORB descriptors of one corner may differ."""


class Kind(NamedTuple):
    """Which corners are followed.

    block: pixels across of the square by which their strength is reported. quality: their least strength by that of the
    strongest (Shi and Tomasi 1994). fewer: share of them that may be lost before new ones are looked for.
    """

    block: int
    quality: float
    fewer: float


SHARP, SOFT = Kind(3, 0.01, 0.0), Kind(7, 0.003, 0.15)
"""Corners of a street, which turns are told by best, and those that walls with little on them have."""


def strongest(
    image: NDArray[np.uint8], number: int, apart_px: float, mask: NDArray[np.uint8], kind: Kind
) -> NDArray[np.float32]:
    """Return the strongest corners (N, 2) of an image where a mask is not 0, column and row to a part of a pixel.

    None in an image that is narrower than what is followed around a corner.
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
    """Return where corners (N, 2) are in another image, and which are found there and back (Lucas and Kanade 1981)."""
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
    """Return which corners of two sets of descriptors are each other's likest: their numbers here and there."""
    if not len(one) or not len(other):
        return np.empty(0, np.intp), np.empty(0, np.intp)
    pairs = cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True).match(one, other)
    pairs = [pair for pair in pairs if pair.distance < ALIKE_BITS]
    return np.array([pair.queryIdx for pair in pairs], np.intp), np.array([pair.trainIdx for pair in pairs], np.intp)
