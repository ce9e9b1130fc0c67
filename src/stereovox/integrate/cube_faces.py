# SPDX-License-Identifier: Apache-2.0
"""Cut wide depth images into pinhole images: the faces of a cube around the eye, as far as the camera sees them."""

from __future__ import annotations

from math import atan, atan2, ceil, cos, floor, hypot, pi, radians, sin, sqrt, tan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import SEEN_DEG, CylindricalCamera, SphericalCamera
from stereovox.config import Config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import DepthImage, Reason
from stereovox.geometry.se3 import Transform
from stereovox.integrate.views import check_view

WideCamera = SphericalCamera | CylindricalCamera
FORWARD = ((0, 0, 1), (0, 1, 0), (0, 0, -1), (0, -1, 0), (1, 0, 0), (-1, 0, 0))
"""Directions of the six faces in the optical frame of the wide camera."""
MIN_PIXELS, MAX_SHARE = 1 << 18, 16
"""Most pixels of all faces: a base for any image, and more per pixel of the image; a sphere needs less than two."""
Window = tuple[float, float, float, float]
"""Slopes that bound the visible part of a face: left, top, right, bottom."""


class Face(NamedTuple):
    """The part of one side of the cube that the wide camera sees.

    T_wide_face: (4, 4) maps its optical frame into the wide camera's. pixel: (height, width) index of the wide image's
    pixel, -1 for none. scale: (height, width) depth along the face's axis over depth of the wide camera.
    """

    camera: PinholeCamera
    T_wide_face: Transform
    pixel: NDArray[np.int32]
    scale: NDArray[np.float32]


class FaceImage(NamedTuple):
    """The view of one face.

    image: a pinhole's depth image. ends: (height, width) float32, the same, but for pixels that see nothing up to the
    maximum range, the depth along the face's axis up to which they see nothing.
    """

    image: DepthImage
    ends: NDArray[np.float32]


def faces_of(camera: WideCamera, config: Config) -> list[Face]:
    """Return the faces that a wide camera sees. They do not overlap, and miss no row or column, except for rows that
    crowd near the x axis.

    Raises FrameRefused `bad_camera` if the view or the faces are out of proportion to the image.
    """
    check_view(camera, config)
    try:
        places = [(np.array(forward, float), pinhole) for forward in FORWARD if (pinhole := _pinhole(camera, forward))]
    except StereovoxError as error:
        raise FrameRefused("bad_camera", str(error)) from None
    pixels = sum(pinhole.width * pinhole.height for _, pinhole in places)
    if pixels > MIN_PIXELS + MAX_SHARE * camera.width * camera.height:
        detail = f"{camera.width}x{camera.height} wide pixels need {pixels} of pinhole cameras"
        raise FrameRefused("bad_camera", f"{detail}: their sides differ too much; check the camera's steps")
    faces = [_face(camera, pinhole, forward) for forward, pinhole in places]
    return [face for face in faces if (face.pixel >= 0).any()]


def cut(image: DepthImage, face: Face, max_range: float) -> FaceImage:
    """Return the part of a wide camera's depth image on a face; each pixel takes the nearest pixel of the image.

    max_range: metres, a depth of the wide camera.
    """
    seen = face.pixel >= 0
    depth_m = np.where(seen, image.depth_m.ravel()[face.pixel] * face.scale, np.float32(np.nan))
    reason = np.where(seen, image.reason.ravel()[face.pixel], np.uint8(Reason.MASKED))
    ends = np.where(depth_m == np.inf, np.float32(max_range) * face.scale, depth_m)
    pose = image.T_world_sensor @ face.T_wide_face
    return FaceImage(DepthImage(depth_m, reason, face.camera, pose, image.stamp_ns), ends)


def _pinhole(camera: WideCamera, forward: tuple[int, int, int]) -> PinholeCamera | None:
    """Return the pinhole camera of a face, with pixels as fine as the wide camera's, cut to its view; None if unseen.

    A whole face spans slopes from -1 to 1 in whole pixels, so that neighbours meet at their borders.
    """
    window = _beside(camera, forward[0]) if forward[0] else _around(camera, atan2(forward[1], forward[2]))
    if window is None:
        return None
    focal = camera.focal_px / camera.binning
    whole = max(2, round(2 * max(focal, 1 / camera.step_v)))
    first_u, first_v = (min(max(floor((slope + 1) / 2 * whole), 0), whole - 1) for slope in window[:2])
    last_u, last_v = (min(max(floor((slope + 1) / 2 * whole), 0), whole - 1) for slope in window[2:])
    baseline = None if camera.baseline is None else camera.baseline * focal / (whole / 2)  # focal length times baseline
    return PinholeCamera(
        last_u - first_u + 1, last_v - first_v + 1, whole / 2, whole / 2,
        (whole - 1) / 2 - first_u, (whole - 1) / 2 - first_v,
        baseline, binning=camera.binning, subpixel=camera.subpixel,
    )  # fmt: skip


