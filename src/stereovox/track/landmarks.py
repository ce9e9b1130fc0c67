# SPDX-License-Identifier: Apache-2.0
"""Corners tracked through one camera's images, each with a distance, and keyframes of where they were seen."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.geometry.se3 import Transform
from stereovox.track.corners import Kind, described, flow, in_common, strongest
from stereovox.track.sightings import AGREED, Corners, Sightings
from stereovox.track.views import is_new

NUMBER, APART_PX = 400, 12
"""Most corners that are tracked, and pixels between new ones."""
VIEW_M, VIEW_RAD, VIEWS = 1.0, np.radians(15), 100
"""Least distance between kept views, used for relocalization; only the latest are kept, this many."""
NEAREST_M = 0.3
"""Depth below which landmarks are dropped."""
TRIED = 4
"""Number of kept views tried when lost, the best matches first."""

Distances = Callable[
    [NDArray[np.float32], NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]
]
"""Measures corners: takes pixels (N, 2) and guessed inverse depths (N,) in 1/m, 0 for none; returns inverse
depths (N,), their standard deviations (N,), and which of them were measured."""


class Sight(NamedTuple):
    """A grey image (height, width) uint8, which of its pixels (height, width) may be used (not 0), and their depths."""

    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    distances: Distances


class View(NamedTuple):
    """A kept view: its pose, its corners, and their ORB descriptors (N, 32)."""

    T: Transform
    corners: Corners
    descriptors: NDArray[np.uint8]


class Landmarks:
    """Corners tracked from image to image; each observation improves a corner's inverse distance.

    Args:
        camera: The camera that takes the images, without distortion.
        kind: Kind of corners to track.
    """

    def __init__(self, camera: PinholeCamera, kind: Kind):
        self.camera, self._kind = camera, kind
        self.forget()

    def forget(self) -> None:
        """Forget everything learned."""
        self._corners, self._views = Corners(), list[View]()
        self._image, self._filled = np.empty((0, 0), np.uint8), 0

    def follow(self, sight: Sight, expected: Transform) -> Sightings:
        """Return the landmarks found in an image taken near T_world_camera."""
        corners = self._corners
        corners = corners.those(corners.in_camera(expected)[:, 2] > NEAREST_M * corners.inverse)
        if not len(corners):
            return Sightings(self.camera, sought=len(self._corners))
        guess = corners.projected(self.camera, expected)
        pixels, found = flow(self._image, sight.image, corners.pixels, guess[:, :2])
        measured, deviation, good = _measured(sight, pixels, guess[:, 2])
        return Sightings(self.camera, corners, measured, deviation, len(self._corners)).those(found & good)

    def advance(self, sight: Sight, followed: Sightings, T: Transform) -> None:
        """Advance to an image at T_world_camera: improve the distances of tracked corners and add new ones."""
        self._corners = followed.improved(T)
        self._image = sight.image
        new = self._new(sight, T)
        if len(new):
            self._corners = self._corners.with_(new)
            self._filled = len(self._corners)

    def keep(self, sight: Sight, T: Transform) -> None:
        """Keep the view from T_world_camera, just passed to `advance`, if it is new."""
        if is_new([view.T for view in self._views], T, VIEW_M, VIEW_RAD):
            which, descriptors = described(sight.image, self._corners.pixels)
            self._views = [*self._views[1 - VIEWS :], View(T, self._corners.those(which), descriptors)]

    def seek(self, sight: Sight) -> list[tuple[Transform, Sightings]]:
        """Return the poses of the kept views that share most corners with an image, and the shared landmarks."""
        pixels = strongest(sight.image, NUMBER, APART_PX / 2, sight.mask, self._kind)
        which, descriptors = described(sight.image, pixels)
        measured, deviation, good = _measured(sight, pixels[which], np.zeros(len(which)))
        measured, deviation, descriptors = measured[good], deviation[good], descriptors[good]
        if len(measured) < AGREED:
            return []
        common = [(view, *in_common(view.descriptors, descriptors)) for view in self._views]
        return [
            (view.T, Sightings(self.camera, view.corners.those(old), measured[new], deviation[new], sought))
            for view, old, new in sorted(common, key=lambda found: -len(found[1]))[:TRIED]
            if (sought := len(view.corners) // 2) and len(old)
        ]

    def _new(self, sight: Sight, T: Transform) -> Corners:
        """Return new landmarks, away from existing ones."""
        if len(self._corners) > (1 - self._kind.fewer) * self._filled:
            return Corners()
        wanted = NUMBER - len(self._corners)
        mask = sight.mask.copy()
        for u, v in self._corners.pixels:
            cv2.circle(mask, (round(float(u)), round(float(v))), APART_PX, 0, -1)
        pixels = strongest(sight.image, wanted, APART_PX, mask, self._kind)
        measured, deviation, good = _measured(sight, pixels, np.zeros(len(pixels)))
        pixels, inverse, deviation = pixels[good], measured[good, 2], deviation[good]
        ray = (pixels - (self.camera.cx, self.camera.cy)) / (self.camera.fx, self.camera.fy)
        ray = np.column_stack([ray, np.ones(len(ray))]) @ T[:3, :3].T
        centre = np.tile(T[:3, 3], (len(pixels), 1))
        return Corners(pixels, centre, ray, inverse, deviation**2, np.ones(len(pixels)))


def _measured(
    sight: Sight, pixels: NDArray[np.float32], guess: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return measured corners (N, 3): pixels and inverse depth; its deviation (N,), and which are usable."""
    inverse, deviation, good = sight.distances(pixels, guess)
    column, row = np.clip(np.rint(pixels), 0, np.array(sight.mask.shape[::-1]) - 1).astype(int).T
    return np.column_stack([pixels, inverse]).astype(float), deviation, good & (sight.mask[row, column] > 0)
