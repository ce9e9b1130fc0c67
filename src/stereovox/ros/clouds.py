# SPDX-License-Identifier: Apache-2.0
"""A point cloud as a depth image all round the sensor: what is between the sensor and a point is free."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stereovox.depth.sphere_image import T_BODY_GRID
from stereovox.depth.sphere_layout import SphereLayout
from stereovox.frame import Frame, Reason
from stereovox.geometry import Transform
from stereovox.sources.bag_robot_messages import PointCloud
from stereovox.wide import WIDEST_DEG, SphericalCamera

EXACT = 1e-6
"""Pixels by which disparities of a lidar, if it had some, were off: what the settings say of `noise` counts alone."""


def frame_of_cloud(cloud: PointCloud, T_world_sensor: Transform, step_deg: float, name: str, sensor: str) -> Frame:
    """Return a cloud as the frame of a spherical camera where its sensor stands (x forward, y left, z up).

    A pixel is `step_deg` wide in azimuth and elevation and has the distance of the nearest of its points from the
    sensor's z axis. One without points is masked, and clears nothing: a cloud does not tell where it looked. Points
    within two degrees of the z axis have no such depth and are left out.
    """
    camera, columns, layout = _eye(step_deg)
    points = cloud.points[np.isfinite(cloud.points).all(axis=1)].astype(float)
    cells = layout.cells_of(points)
    level = np.hypot(points[:, 0], points[:, 1])
    seen = (cells >= 0) & (level > 0)
    depth = np.full(layout.azimuths * layout.polars, np.inf)
    np.minimum.at(depth, cells[seen], level[seen])
    depth[np.isinf(depth)] = np.nan
    image = depth.reshape(layout.shape)[:, columns].astype(np.float32)
    reason = np.where(np.isnan(image), np.uint8(Reason.MASKED), np.uint8(Reason.VALID))
    return Frame(image, camera, T_world_sensor @ T_BODY_GRID, cloud.stamp_ns, reason=reason, name=name, sensor=sensor)


@lru_cache(maxsize=4)
def _eye(step_deg: float) -> tuple[SphericalCamera, NDArray[np.int64], SphereLayout]:
    """Return the camera, which polar cells of the layout are its columns, and the layout of all directions."""
    half_turn = max(round(180 / step_deg), 18)
    layout = SphereLayout(half_turn, 0, 0, half_turn, 2 * half_turn)
    step = layout.step
    columns = np.flatnonzero(np.abs(layout.polar() - np.pi / 2) <= np.radians(WIDEST_DEG) - 1e-9)
    rows, width = layout.azimuths, len(columns)
    camera = SphericalCamera(
        width, rows, step, step, (width - 1) / 2, -(layout.azimuth()[0]) / step, baseline=1.0, subpixel=EXACT
    )
    return camera, columns, layout
