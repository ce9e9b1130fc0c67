# SPDX-License-Identifier: Apache-2.0
"""Color images next to depth images: landmarks whose distances come from the depth image."""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth.stereo.pipeline import grey
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage, Photo
from stereovox.frame.validate import matrix_of
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rigidity_error, transform_points
from stereovox.track._sightings import laid_into
from stereovox.track.fit import RIGID, Equations, Fit, Stage, motion_between, solve_stages
from stereovox.track.landmarks import SOFT, WINDOW, Landmarks, Sight
from stereovox.track.sightings import AGREED, CONVERGED, REACHES, Sightings
from stereovox.track.views import View, stood_free

MAX_ARM_M = 10.0
"""Largest distance of a color camera from the depth camera."""
CELL, STEP = 4.0, 2
"""Width of the other image's cells in depth pixels, and stride of the depth pixels used along each axis."""
FOLLOWED = 0.2
"""Least share of landmarks that must be found again: corners of noise are not."""
LAG = 0.05
"""Share of a camera's motion since the previous image by which it may move between color and depth."""
MOVED_M, MOVED_RAD = 0.005, np.radians(0.3)
"""Least motion between color images for their agreement with depth to count."""
CREDIT, MOST_CREDIT = 5, 20
"""Agreements needed before color images may contradict depth, and how many are remembered."""
MOST = 0.6
"""Least share of inlier landmarks for a pose that they agree on."""
SMOOTH = 0.02
"""Largest relative difference, beyond noise, of mean inverse depths near a corner and in its window.

On a plane they agree; a corner on a depth edge is no fixed point.
"""


class Sighted(NamedTuple):
    """An image next to a depth image; camera, T_sensor_camera: as in `Photo`."""

    sight: Sight
    camera: PinholeCamera
    T_sensor_camera: Transform


class PhotoLandmarks(NamedTuple):
    """Landmarks found in a color image, and their constraints on the depth camera's pose.

    lag: (6, 6) covariance of the camera's motion between both images, as in `Fit`.
    """

    found: Sightings
    T_sensor_camera: Transform
    lag: NDArray[np.float64]

    def equations(self, reach: float = REACHES[-1]) -> Equations:
        """Return the equations of the depth camera's pose; reach: as in `Sightings.equations`."""
        return of_sensor(self.found.equations(reach), self.T_sensor_camera)

    def fit(self, expected: Transform, doubt: NDArray[np.float64]) -> Fit | None:
        """Return the pose of the depth camera that most landmarks agree on; None if they agree on none.

        expected, doubt: as in `solve_stages`.
        """
        agreed = self.found.agreed(expected @ self.T_sensor_camera)
        if agreed is None:
            return None
        stages = [Stage(self.equations(reach), CONVERGED) for reach in REACHES]
        T, covariance = solve_stages(stages, expected, doubt, agreed @ inverse(self.T_sensor_camera))
        found = Fit(T, covariance, len(self.found) / max(self.found.sought, 1), self.inlier_share(T))
        return found if found.inlier_share > MOST else None

    def inlier_share(self, T: Transform) -> float:
        """Return the share of inliers among the landmarks for a depth camera at T."""
        return self.found.inlier_share(T @ self.T_sensor_camera)


