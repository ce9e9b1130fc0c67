# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs: landmarks whose distances are measured by the other eye."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import StereoPair
from stereovox.depth.stereo.pipeline import grey_rectified
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, StereoFrame, name_of
from stereovox.geometry.se3 import Transform
from stereovox.track.corners import SHARP, flow
from stereovox.track.fit import Fit, Limits, Stage, solve_stages
from stereovox.track.landmarks import Landmarks, Sight
from stereovox.track.sightings import AGREED, CONVERGED, REACHES, Sightings

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
