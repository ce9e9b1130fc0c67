# SPDX-License-Identifier: Apache-2.0
"""A spherical grid as a depth image, the mapper's input."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.cameras.wide import WIDEST_DEG, SphericalCamera
from stereovox.config import Config
from stereovox.depth.sphere.grid import SphereGrid, SphereLayout, accumulate
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage, Frame, Reason
from stereovox.geometry.se3 import Transform, inverse

T_BODY_GRID: Transform = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
"""From the optical frame of a grid's image to the body: its x axis, the pole of all rows, points down."""
T_BODY_OPTICAL: Transform = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From the optical frame of a camera that points ahead (x right, y down, z forward) to the body's."""
T_OPTICAL_GRID: Transform = inverse(T_BODY_OPTICAL) @ T_BODY_GRID
MAX_BINNING, MAX_BASELINE_M = 1_000_000, 1e6
"""Limits of a grid camera's numbers: an eye with the narrowest pixels would exceed the limits of a camera."""


def frame_of(grid: SphereGrid, T_world_body: Transform, max_range: float, name: str = "sphere") -> Frame:
    """Return the grid as a frame of a spherical camera at the body's origin, to be mapped like any other.

    Rows of the image are azimuths, columns polar angles; the ray of each pixel is the centre of a cell. Depth is the
    distance from the body's z axis, float32 metres. Cells within two degrees of that axis are left out, since they
    have no such depth. A cell that is free up to less than `max_range` from the axis is UNKNOWN, since a frame
    can only mark rays as free up to `max_range` (metres).
    stamp_ns is the newest of the grid. Noise is that of the grid's `camera`.
    """
    columns, camera = _image_of(grid.layout, grid.camera)
    depth, reason = _depth(grid, columns, camera, max_range)
    stamp_ns = int(grid.stamp_ns[grid.known].max(initial=0))
    return Frame(depth, camera, T_world_body @ T_BODY_GRID, stamp_ns, reason=reason, name=name)


def through_sphere(image: DepthImage, config: Config) -> DepthImage:
    """Return the depth image of the spherical grid that the pixels of `image` form; without a step, `image` itself.

    The grid's origin is the camera's eye, its pole the camera's y axis, its step `sphere.step_deg`; it covers the
    whole image, whatever bounds the settings name, so only pixels within two degrees of the pole are lost.
    Raises FrameRefused `bad_camera` if nothing else is in view.
    """
    if config.sphere.step_deg is None:
        return image
    layout = _layout_of(image.camera, config.sphere.step_deg)
    grid = accumulate(image, T_BODY_OPTICAL, config, layout)
    columns, camera = _image_of(layout, image.camera)
    depth, reason = _depth(grid, columns, camera, config.max_range)
    valid = reason == Reason.VALID
    reason[valid & (depth < config.min_range)] = Reason.TOO_NEAR
    reason[valid & (depth > config.max_range)] = Reason.TOO_FAR
    return DepthImage(_special(depth, reason), reason, camera, image.T_world_sensor @ T_OPTICAL_GRID, image.stamp_ns)


@lru_cache(maxsize=16)
def _layout_of(camera: VirtualCamera, step_deg: float) -> SphereLayout:
    """Return the cells in the camera's view."""
    columns, rows = (rays.astype(float) for rays in camera.rays())
    x, y, z = np.broadcast_arrays(columns[None, :], rows[:, :1], rows[:, 1:])
    polar, azimuth = np.degrees(np.arctan2(np.hypot(z, x), -y)), np.degrees(np.arctan2(-x, z))
    low, high = max(polar.min() - 1e-3, 0.0), min(polar.max() + 1e-3, 180.0)
    left, right = azimuth.min() - 1e-3, azimuth.max() + 1e-3
    behind = left < -180 or right > 180 or (np.abs(azimuth) > 90).any()  # rows that point backwards wrap round the pole
    return SphereLayout.of(step_deg, (low, high), (-180.0, 180.0) if behind else (left, right))


@lru_cache(maxsize=16)
def _image_of(layout: SphereLayout, eye: VirtualCamera | None) -> tuple[slice, SphericalCamera]:
    """Return the polar cells that have a depth, and the camera whose columns they are, as noisy as `eye`."""
    elevation = np.degrees(layout.polar()) - 90
    inside = np.flatnonzero(np.abs(elevation) <= WIDEST_DEG)
    if not len(inside):
        blind = f"the camera sees only directions within {90 - WIDEST_DEG:g} degrees of the axis of the spherical grid"
        raise FrameRefused("bad_camera", f"{blind}; leave sphere.step_deg out")
    first, last = int(inside[0]), int(inside[-1]) + 1
    step = layout.step
    cu = -math.radians(elevation[first]) / step
    cv = -float(layout.azimuth()[0]) / step
    binning, baseline = 1, None
    if eye is not None:
        binning = min(max(1, round(eye.focal_px * step)), MAX_BINNING)
        kept = eye.focal_px * step / binning  # keeps focal length times baseline
        baseline = eye.baseline and min(eye.baseline * kept, MAX_BASELINE_M)
    camera = SphericalCamera(
        last - first, layout.azimuths, step, step, cu, cv, baseline, binning, subpixel=eye.subpixel if eye else None
    )
    return slice(first, last), camera


def _depth(
    grid: SphereGrid, columns: slice, camera: SphericalCamera, max_range: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the distance from the polar axis, 0 if there is none, and the reasons."""
    depth = grid.range_m[:, columns] * np.cos(camera.angles()).astype(np.float32)
    reason = grid.reason[:, columns].copy()
    inner = np.cos(np.maximum(np.abs(camera.angles()) - camera.step_u / 2, 0)).astype(np.float32)
    farthest = grid.range_m[:, columns] * inner  # at the cell's edge nearest to the equator
    reason[(reason == Reason.TOO_FAR) & (farthest < max_range * (1 - 1e-5))] = Reason.UNKNOWN
    return np.where(reason == Reason.VALID, depth, np.float32(0)), reason


def _special(depth: NDArray[np.float32], reason: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return depth with REP 117's special values for invalid pixels."""
    none = np.array([0, np.nan, -np.inf, np.inf, np.nan, np.nan], np.float32)[reason]
    return np.where(reason == Reason.VALID, depth, none)