def _around(camera: WideCamera, middle: float) -> Window | None:
    """Return the window of a face that looks in the direction of rows, `middle` radians down from the z axis.

    A ray at angle `a` from the y-z plane has the slopes x = tan(a) |1, y| and y.
    """
    left, right, top, bottom = camera.borders
    first = middle + 2 * pi * floor((top - middle) / (2 * pi))
    parts = [(max(top - m, -pi / 4), min(bottom - m, pi / 4)) for m in (first, first + 2 * pi, first + 4 * pi)]
    seen = [tan(angle) for part in parts if part[0] < part[1] for angle in part]
    if not seen:
        return None
    low, high = min(seen), max(seen)
    farthest, nearest = hypot(1, max(-low, high)), hypot(1, max(low, -high, 0))
    left, right = _slope(left), _slope(right)
    left, right = left * (farthest if left < 0 else nearest), right * (farthest if right > 0 else nearest)
    return (left, low, right, high) if left < 1 and right > -1 else None


def _beside(camera: WideCamera, side: int) -> Window | None:
    """Return the window of the face that looks along the x axis (side 1) or back along it (-1).

    A ray at angle `a` from the y-z plane is 1 / tan(a) from the face's middle, in the direction of its row.
    """
    left, right, top, bottom = camera.borders
    near, far = (left, right) if side > 0 else (-right, -left)
    near = max(near, atan(sqrt(0.5)))  # the corners of the face
    if near >= far:
        return None
    quarters = range(ceil(top / (pi / 2)), floor(bottom / (pi / 2)) + 1)
    turns = [top, bottom, *(quarter * pi / 2 for quarter in quarters)]
    points = [(-side * cos(turn) / _slope(a), sin(turn) / _slope(a)) for turn in turns for a in (near, far)]
    across, down = zip(*points, strict=True)
    window = min(across), min(down), max(across), max(down)
    return window if max(window[:2]) < 1 and min(window[2:]) > -1 else None


def _slope(angle: float) -> float:
    return tan(min(max(angle, -radians(SEEN_DEG)), radians(SEEN_DEG)))


def _face(camera: WideCamera, pinhole: PinholeCamera, forward: NDArray[np.float64]) -> Face:
    T = np.eye(4)
    T[:3, :3] = _rotation(forward)
    directions = pinhole.back_project(np.ones((pinhole.height, pinhole.width))) @ T[:3, :3].T
    across = np.hypot(directions[..., 1], directions[..., 2])  # distance from the x axis at depth 1 of the face
    with np.errstate(divide="ignore"):
        return Face(pinhole, T, _pixels(camera, directions, across), np.float32(1) / across.astype(np.float32))


def _rotation(forward: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation whose z axis is `forward`, and whose x axis is the wide camera's if possible."""
    right = np.array([0.0, 0, -1]) * forward[0] if forward[0] else np.array([1.0, 0, 0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _pixels(camera: WideCamera, directions: NDArray[np.float64], across: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the index of the pixel that looks in each direction (..., 3), -1 for none."""
    if isinstance(camera, SphericalCamera):
        u = np.arctan2(directions[..., 0], across) / camera.step_u + camera.cu
    else:
        with np.errstate(divide="ignore"):
            u = directions[..., 0] / across * camera.fx + camera.cx
    turn = 2 * np.pi / camera.step_v
    v = np.arctan2(directions[..., 1], directions[..., 2]) / camera.step_v + camera.cv
    v = v - turn * np.floor((v + 0.5) / turn)  # rows that look back continue the count from the first
    inside = (u >= -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    column, row = (np.where(inside, np.floor(x + 0.5), 0).astype(np.int64) for x in (u, v))
    return np.where(inside, row * camera.width + column, -1).astype(np.int32)
