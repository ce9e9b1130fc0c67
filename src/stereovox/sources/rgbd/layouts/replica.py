# SPDX-License-Identifier: Apache-2.0
"""Renderings of the Replica data set as used by NICE-SLAM, Co-SLAM, vMAP and many more."""

from __future__ import annotations

import os
from pathlib import Path

from stereovox.sources.base import Part
from stereovox.sources.rgbd.folder import ImageFile, folder_part, images_in
from stereovox.sources.rgbd.plain import DepthAndPoses

RESULTS, SEQUENCE = "traj.txt", "traj_w_c.txt"
RENDERED = {(1200, 680): (600.0, 600.0, 599.5, 339.5), (640, 480): (320.0, 320.0, 319.5, 239.5)}
"""fx, fy, cx, cy of renderings of NICE-SLAM and vMAP, and of Semantic-NeRF, by size."""


class Replica(DepthAndPoses):
    """`results/depth000000.png` with `traj.txt`, or `depth/` with `traj_w_c.txt`; 16 numbers a line, camera to world.

    Unit: 1/6553.5 m with traj.txt, millimetres with traj_w_c.txt. Camera: `cam_params.json` in the folder or the one
    above, which also has the unit, or another file; else that of the renderings, with a note. World: z up.
    """

    layout = "a Replica rendering (results/depth*.png with traj.txt)"
    parts = (
        Part(("results/depth*.png", "depth/depth*.png"), "depth images"),
        Part((RESULTS, SEQUENCE), "poses"),
    )

    intrinsics = RENDERED

    def __init__(self, where: str | os.PathLike[str], posed: bool = True):
        if Part((SEQUENCE,), "").count(folder_part(where)) == 0:
            self.depth_scale = 1 / 6553.5
        super().__init__(where, posed)

    def list_photos(self) -> list[ImageFile]:
        """Return the pictures among the depth images, else in a folder next to them."""
        return images_in(self._images[0].path.parent, r"(frame|rgb_?)\d+\.(jpg|png)", self.fps) or super().list_photos()

    def pose_places(self) -> list[Path]:
        """Return the file of the poses."""
        return [self.folder / name for name in (RESULTS, SEQUENCE) if (self.folder / name).exists()][:1]

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth images and a trajectory of these names."""
        folder = folder_part(where)
        images, poses = cls.parts
        return images.count(folder) > 0 and poses.count(folder) > 0
