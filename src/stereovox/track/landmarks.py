# SPDX-License-Identifier: Apache-2.0
"""Corners followed through the images of a stereo pair, and the pose from which they are seen where they are."""

from __future__ import annotations

from dataclasses import dataclass, field
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
from stereovox.se3 import Transform, inverse
from stereovox.track.fit import Fit, Limits, Stage, settled
from stereovox.track.views import is_new

NUMBER, APART_PX, QUALITY = 400, 12, 0.01
"""Corners that are followed at most, pixels between new ones, and their least strength by that of the strongest (Shi
and Tomasi 1994)."""
MAX_AGE = 20
"""Images through which one corner is followed."""
WINDOW, LEVELS = (15, 15), 3
"""Pixels around a corner that are followed, in images halved so many times."""
BACK_PX, ROWS_PX = 0.25, 1.5
"""Pixels by which a corner may miss where it came from when it is followed back, and by which rows may differ."""
MIN_DISPARITY = 0.2
PIXEL, DISPARITY = 0.3, 0.3
"""Standard deviations of a corner's place and of its disparity, in pixels."""
REACHES = (1e2, 9.0)
"""Squared deviations at which a landmark begins to count little, of three residuals, stage by stage."""
USUAL = 16.0
"""Squared deviations within which a landmark is where it should be."""
LOOKS = 6
"""Looks at one landmark that improve its distance: later ones err alike."""
ALIKE = 2.0
"""Landmarks whose errors are alike, so that they tell no more than one."""
CONVERGED = 1e-5
NEAR_PX, AGREED = 2.0, 15
"""Disparity of landmarks that find the pose, and how many must agree."""
VIEW_M, VIEW_RAD, VIEWS = 1.0, np.radians(15), 100
"""Views this far apart are kept, to find the way back from; so many, the latest."""
ALIKE_BITS = 50
"""Bits by which ORB descriptors of one corner may differ."""
NEAREST_M = 0.3
"""Depth below which landmarks are not followed on."""
TRIED = 4
"""Kept views that are tried when lost: those with most in common."""


