# SPDX-License-Identifier: Apache-2.0
"""Corners tracked through one camera's images, each with a distance, and keyframes of where they were seen.

Corners in grey images: detection, description, and optical flow to the next image. Stereo pairs: landmarks whose
distances are measured by the other eye.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.depth.stereo.pipeline import grey_rectified
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, StereoFrame, name_of
from stereovox.geometry.se3 import Transform
from stereovox.track.fit import Fit, Limits, Stage, solve_stages
from stereovox.track.sightings import AGREED, CONVERGED, REACHES, Corners, Sightings
from stereovox.track.views import is_new

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


ROWS_PX, MIN_DISPARITY, DISPARITY = 1.5, 0.2, 0.3
"""Largest row difference between the eyes, least disparity, and its standard deviation, in pixels."""
SEARCH = np.repeat([0.5, 3.0], 3)
"""Radians and metres around a kept view in which the pose is sought."""


class Eyes(NamedTuple):
    """Rectified grey images of a pair, (height, width) uint8."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]


class Pairs:
    """Evidence of a stereo pair: corners tracked from image to image and into the other eye.

    The pose is found by robust least squares on the landmarks' pixels and distances, starting from the pose that most
    of them agree on.

    Args:
        pair: The pair, with a pinhole camera.
    """

    limits = Limits(
        spread=np.array([0.1, 0.1, 0.1, 0.5, 0.5, 0.5]),
        unsure=(np.radians(1), 0.1),
        adrift=(np.radians(3), 0.3),
    )

    def __init__(self, pair: StereoPair):
        if not isinstance(pair.camera, PinholeCamera) or not pair.camera.baseline:
            raise StereovoxError(f"stereo pair '{pair.name}': its camera has no baseline; give it in metres")
        self._camera = pair.camera
        self._base = pair.camera.fx * pair.camera.baseline
        self._landmarks = Landmarks(pair.camera, SHARP)
        self._followed = Sightings(pair.camera)

    def see(self, frame: AnyFrame) -> Sight:
        """Return a stereo frame's images; raises FrameRefused as matching does."""
        if not isinstance(frame, StereoFrame):
            raise FrameRefused("bad_form", f"{name_of(frame)}: is no stereo pair, as those before")
        if frame.pair.camera != self._camera:
            raise FrameRefused("bad_form", f"{name_of(frame)}: is of another camera than those before; track one alone")
        frame = grey_rectified(frame)
        valid = frame.pair.valid
        if valid is not None and valid.shape != frame.left.shape:
            raise FrameRefused(
                "bad_shape", f"{name_of(frame)}: its mask is {valid.shape}, the image {frame.left.shape}"
            )
        mask = np.full(frame.left.shape, 255, np.uint8) if valid is None else valid.astype(np.uint8) * np.uint8(255)
        return Sight(frame.left, mask, partial(self._distances, Eyes(frame.left, frame.right)))

    def count(self, seen: Sight) -> None:
        """Do nothing: unusable pairs are refused."""

    def picture_use(self) -> str:
        """Return "": unusable pairs are refused."""
        return ""

    def forget(self) -> None:
        """Forget everything learned."""
        self._landmarks.forget()
        self._followed = Sightings(self._camera)

    def fit(self, seen: Sight, expected: Transform, doubt: NDArray[np.float64]) -> Fit:
        """Return the pose that explains where the landmarks are seen; `doubt` as in `solve_stages`."""
        self._followed = self._landmarks.follow(seen, expected)
        return _fit(self._followed, expected, doubt)

    def advance(self, seen: Sight, T: Transform) -> None:
        """Advance to an image at T_world_camera: improve the distances of tracked corners and add new ones."""
        self._landmarks.advance(seen, self._followed, T)
        self._followed = Sightings(self._camera)

    def learn(self, seen: Sight, T: Transform) -> None:
        """As `advance`, and keep the view if it is new."""
        self.advance(seen, T)
        self._landmarks.keep(seen, T)

    def seek(self, seen: Sight, last: Transform) -> list[Fit]:
        """Return how an image fits at the kept views that share most corners with it."""
        self._followed = Sightings(self._camera)
        return [_fit(found, T, np.diag(SEARCH**2)) for T, found in self._landmarks.seek(seen)]

    def doubted(self, seen: Sight, fit: Fit) -> str:
        """Return an objection to the pose of a tracked image: landmarks that agree on another one; "" if none."""
        return ""

    def ambiguous(self, seen: Sight, T: Transform, known: float) -> str:
        """Return "", as `contradicted`."""
        return ""

    def contradicted(self, seen: Sight, T: Transform) -> str:
        """Return "": corners that match by descriptor are rarely elsewhere."""
        return ""

    def _distances(
        self, eyes: Eyes, pixels: NDArray[np.float32], guess: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Measure corners of the left eye in the right one; see `landmarks.Distances`."""
        there = pixels - np.column_stack([guess * self._base, np.zeros(len(guess))]).astype(np.float32)
        right, found = flow(eyes.left, eyes.right, pixels, there)
        disparity, off = pixels[:, 0] - right[:, 0], np.abs(pixels[:, 1] - right[:, 1])
        good = found & (off < ROWS_PX) & (disparity > MIN_DISPARITY)
        return disparity.astype(float) / self._base, np.full(len(pixels), DISPARITY / self._base), good


def _fit(found: Sightings, expected: Transform, doubt: NDArray[np.float64]) -> Fit:
    if len(found) < AGREED:
        return Fit(expected, doubt, 0.0, 0.0)
    stages = [Stage(found.equations(reach), CONVERGED) for reach in REACHES]
    T, covariance = solve_stages(stages, expected, doubt, found.agreed(expected))  # else from `expected`
    return Fit(T, covariance, len(found) / max(found.sought, 1), found.inlier_share(T))
