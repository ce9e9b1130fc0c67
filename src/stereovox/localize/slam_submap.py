# SPDX-License-Identifier: Apache-2.0
"""Submaps: runs of keyframes short enough to be rigid, the unit in which loops are closed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stereovox import planar
from stereovox.localize.line_map import Cloud, joined
from stereovox.localize.slam_keyframe import Keyframe


@dataclass(frozen=True)
class Submap:
    """A run of keyframes that is short enough not to have drifted: keyframes `first` to `last` - 1."""

    first: int
    last: int

    @property
    def anchor(self) -> int:
        """The keyframe in its middle, whose frame is the submap's."""
        return (self.first + self.last) // 2


def submap_cloud(keyframes: list[Keyframe], submap: Submap, max_range: float, cell: float = 0.0) -> Cloud:
    """Return the points of a submap within `max_range` of each robot pose, in its anchor's frame.

    cell: side in metres of squares of which each gives one point; 0: all points.
    """
    pose = keyframes[submap.anchor].pose
    clouds = []
    for keyframe in keyframes[submap.first : submap.last]:
        if np.hypot(*(keyframe.pose - pose)[:2]) > max_range:
            continue  # the odometry jumped
        near = (keyframe.cloud.points**2).sum(axis=1) < max_range**2
        part = Cloud(keyframe.cloud.points[near], keyframe.cloud.views[near])
        clouds.append(part.moved(planar.relative(pose, keyframe.pose)))
    cloud = joined(clouds)
    if not cell or not len(cloud.points):
        return cloud
    squares = np.floor(cloud.points / cell).astype(np.int64)
    _, first = np.unique(squares[:, 0] * (1 << 32) + squares[:, 1], return_index=True)
    first.sort()
    return Cloud(cloud.points[first], cloud.views[first])
