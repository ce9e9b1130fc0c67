# SPDX-License-Identifier: Apache-2.0
"""Stereo pairs: two eyes next to each other, their mount on the vehicle, and the virtual camera of rectified images."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import CylindricalCamera, Lens, SphericalCamera
from stereovox.errors import StereovoxError, did_you_mean
from stereovox.geometry.se3 import Transform, orthonormalise, rigidity_error

VirtualCamera = PinholeCamera | SphericalCamera | CylindricalCamera
"""The camera of a rectified image."""
MODELS = ("pinhole", "spherical", "cylindrical")
USUAL_DEG = {"spherical": (170.0, 180.0), "cylindrical": (120.0, 180.0)}
"""Largest default field of view, across and down, of a wide camera."""
SIDEWAYS_DEG = 45.0
"""Largest angle between the baseline and the x axis of the left eye."""


@dataclass(frozen=True, eq=False)
class Eyes:
    """The raw cameras of a pair: lenses, and T_left_right (4, 4), which maps the right optical frame into the left.

    Their images are distorted and must be rectified. Raises StereovoxError if T_left_right is not a rigid motion, or
    does not place the right eye to the right of the left one.
    """

    left: Lens
    right: Lens
    T_left_right: Transform

    def __post_init__(self) -> None:
        if np.shape(self.T_left_right) != (4, 4):
            raise StereovoxError(f"eyes: T_left_right is {np.shape(self.T_left_right)}; give a (4, 4) rigid motion")
        if rigidity_error(self.T_left_right) > 5e-3:
            raise StereovoxError(
                "eyes: T_left_right is not a rigid motion; give a rotation and metres, below them 0 0 0 1"
            )
        object.__setattr__(self, "T_left_right", orthonormalise(self.T_left_right))
        place = self.T_left_right[:3, 3]
        if not place[0] > math.cos(math.radians(SIDEWAYS_DEG)) * self.baseline > 0:
            seen = " ".join(f"{number:.4g}" for number in place)
            raise StereovoxError(
                f"eyes: in the left eye's frame the right one is at {seen} m, not to its right (+x); "
                "exchange the eyes, or rotate the images if one eye is above the other"
            )

    @property
    def baseline(self) -> float:
        """Metres between both eyes."""
        return float(np.linalg.norm(self.T_left_right[:3, 3]))

    def rectifying_rotations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the (3, 3) rotations from rectified coordinates into the frames of the left and the right eye.

        The rectified x axis runs along the baseline; z is the mean of both optical axes, made orthogonal to it.
        """
        R_left_right = self.T_left_right[:3, :3]
        x = self.T_left_right[:3, 3] / self.baseline
        z = R_left_right[:, 2] + (0, 0, 1)
        z = z - x * (x @ z)
        z /= np.linalg.norm(z)
        R_left_rectified = np.column_stack([x, np.cross(z, x), z])
        return R_left_rectified, R_left_right.T @ R_left_rectified


@dataclass(frozen=True, eq=False)
class StereoPair:
    """A stereo camera.

    Attributes:
        camera: The rectified left eye, with the baseline; the rectified right eye is the same camera, moved by the
            baseline along x.
        eyes: The raw cameras that the images come from; None if images are already rectified.
        T_body_camera: (4, 4) maps the rectified left optical frame into the vehicle's (x forward, y left, z up).
        valid: (height, width) bool of the rectified left image: False if parts of the vehicle block the view or the
            pixel is outside the lens's view; None: all pixels may be used.
        name: For messages.
        valid_right: As `valid`, for the rectified right image.
    """

    camera: VirtualCamera
    eyes: Eyes | None = None
    T_body_camera: Transform = field(default_factory=lambda: np.eye(4))
    valid: NDArray[np.bool_] | None = None
    name: str = "stereo"
    valid_right: NDArray[np.bool_] | None = None

    @classmethod
    def from_eyes(
        cls,
        eyes: Eyes,
        model: str = "pinhole",
        *,
        size: tuple[int, int] | None = None,
        hfov_deg: float | None = None,
        vfov_deg: float | None = None,
        T_body_left: Transform | None = None,
        valid: NDArray[np.bool_] | None = None,
        name: str = "stereo",
    ) -> StereoPair:
        """Return a pair that is rectified to a camera from `virtual_camera`.

        Args:
            eyes: The raw cameras.
            model: `pinhole`, `spherical` or `cylindrical`.
            size: Width and height in pixels; None: the resolution of the lenses.
            hfov_deg: Angle between the left and the right border in degrees; None: what the lenses see.
            vfov_deg: Angle between the upper and the lower border in degrees; None: what the lenses see.
            T_body_left: (4, 4) maps the raw left optical frame, not rectified, into the vehicle's; None: identity.
            valid: As the attribute `valid`.
            name: For messages.

        Returns:
            The pair.

        Raises:
            StereovoxError: The model is unknown, or an angle or size is impossible.
        """
        T_left_camera = np.eye(4)
        T_left_camera[:3, :3] = eyes.rectifying_rotations()[0]
        T_body_camera = T_left_camera if T_body_left is None else np.asarray(T_body_left, float) @ T_left_camera
        camera = virtual_camera(eyes, model, size, hfov_deg, vfov_deg)
        return cls(camera, eyes, T_body_camera, valid, name)


