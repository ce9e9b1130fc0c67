# SPDX-License-Identifier: Apache-2.0
"""A layout of depth images with poses: only where they are."""

from pathlib import Path

import numpy as np

import stereovox as sv
from stereovox.opening import SOURCES, Part
from stereovox.sources.rgbd.folder import DepthFolder, folder_part, images_in
from stereovox.sources.rgbd.pose_files import read_poses


class Rover(DepthFolder):
    """`range/00.npy`, float32 metres, with `poses.txt`: 12 numbers a line, of a camera with x forward and z up."""

    layout = "a rover's folder (range/*.npy with poses.txt)"
    parts = (
        Part(("range/*.npy",), "depth images"),
        Part(("poses.txt",), "poses", "write poses.txt with 12 numbers a line"),
    )
    axes, fps, certain = "ros", 10.0, True  # certain: its unit needs no check
    up = "z"

    def list_images(self):
        """Return the images, with the time of each."""
        return images_in(self.folder / "range", r"\d+\.npy", self.fps)

    def read_poses(self):
        """Return the poses, in the axes that fit the images."""
        return self.fitted(read_poses(self.folder / "poses.txt"))

    @classmethod
    def recognises(cls, where):
        """Return whether the folder is one of these. Quick, and never raises."""
        return all(part.count(folder_part(where)) > 0 for part in cls.parts)


SOURCES["rover"] = f"{__name__}:Rover"

folder = Path("rover")
(folder / "range").mkdir(parents=True, exist_ok=True)
for i in range(5):
    np.save(folder / "range" / f"{i:02}.npy", np.full((60, 80), 2.0, np.float32))
(folder / "camera-intrinsics.txt").write_text("60 0 39.5\n0 60 29.5\n0 0 1\n")
np.savetxt(folder / "poses.txt", [np.eye(4)[:3].ravel()] * 5)

print("\n".join(sv.describe(folder).lines))
print(sv.open_source(folder).frame(0).T_world_sensor)  # its optical axis is the world's x