class Photos:
    """Landmarks in the color images of a depth camera; unusable images are left out.

    Attributes:
        offered: Number of images so far.
        left_out: Number of unusable images.
        why: What was wrong with the first of them.
    """

    def __init__(self) -> None:
        self.offered, self.left_out, self.why = 0, 0, ""
        self._landmarks: Landmarks | None = None
        self._last, self._credit = np.eye(4), 0
        self._followed: PhotoLandmarks | None = None

    def forget(self) -> None:
        """Forget everything learned."""
        self._landmarks = self._followed = None
        self._credit = 0

    def count(self, why: str | None) -> None:
        """Count an image; `why` as in `sighted_or_why`."""
        self.offered += why is not None
        self.left_out += bool(why)
        self.why = self.why or why or ""

    def picture_use(self) -> str:
        """Return how many images are used, or how many are not and why, in words; "" if there are none."""
        if self.left_out:
            count = f"{self.left_out} of {self.offered} pictures next to depth images are not used"
            return f"{count}; the first: {self.why}"
        return f"{self.offered} pictures next to depth images are used" if self.offered else ""

    def agree(self, T: Transform) -> None:
        """Record that landmarks and depth agree on T_map_sensor, which counts if the camera has moved."""
        motion = motion_between(self._last, T)
        if np.linalg.norm(motion[:3]) > MOVED_RAD or np.linalg.norm(motion[3:]) > MOVED_M:
            self._credit = min(self._credit + 1, MOST_CREDIT)

    def trusted(self) -> bool:
        """Return whether landmarks may contradict depth, because they agreed with it before; this costs trust.

        A projected pattern moves with the camera and never agrees.
        """
        self._credit -= 1
        trusted = self._credit >= CREDIT
        self._credit = max(self._credit, 0)
        return trusted

    def follow(self, seen: Sighted | None, expected: Transform, views: list[View]) -> PhotoLandmarks | None:
        """Return the landmarks found in an image near T_map_sensor, less those in the free space of views;
        None if they are too few.
        """
        self._followed = None
        if seen is None or self._landmarks is None or self._landmarks.camera != seen.camera:
            return None
        found = self._landmarks.follow(seen.sight, expected @ seen.T_sensor_camera)
        points = transform_points(inverse(expected), found.corners.points).astype(np.float32)
        sigma = (found.deviation / np.maximum(found.corners.inverse, 1e-3) ** 2).astype(np.float32)
        found = found.those(~stood_free(points, sigma, expected, views))
        enough = len(found) >= max(AGREED, FOLLOWED * found.sought)
        moved = motion_between(self._last, expected)
        lag = np.repeat([np.linalg.norm(moved[:3]), np.linalg.norm(moved[3:])], 3) * LAG
        self._followed = (
            PhotoLandmarks(found, seen.T_sensor_camera, np.diag(np.square(lag, dtype=np.float64))) if enough else None
        )
        return self._followed

    def advance(self, seen: Sighted | None, T: Transform) -> None:
        """Advance to an image whose depth camera is at T_map_sensor."""
        self._last = T
        if seen is None:
            return
        if self._landmarks is None or self._landmarks.camera != seen.camera:
            self._landmarks = Landmarks(seen.camera, SOFT)
        found = Sightings(seen.camera) if self._followed is None else self._followed.found
        self._landmarks.advance(seen.sight, found, T @ seen.T_sensor_camera)
        self._followed = None

    def learn(self, seen: Sighted | None, T: Transform) -> None:
        """As `advance`, and keep the view if it is new."""
        self.advance(seen, T)
        if seen is not None and self._landmarks is not None:
            self._landmarks.keep(seen.sight, T @ seen.T_sensor_camera)

    def seek(self, seen: Sighted | None) -> list[tuple[Transform, PhotoLandmarks]]:
        """Return the poses of views similar to an image, and the landmarks that both share."""
        self._followed = None
        if seen is None or self._landmarks is None or self._landmarks.camera != seen.camera:
            return []
        found = [
            (T, PhotoLandmarks(one, seen.T_sensor_camera, np.zeros((6, 6))))
            for T, one in self._landmarks.seek(seen.sight)
        ]
        return [(T @ inverse(seen.T_sensor_camera), one) for T, one in found if len(one.found) >= AGREED]


def sighted_or_why(
    photo: Photo | None, image: DepthImage, sigma_of: NDArray[np.float64], rows_per_metre: float
) -> tuple[Sighted | None, str | None]:
    """Return the used parts of an image, and why it is unusable: "" if it is usable, None if there is no image.

    sigma_of: standard deviation of a depth, indexed by depth times `rows_per_metre`.
    """
    try:
        return (None, None) if photo is None else (sighted(photo, image, sigma_of, rows_per_metre), "")
    except FrameRefused as refused:
        return None, str(refused)


def sighted(photo: Photo, image: DepthImage, sigma_of: NDArray[np.float64], rows_per_metre: float) -> Sighted:
    """Return an image with the depths of the depth image next to it; the rest as in `sighted_or_why`.

    Raises FrameRefused if the image cannot be read, or does not match its camera.
    """
    camera, T_sensor_camera = _camera_of(photo)
    pixels = photo.pixels() if callable(photo.pixels) else photo.pixels
    picture = grey(pixels, (camera.width, camera.height), "the image next to the depth image")
    cell_px, depths = inverse_depths(image, camera, T_sensor_camera, sigma_of, rows_per_metre)
    known = np.where(depths > 0, np.uint8(255), np.uint8(0)).repeat(cell_px, axis=0).repeat(cell_px, axis=1)
    mask = np.ascontiguousarray(known[: camera.height, : camera.width])
    sigma = sigma_of / np.square(np.maximum(np.arange(len(sigma_of)), 1) / rows_per_metre)  # of the inverse depth
    sight = Sight(picture, mask, partial(_distances, cell_px, depths, sigma, rows_per_metre))
    return Sighted(sight, camera, T_sensor_camera)


