# SPDX-License-Identifier: Apache-2.0
"""Folders of the Redwood data sets and of Open3D's reconstruction system."""

from __future__ import annotations

from stereovox.sources.base import Part
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rgbd.plain import DEPTH, DepthAndPoses, has_depth

LOGS = ("trajectory.log", "scene/trajectory.log", "*_scene/trajectory.log", "trajectory.json", "*.log")


class Open3DFolder(DepthAndPoses):
    """`depth/` (uint16 mm) with Open3D's `trajectory.log`, also in `scene/`, or `trajectory.json`.

    World: the poses', often the optical frame of the first camera (y down). Camera: see `DepthAndPoses`; without
    a file, 640x480 images get 525 525 319.5 239.5, Open3D's PrimeSense default, with a note.
    """

    layout = "a Redwood or Open3D folder (depth/ with trajectory.log)"
    parts = (DEPTH, Part(LOGS, "poses", "put trajectory.log there, or add ?poses=FILE"))
    baseline = 0.075
    intrinsics = (525.0, 525.0, 319.5, 239.5)

    @classmethod
    def depth_only(cls, where: str) -> Open3DFolder:
        """Return the images, with the camera of this layout, without searching for poses: every pose is NaN."""
        return cls(where, posed=False)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth images and Open3D's trajectory."""
        folder = folder_part(where)
        return cls.parts[1].count(folder) > 0 and has_depth(folder)