def virtual_camera(
    eyes: Eyes,
    model: str = "pinhole",
    size: tuple[int, int] | None = None,
    hfov_deg: float | None = None,
    vfov_deg: float | None = None,
) -> VirtualCamera:
    """Return the camera that images of `eyes` are rectified to.

    model: `pinhole`, `spherical` or `cylindrical`. size: width and height in pixels. hfov_deg, vfov_deg: angles between
    the borders of the image, across and down. Defaults: the resolution is that in the middle of the lenses; a
    pinhole has the lens's size and is centred on the view of both eyes; a wide one spans what the lenses see, at most
    170 x 180 degrees (cylindrical: 120 x 180).
    Raises StereovoxError for another model and for impossible angles and sizes.
    """
    if model not in MODELS:
        raise StereovoxError(f"virtual camera: unknown model '{model}'{did_you_mean(model, MODELS)}")
    focal = (eyes.left.fx + eyes.right.fx) / 2
    if model == "pinhole":
        return _pinhole(eyes, focal, size, hfov_deg, vfov_deg)
    across, down = (
        _usual(eyes, axis, USUAL_DEG[model][axis]) if given is None else _checked(given)
        for axis, given in enumerate((hfov_deg, vfov_deg))
    )
    kind = SphericalCamera if model == "spherical" else CylindricalCamera
    columns = math.radians(across) if model == "spherical" else 2 * math.tan(math.radians(min(across, 179)) / 2)
    width, height = size or (round(focal * columns), round(focal * math.radians(down)))
    return kind.from_field_of_view(width, height, across, down, eyes.baseline)


def _pinhole(
    eyes: Eyes, focal: float, size: tuple[int, int] | None, hfov_deg: float | None, vfov_deg: float | None
) -> PinholeCamera:
    width, height = size or (eyes.left.width, eyes.left.height)
    if size is not None:
        focal *= width / eyes.left.width
    if hfov_deg is not None or vfov_deg is not None:
        pixels, angle = (width, hfov_deg) if hfov_deg is not None else (height, vfov_deg)
        focal = PinholeCamera.from_field_of_view(round(pixels), 1, angle or 0.0).fx
        if size is None and hfov_deg is not None and vfov_deg is not None:
            height = round(2 * focal * math.tan(math.radians(_checked(vfov_deg)) / 2))
        return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, eyes.baseline)
    x, y = _centre(eyes)
    cx, cy = (width - 1) / 2 - focal * x, (height - 1) / 2 - focal * y
    return PinholeCamera(width, height, focal, focal, cx, cy, eyes.baseline)


def _centre(eyes: Eyes) -> tuple[float, float]:
    """Return the slopes x/z, y/z of the middle of both views; 0, 0 if the eyes see too far to the side."""
    slopes = []
    for lens, R in zip((eyes.left, eyes.right), eyes.rectifying_rotations(), strict=True):
        right, bottom = lens.width - 1, lens.height - 1
        rays = lens.directions([[0, 0], [right, 0], [0, bottom], [right, bottom]]) @ R
        slopes.append(rays[:, :2] / rays[:, 2:])
        if not (rays[:, 2] > 0.2).all():  # also NaN
            return 0.0, 0.0
    x, y = np.mean(slopes, axis=(0, 1))
    return float(x), float(y)


def _usual(eyes: Eyes, axis: int, most: float) -> float:
    """Return the degrees that both lenses see across (axis 0) or down (1), but no more than `most`."""
    angles = []
    for lens in (eyes.left, eyes.right):
        size = (lens.width, lens.height)[axis]
        centre = (lens.cx, lens.cy)
        ends = [[centre[0], centre[1]], [centre[0], centre[1]]]
        ends[0][axis], ends[1][axis] = 0.0, size - 1.0
        off = np.arccos(np.clip(lens.directions(ends)[:, 2], -1, 1))
        angles.append(np.nan_to_num(off, nan=lens.widest).sum())
    return min(most, math.degrees(min(angles)))


def _checked(angle_deg: float) -> float:
    if not 0 < angle_deg < 360:
        raise StereovoxError(f"virtual camera: {angle_deg} deg is not a field of view; give degrees above 0")
    return angle_deg