def _camera_of(photo: Photo) -> tuple[PinholeCamera, Transform]:
    """Return the camera of an image next to a depth image and its T_sensor_camera; raises FrameRefused `bad_form`."""
    if not isinstance(photo, Photo) or not isinstance(photo.camera, PinholeCamera):
        given = getattr(photo, "camera", photo)
        raise FrameRefused("bad_form", f"photo: {type(given).__name__} is no camera; give sv.Photo(pixels, camera)")
    T = matrix_of(photo.T_sensor_camera)
    if not rigidity_error(T) < RIGID:
        raise FrameRefused("bad_form", "T_sensor_camera of the image next to the depth image is no rigid motion")
    arm = float(np.linalg.norm(T[:3, 3]))
    if arm > MAX_ARM_M:
        raise FrameRefused("bad_form", f"T_sensor_camera of the image next to the depth image: {arm:g} m; give metres")
    return photo.camera, orthonormalise(T)


def of_sensor(equations: Equations, T_sensor_camera: Transform) -> Equations:
    """Return equations of a camera's pose as those of the pose of a sensor that carries it."""

    def carried(T: Transform) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        information, gradient = equations(T @ T_sensor_camera)
        x, y, z = T[:3, :3] @ T_sensor_camera[:3, 3]
        by_sensor = np.eye(6)  # the sensor's turn shifts the camera by turn times arm
        by_sensor[3:, :3] = [[0, z, -y], [-z, 0, x], [y, -x, 0]]
        return by_sensor.T @ information @ by_sensor, by_sensor.T @ gradient

    return carried


def inverse_depths(
    image: DepthImage,
    camera: PinholeCamera,
    T_sensor_camera: Transform,
    sigma_of: NDArray[np.float64],
    rows_per_metre: float,
) -> tuple[int, NDArray[np.float32]]:
    """Return the width of cells in pixels of another camera's image, and their inverse depths there in 1/m.

    sigma_of: as in `sighted_or_why`.

    (h, w) float32, the mean of each cell and those around it; 0 if there is none, and next to edges.
    """
    cell_px = max(1, math.ceil(CELL * max(1.0, camera.focal_px / image.camera.focal_px)))
    shape = math.ceil(camera.height / cell_px), math.ceil(camera.width / cell_px)
    total, number = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    T = np.asarray(inverse(T_sensor_camera), np.float32)
    columns, rows = (np.ascontiguousarray(rays, np.float32) for rays in image.camera.rays())
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float32)
    R, t = np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])
    laid_into(image.depth_m, columns, rows, R, t, lens, np.float32(cell_px), STEP, total, number)
    own, near, window = (_mean(total, number, cells) for cells in (1, 3, 1 + 2 * round(WINDOW[0] / 2 / cell_px)))
    depth = 1 / np.maximum(near, np.float32(1e-3))
    sigma = sigma_of[np.minimum(depth * rows_per_metre, len(sigma_of) - 1).astype(int)]
    unlike = np.maximum(np.abs(own - near), np.abs(window - near))
    good = (number > 0) & (unlike <= np.maximum(SMOOTH * near, sigma / depth**2))
    return cell_px, np.where(good, near, np.float32(0)).astype(np.float32)


def _mean(total: NDArray[np.float32], number: NDArray[np.float32], cells: int) -> NDArray[np.float32]:
    """Return the mean inverse depth in a window of `cells` cells around each."""
    sums = [
        np.asarray(cv2.boxFilter(part, -1, (cells, cells), normalize=False), np.float32) for part in (total, number)
    ]
    return (sums[0] / np.maximum(sums[1], 1)).astype(np.float32)


def _distances(
    cell_px: int,
    depths: NDArray[np.float32],
    sigma: NDArray[np.float64],
    rows_per_metre: float,
    pixels: NDArray[np.float32],
    guess: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Measure corners by the depths of the four cells around them; see `landmarks.Distances`.

    sigma: of an inverse depth, indexed by depth times `rows_per_metre`.
    """
    place = (pixels + 0.5) / cell_px - 0.5
    first = np.floor(place).astype(int)
    part = place - first
    first = np.clip(first, 0, np.array(depths.shape[::-1]) - 2)
    columns, rows = first.T
    corners = np.stack([depths[rows + k, columns + j] for k in (0, 1) for j in (0, 1)])
    shares = np.stack([(1 - abs(k - part[:, 1])) * (1 - abs(j - part[:, 0])) for k in (0, 1) for j in (0, 1)])
    inverse_depth = np.einsum("kn,kn->n", corners.astype(float), shares)
    good = np.all(corners > 0, axis=0) & np.all((part >= 0) & (part <= 1), axis=1)
    row = np.minimum(rows_per_metre / np.where(good, inverse_depth, 1.0), len(sigma) - 1).astype(int)
    return inverse_depth, sigma[row], good