class Seen(NamedTuple):
    """Rectified grey images of a pair, (height, width) uint8, and which pixels (height, width) may be used: not 0."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    mask: NDArray[np.uint8]


@dataclass
class Corners:
    """Landmarks, each by the ray on which it was first seen. World frame.

    pixels: (N, 2) float32, in the latest image. centre, ray: (N, 3) where that camera was, and the direction with depth
    1. inverse: (N,) 1 / depth along the ray's camera's axis, in 1/m; variance: (N,) of it. looks: (N,).
    """

    pixels: NDArray[np.float32] = field(default_factory=lambda: np.empty((0, 2), np.float32))
    centre: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    ray: NDArray[np.float64] = field(default_factory=lambda: np.empty((0, 3)))
    inverse: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    variance: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    looks: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        return len(self.inverse)

    def those(self, which: NDArray[Any]) -> Corners:
        """Return some of the landmarks."""
        return Corners(*(part[which] for part in vars(self).values()))

    def with_(self, other: Corners) -> Corners:
        """Return these landmarks and others."""
        return Corners(*(np.concatenate(both) for both in zip(vars(self).values(), vars(other).values(), strict=True)))


class View(NamedTuple):
    """What an image showed: its pose, its corners, and ORB descriptors of these (N, 32)."""

    T: Transform
    corners: Corners
    descriptors: NDArray[np.uint8]


class Landmarks:
    """Evidence of a stereo pair: corners, followed from image to image and into the other eye (Lucas and Kanade 1981).

    Each landmark has an inverse distance that its looks improve; the pose is that from which they are seen where they
    are, and at the disparities that they have, by robust least squares from what most of them agree on (PnP, RANSAC).

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
        self._camera, self._base = pair.camera, pair.camera.fx * pair.camera.baseline
        self._corners, self._views = Corners(), list[View]()
        self._image = np.empty((0, 0), np.uint8)
        self._followed = Corners(), np.empty((0, 3))
        self._orb = cv2.ORB.create()

    def see(self, frame: AnyFrame) -> Seen:
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
        return Seen(frame.left, frame.right, mask)

    def forget(self) -> None:
        """Forget all that was learned."""
        self._corners, self._views, self._followed = Corners(), [], (Corners(), np.empty((0, 3)))

    def fit(self, seen: Seen, expected: Transform, doubt: NDArray[np.float64]) -> Fit:
        """Return the pose from which the landmarks are seen where they are; `doubt` as in `settled`."""
        corners, measured = self._followed = self._follow(seen, expected)
        return self._fit(corners, measured, len(self._corners), expected, doubt)

    def _fit(
        self, corners: Corners, measured: NDArray[np.float64], of: int, expected: Transform, doubt: NDArray[np.float64]
    ) -> Fit:
        """Return how landmarks that were found fit, which are a share of so many."""
        if len(corners) < AGREED:
            return Fit(expected, doubt, 0.0, 0.0)
        stages = [Stage(partial(self._equations, corners, measured, reach), CONVERGED) for reach in REACHES]
        T, covariance = settled(stages, expected, doubt, self._agreed(corners, measured, expected))
        usual = float(np.mean(self._residuals(corners, measured, T)[0] < USUAL))
        return Fit(T, covariance, len(corners) / max(of, 1), usual)

    def advance(self, seen: Seen, T: Transform) -> None:
        """Go on from an image at T_world_camera: better distances of what was followed into it, and new corners."""
        self._corners = self._improved(*self._followed, T)
        self._followed = Corners(), np.empty((0, 3))
        self._image = seen.left
        self._corners = self._corners.with_(self._new(seen, T))

    def learn(self, seen: Seen, T: Transform) -> None:
        """As `advance`, and keep the view where it is new."""
        self.advance(seen, T)
        if is_new([view.T for view in self._views], T, VIEW_M, VIEW_RAD):
            which, descriptors = self._described(seen.left, self._corners.pixels)
            self._views = [*self._views[1 - VIEWS :], View(T, self._corners.those(which), descriptors)]

    def seek(self, seen: Seen, last: Transform) -> list[Fit]:
        """Return how an image fits at the kept views that it has most corners in common with."""
        self._followed = Corners(), np.empty((0, 3))
        pixels = _corners_of(seen.left, NUMBER, APART_PX / 2, seen.mask)
        which, descriptors = self._described(seen.left, pixels)
        pixels = pixels[which]
        disparity, good = self._disparity(seen, pixels, np.zeros(len(pixels)))
        pixels, disparity, descriptors = pixels[good], disparity[good], descriptors[good]
        if len(pixels) < AGREED:
            return []
        matcher = cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True)
        common = [(view, matcher.match(view.descriptors, descriptors)) for view in self._views if len(view.descriptors)]
        common = [(view, [m for m in pairs if m.distance < ALIKE_BITS]) for view, pairs in common]
        fits = []
        for view, pairs in sorted(common, key=lambda both: -len(both[1]))[:TRIED]:
            old, new = np.array([m.queryIdx for m in pairs], int), np.array([m.trainIdx for m in pairs], int)
            measured = np.column_stack([pixels[new], disparity[new]]).astype(float)
            doubt = np.diag(np.repeat([0.5, 3.0], 3) ** 2)
            fits.append(self._fit(view.corners.those(old), measured, len(view.corners) // 2, view.T, doubt))
        return fits

    def contradicted(self, seen: Seen, T: Transform) -> str:
        """Return "": corners that fit by their looks are seldom anywhere else."""
        return ""

    def _described(
        self, image: NDArray[np.uint8], pixels: NDArray[np.float32]
    ) -> tuple[NDArray[np.intp], NDArray[np.uint8]]:
        """Return which corners can be described, and their ORB descriptors (Rublee and others 2011)."""
        points = [cv2.KeyPoint(float(u), float(v), 31.0, -1, 0, 0, i) for i, (u, v) in enumerate(pixels)]
        kept, descriptors = self._orb.compute(image, points)
        if descriptors is None:
            return np.empty(0, np.intp), np.empty((0, 32), np.uint8)
        return np.array([point.class_id for point in kept], np.intp), np.asarray(descriptors, np.uint8)

    def _improved(self, corners: Corners, measured: NDArray[np.float64], T: Transform) -> Corners:
        """Return landmarks that were found where they should be, with what this look tells of their distances."""
        if not len(corners):
            return corners
        squares, off, _, _, by_inverse = self._residuals(corners, measured, T)
        fresh = by_inverse / (2 * PIXEL**2, 2 * PIXEL**2, DISPARITY**2)
        variance = 1 / (1 / corners.variance + np.einsum("ni,ni->n", fresh, by_inverse))
        corners.inverse = np.maximum(corners.inverse + variance * np.einsum("ni,ni->n", fresh, off), 1e-6)
        corners.variance = np.maximum(variance, (DISPARITY / self._base) ** 2 / LOOKS)
        corners.pixels, corners.looks = measured[:, :2].astype(np.float32), corners.looks + 1
        return corners.those((squares < USUAL) & (corners.looks < MAX_AGE))

    def _agreed(self, corners: Corners, measured: NDArray[np.float64], expected: Transform) -> Transform:
        """Return the pose that most landmarks agree on (PnP, RANSAC), where there is one; else the expected one."""
        near = corners.inverse * self._base > NEAR_PX
        if near.sum() < AGREED:
            return expected
        points = corners.centre[near] + corners.ray[near] / corners.inverse[near, None] - expected[:3, 3]
        camera = self._camera
        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        R = expected[:3, :3].T
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points @ R.T, measured[near, :2], K, None, np.zeros((3, 1)), np.zeros((3, 1)), True, 100, 2.0, 0.999
        )
        if not found or inliers is None or len(inliers) < max(AGREED, 0.5 * near.sum()):
            return expected
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], shift[:, 0]
        return expected @ inverse(T)

    def _follow(self, seen: Seen, expected: Transform) -> tuple[Corners, NDArray[np.float64]]:
        """Return the landmarks that are found in an image, and where: (N, 3) column, row, disparity in pixels."""
        corners = self._corners
        corners = corners.those(self._in_camera(corners, expected)[:, 2] > NEAREST_M * corners.inverse)
        if not len(corners):
            return corners, np.empty((0, 3))
        guess = self._projected(corners, expected)
        pixels, found = _flow(self._image, seen.left, corners.pixels, guess[:, :2])
        disparity, matched = self._disparity(seen, pixels, guess[:, 2])
        good = found & matched
        return corners.those(good), np.column_stack([pixels, disparity])[good].astype(float)

    def _disparity(
        self, seen: Seen, pixels: NDArray[np.float32], guess: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        there = pixels - np.column_stack([guess, np.zeros(len(guess))]).astype(np.float32)
        right, found = _flow(seen.left, seen.right, pixels, there)
        disparity, off = pixels[:, 0] - right[:, 0], np.abs(pixels[:, 1] - right[:, 1])
        column, row = np.clip(np.rint(pixels), 0, np.array(seen.mask.shape[::-1]) - 1).astype(int).T
        return disparity, found & (seen.mask[row, column] > 0) & (off < ROWS_PX) & (disparity > MIN_DISPARITY)

    def _new(self, seen: Seen, T: Transform) -> Corners:
        """Return new landmarks, away from those that there are."""
        wanted = NUMBER - len(self._corners)
        if wanted <= 0:
            return Corners()
        mask = seen.mask.copy()
        for u, v in self._corners.pixels:
            cv2.circle(mask, (round(float(u)), round(float(v))), APART_PX, 0, -1)
        pixels = _corners_of(seen.left, wanted, APART_PX, mask)
        disparity, good = self._disparity(seen, pixels, np.zeros(len(pixels)))
        pixels, disparity = pixels[good], disparity[good].astype(float)
        ray = (pixels - (self._camera.cx, self._camera.cy)) / (self._camera.fx, self._camera.fy)
        ray = np.column_stack([ray, np.ones(len(ray))]) @ T[:3, :3].T
        number = len(pixels)
        variance = np.full(number, (DISPARITY / self._base) ** 2)
        return Corners(pixels, np.tile(T[:3, 3], (number, 1)), ray, disparity / self._base, variance, np.ones(number))

    def _projected(self, corners: Corners, T: Transform) -> NDArray[np.float64]:
        """Return where landmarks are seen from T_world_camera: (N, 3) column, row, disparity in pixels."""
        x, y, z = self._in_camera(corners, T).T
        camera = self._camera
        return np.column_stack(
            [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy, self._base * corners.inverse / z]
        )

    def _in_camera(self, corners: Corners, T: Transform) -> NDArray[np.float64]:
        """Return landmarks (N, 3) in the camera's frame, times their inverse distances."""
        seen = (corners.inverse[:, None] * (corners.centre - T[:3, 3]) + corners.ray) @ T[:3, :3]
        seen[:, 2] = np.maximum(seen[:, 2], 1e-3)
        return seen

    def _equations(
        self, corners: Corners, measured: NDArray[np.float64], reach: float, T: Transform
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        squares, off, weight, by_motion, _ = self._residuals(corners, measured, T)
        weight = weight / (ALIKE * (1 + squares / reach) ** 2)[:, None, None]
        weighted = np.einsum("nik,nij->nkj", by_motion, weight)
        return np.einsum("nki,nij->kj", weighted, by_motion), np.einsum("nki,ni->k", weighted, off)

    def _residuals(self, corners: Corners, measured: NDArray[np.float64], T: Transform) -> tuple[NDArray[Any], ...]:
        """Return of each landmark: squared deviations (N,), how far off it is (N, 3) pixels, the inverse covariance of
        that (N, 3, 3), the derivatives of its place by the camera's motion (N, 3, 6) and by its inverse depth (N, 3).
        """
        camera, R = self._camera, T[:3, :3]
        x, y, z = self._in_camera(corners, T).T
        off = measured - self._projected(corners, T)
        by_place = np.zeros((len(corners), 3, 3))
        by_place[:, 0, 0], by_place[:, 0, 2] = camera.fx / z, -camera.fx * x / z**2
        by_place[:, 1, 1], by_place[:, 1, 2] = camera.fy / z, -camera.fy * y / z**2
        by_place[:, 2, 2] = -self._base * corners.inverse / z**2
        by_world = by_place @ R.T
        moved = corners.inverse[:, None] * (corners.centre - T[:3, 3])
        q = moved + corners.ray
        turn = np.zeros((len(corners), 3, 3))
        turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = -q[:, 2], q[:, 1], -q[:, 0]
        turn -= np.swapaxes(turn, 1, 2)
        by_motion = np.concatenate([by_world @ turn, -corners.inverse[:, None, None] * by_world], axis=2)
        by_inverse = np.einsum("nij,nj->ni", by_world, corners.centre - T[:3, 3])
        by_inverse[:, 2] += self._base / z
        covariance = corners.variance[:, None, None] * by_inverse[:, :, None] * by_inverse[:, None, :]
        weight = np.linalg.inv(covariance + np.diag([2 * PIXEL**2, 2 * PIXEL**2, DISPARITY**2]))
        return np.einsum("ni,nij,nj->n", off, weight, off), off, weight, by_motion, by_inverse


def _corners_of(image: NDArray[np.uint8], number: int, apart_px: float, mask: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the strongest corners (N, 2) of an image where a mask is not 0, to a part of a pixel."""
    found = cv2.goodFeaturesToTrack(image, number, QUALITY, apart_px, mask=mask)
    if found is None:
        return np.empty((0, 2), np.float32)
    return np.asarray(cv2.cornerSubPix(image, found, (3, 3), (-1, -1), (3, 20, 0.01))[:, 0], np.float32)


def _flow(
    before: NDArray[np.uint8], after: NDArray[np.uint8], pixels: NDArray[np.float32], guess: NDArray[np.floating]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where corners (N, 2) are in another image, and which are found there and back."""
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
