# SPDX-License-Identifier: Apache-2.0
"""Wide depth images cut into pinhole images: the faces of a cube round the eye, as far as the camera sees them."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.frame import DepthImage, Reason
from stereovox.geometry import Transform
from stereovox.wide import CylindricalCamera, SphericalCamera

WideCamera = SphericalCamera | CylindricalCamera
FORWARD = ((0, 0, 1), (0, 1, 0), (0, 0, -1), (0, -1, 0), (1, 0, 0), (-1, 0, 0))
"""Directions of the six faces in the optical frame of the wide camera."""
LARGEST = 4096
"""Pixels along a side of a face."""


class Face(NamedTuple):
    """One side of the cube.

    T_wide_face: (4, 4) maps its optical frame into the wide camera's. pixel: (size, size) index of the wide image's
    pixel, -1 where it sees none. scale: (size, size) depth along the face's axis over depth of the wide camera.
    """

    camera: PinholeCamera
    T_wide_face: Transform
    pixel: NDArray[np.int32]
    scale: NDArray[np.float32]


class FaceImage(NamedTuple):
    """What one face sees. image: a pinhole's depth image. ends: (size, size) float32, the same, but for pixels that
    see nothing up to the maximum range: the depth along the face's axis up to which that is so.
    """

    image: DepthImage
    ends: NDArray[np.float32]


def faces_of(image: DepthImage, max_range: float) -> list[FaceImage]:
    """Return the depth image of a wide camera as pinhole images that do not overlap; each takes the nearest pixels.

    max_range: metres, a depth of the wide camera.
    """
    assert not isinstance(image.camera, PinholeCamera)
    return [_cut(image, face, np.float32(max_range)) for face in _faces(image.camera)]


def _cut(image: DepthImage, face: Face, max_range: np.float32) -> FaceImage:
    seen = face.pixel >= 0
    depth_m = np.where(seen, image.depth_m.ravel()[face.pixel] * face.scale, np.float32(np.nan))
    reason = np.where(seen, image.reason.ravel()[face.pixel], np.uint8(Reason.MASKED))
    ends = np.where(depth_m == np.inf, max_range * face.scale, depth_m)
    pose = image.T_world_sensor @ face.T_wide_face
    return FaceImage(DepthImage(depth_m, reason, face.camera, pose, image.stamp_ns), ends)


@lru_cache(maxsize=16)
def _faces(camera: WideCamera) -> list[Face]:
    faces = [_face(camera, np.array(forward, float)) for forward in FORWARD]
    return [face for face in faces if (face.pixel >= 0).any()]


def _face(camera: WideCamera, forward: NDArray[np.float64]) -> Face:
    focal = camera.focal_px / camera.binning
    size = int(min(max(2, round(2 * max(focal, 1 / camera.step_v))), LARGEST))  # no row and no column is passed over
    middle = (size - 1) / 2
    baseline = None if camera.baseline is None else camera.baseline * focal / (size / 2)  # focal length times baseline
    pinhole = PinholeCamera(
        size, size, size / 2, size / 2, middle, middle, baseline, binning=camera.binning, subpixel=camera.subpixel
    )
    T = np.eye(4)
    T[:3, :3] = _rotation(forward)
    directions = pinhole.back_project(np.ones((size, size))) @ T[:3, :3].T
    across = np.hypot(directions[..., 1], directions[..., 2])  # distance from the x axis at depth 1 of the face
    with np.errstate(divide="ignore"):
        return Face(pinhole, T, _pixels(camera, directions, across), np.float32(1) / across.astype(np.float32))


def _rotation(forward: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation whose z axis is `forward`, and whose x axis is the wide camera's where it can be."""
    right = np.array([0.0, 0, -1]) * forward[0] if forward[0] else np.array([1.0, 0, 0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _pixels(camera: WideCamera, directions: NDArray[np.float64], across: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the index of the pixel that looks in each direction (..., 3), -1 where none does."""
    if isinstance(camera, SphericalCamera):
        u = np.arctan2(directions[..., 0], across) / camera.step_u + camera.cu
    else:
        with np.errstate(divide="ignore"):
            u = directions[..., 0] / across * camera.fx + camera.cx
    turn = 2 * np.pi / camera.step_v
    v = np.arctan2(directions[..., 1], directions[..., 2]) / camera.step_v + camera.cv
    v = v - turn * np.floor((v + 0.5) / turn)  # rows that look back are counted on from the first
    inside = (u >= -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    column, row = (np.where(inside, np.floor(x + 0.5), 0).astype(np.int64) for x in (u, v))
    return np.where(inside, row * camera.width + column, -1).astype(np.int32)
