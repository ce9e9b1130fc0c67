# SPDX-License-Identifier: Apache-2.0
"""From disparities to points, and their uncertainty (Valenti 2018, chapter 4). Plain NumPy.

Points are in the optical frame of the eye whose image the disparities belong to: the thesis uses the right one. Its
misprints are corrected: Eq 4.3 means sin((v - v0) dtheta_v), Eq 4.6 B (cos / tan - sin).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.cameras.wide import SphericalCamera

Aligned = Literal["left", "right"]
"""The eye whose pixels the disparities belong to: u (left) = u (right) + disparity."""


def reproject(disparity: ArrayLike, camera: VirtualCamera, aligned: Aligned = "left") -> NDArray[np.float64]:
    """Return the points (height, width, 3) in metres of pixels with these disparities.

    disparity: (height, width) in pixels of `camera`; NaN, infinity, zero and less mean "no value" and give NaN points.
    camera: the virtual camera of both eyes. Frame: optical frame of the aligned eye (x right, y down, z forward).
    Pinhole: Valenti 2018, Eq 4.1; spherical: Eq 4.3 and 4.4, for the left eye with -d in place of +d in 4.4;
    cylindrical: the pinhole's depth along rays with equal angles between rows.
    """
    return _along_rays(camera.depth_of(usable(disparity), aligned), camera)


def point_sigma(
    disparity: ArrayLike, camera: VirtualCamera, disparity_sigma: float, aligned: Aligned = "left"
) -> NDArray[np.float64]:
    """Return the standard deviations (height, width, 3) in metres of the three coordinates of each point.

    disparity_sigma: standard deviation of the disparity in pixels of `camera`. Pinhole: Valenti 2018, Eq 4.2;
    spherical: Eq 4.7, which is the same for both eyes. First order: valid while it is small against the disparity.
    All three come from one error along the ray, so they are fully correlated.
    """
    return np.abs(_along_rays(depth_sigma(disparity, camera, disparity_sigma, aligned), camera))


def depth_sigma(
    disparity: ArrayLike, camera: VirtualCamera, disparity_sigma: float, aligned: Aligned = "left"
) -> NDArray[np.float64]:
    """Return the standard deviation (height, width) in metres of the depth measured by `camera`.

    Pinhole and cylindrical: f B / d^2; spherical: B cos^2(column angle) dtheta / sin^2(d dtheta); times the
    disparity's standard deviation in pixels.
    """
    d = np.where(np.isfinite(camera.depth_of(usable(disparity), aligned)), usable(disparity), np.nan)
    baseline = camera.baseline or np.nan
    if isinstance(camera, SphericalCamera):
        flatness = np.cos(camera.angles()) ** 2
        return baseline * flatness * camera.step_u / np.sin(d * camera.step_u) ** 2 * disparity_sigma
    return camera.fx * baseline / d**2 * disparity_sigma


def usable(disparity: ArrayLike) -> NDArray[np.float64]:
    """Return disparities of any shape, with NaN for values that are not positive and finite."""
    d = np.asarray(disparity, float)
    return np.where(np.isfinite(d) & (d > 0), d, np.nan)


def _along_rays(depth: NDArray[np.float64], camera: VirtualCamera) -> NDArray[np.float64]:
    columns, rows = (rays.astype(float) for rays in camera.rays())
    directions = np.broadcast_arrays(columns[None, :], rows[:, :1], rows[:, 1:])
    return depth[..., None] * np.stack(directions, axis=-1)
